"""``python -m benchmarks.speed`` runs them all."""

import sys

from benchmarks.speed.run import main

sys.exit(main())
