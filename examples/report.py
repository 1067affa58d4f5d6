"""Make tables and a figure of comparisons, from the rows that ``compare.py`` kept; trains nothing.

    python examples/report.py runs/compare
    python examples/report.py runs/compare runs/more    the runs of both together

It writes ``tables.md`` and ``evaluations.png``, greedy success in the validation world over actions
(the training of each run has a ``learning_curve.png`` in its folder). Each arm has a row and a line
(``compare.py --arm``); each kind of worlds, and evaluations with other physics, have tables of
their own: success, its interval and that of each run, and the differences between arms with their
intervals and p. The unit is the run, not the episode: see ``training/comparison/report.py``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import training.extra  # noqa: F401

# isort: split
from training.comparison.report import differences, outcomes, rate_table, write_report


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the rows, write tables and figure.

    Args:
        arguments: The command line.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    return write_report(
        parser, arguments, lambda rows: [outcomes(rows), differences(rows)], rate_table
    )


if __name__ == "__main__":
    sys.exit(main())
