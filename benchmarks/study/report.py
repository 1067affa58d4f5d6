"""Make the pages and figures of the study, of its runs or of the rows that are kept of them.

    python -m benchmarks.study report docs/results/study --output runs/pages
    python -m benchmarks.study report runs/study --output runs/pages

For each table that has rows it makes a page and figures: curves, performance profiles, arms side by
side, for table D replay volume by method; for table A, in ``paper/``, the output of
``python -m benchmarks.study paper``, which needs the runs. The unit is the run, not the episode:
see ``benchmarks/study/intervals.py``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.study.designs import paper_comparisons, tables
from benchmarks.study.kept_rows import is_kept
from benchmarks.study.pages import write_study
from benchmarks.study.paper_report import write_paper
from training import files


def report_study(folder: Path, output: Path) -> int:
    """Make the pages and figures of the study.

    Args:
        folder: Of its runs, or of the rows that are kept of them.
        output: Where they go.

    Returns:
        Exit status: 1 if there are no rows.
    """
    made = write_study(folder, output)
    for path in made:
        print(f"written: {path}")
    if not made:
        print(
            f"{folder} has no rows of the study, which python -m benchmarks.study run makes",
            file=sys.stderr,
        )
    elif output / "A.md" in made and not is_kept(folder):
        write_paper(paper_comparisons(tables(folder)["A"]), output / "paper")
    return 0 if made else 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the rows, write pages and figures."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study report",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="of the study, or of its kept rows")
    parser.add_argument("--output", type=Path, help="folder (default: that of the study)")
    options = parser.parse_args(arguments)
    output = options.output or options.folder
    try:
        files.check_folder(output)
        return report_study(options.folder, output)
    except ValueError as error:
        parser.error(" ".join(str(error).split()))
