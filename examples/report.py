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
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from training.comparison.report import write_report


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
    parser.add_argument("folders", type=Path, nargs="+", help="folders of comparisons")
    parser.add_argument("--output", type=Path, help="folder (default: the first comparison's)")
    options = parser.parse_args(arguments)
    there = [folder.resolve() for folder in options.folders]
    for folder, path in zip(options.folders, there, strict=True):
        if there.count(path) > 1:
            parser.error(f"{folder} is named twice: its runs count once")
    try:
        print(write_report(options.folders, options.output or options.folders[0]))
    except ValueError as error:
        parser.error(" ".join(str(error).split()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
