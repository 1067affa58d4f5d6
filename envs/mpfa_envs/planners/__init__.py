"""Classic drivers beside the learned ones: planners on the known map, and the dynamic window."""

from __future__ import annotations
