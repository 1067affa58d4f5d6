"""``python -m benchmarks.paper [COMMAND]``: the paper's tables and figures, made again.

    python -m benchmarks.paper                 write docs/results/paper.md from the kept rows
    python -m benchmarks.paper run             make the runs that have no rows yet; thirteen hours
    python -m benchmarks.paper time            make the runs of Table 3's times, one at a time
    python -m benchmarks.paper figure3         make the runs of Fig. 3; half an hour
    python -m benchmarks.paper keep            add the rows of finished runs, and make none

Ctrl-C saves the runs in progress, and the same command continues them. ``run`` and ``time`` add
rows to ``--rows``, by default ``FOLDER/rows``; the page is made of those in docs/results/paper.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from benchmarks.paper.errors import figure_3, keep_figure_3
from benchmarks.paper.page import write_page
from benchmarks.paper.published import TABLE_3
from benchmarks.paper.rows import FOLDER, QUESTION, keep, keep_time, read_rows
from benchmarks.paper.runs import BLOCKS, PLUGIN_FILE, SEEDS, comparisons, question, without
from training import files
from training.comparison.execution import make_runs
from training.options import check_least
from training.plugins import load_plugin
from training.settings.train import register

TIMED = SEEDS[:3]
"""Seeds of the runs that are timed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Make runs, keep their rows, or write the page."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "command", nargs="?", default="page", choices=["page", "run", "time", "figure3", "keep"]
    )
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/paper"), help="of runs (default: runs/paper)"
    )
    parser.add_argument("--rows", type=Path, help="folder of rows")
    parser.add_argument("--output", type=Path, help="folder of the page (default: docs/results)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time (default: 2)")
    options = parser.parse_args(arguments)
    check_least(parser, options, jobs=1)
    rows = options.rows or (FOLDER if options.command == "page" else options.folder / "rows")
    try:
        for folder in (options.folder, rows, options.output or rows):
            files.check_folder(folder)
        if options.command == "page":
            return _write(rows, options.output)
        if options.command == "keep":
            return _keep(options.folder, rows)
        load_plugin(PLUGIN_FILE)
        register()
        make = {"time": _time, "figure3": _figure_3}.get(options.command, _make)
        return make(options.folder, rows, options.jobs)
    except (ValueError, files.FolderInUse) as error:
        parser.error(" ".join(str(error).split()))


def _write(rows: Path, output: Path | None) -> int:
    """Write the page; the figures of the kept rows lie next to these."""
    page = (output or FOLDER.parent) / "paper.md"
    for path in write_page(read_rows(rows), page, output or FOLDER):
        print(f"written: {path}")
    return 0


def _keep(folder: Path, rows: Path) -> int:
    """Add the rows of finished runs, and name the runs."""
    for planned, to in ((comparisons(folder), rows), ([question(folder)], rows / QUESTION)):
        for name in keep(planned, to):
            print(f"kept: {name}")
    return 0


def _make(folder: Path, rows: Path, jobs: int) -> int:
    """Make the runs that have no rows, a few at a time, and keep their rows after each seed."""
    worst = 0
    planned = [comparison for seeds in BLOCKS for comparison in comparisons(folder, seeds)]
    for comparison in (*planned, question(folder)):
        kept = read_rows(rows).runs | read_rows(rows / QUESTION).runs
        for part in without(comparison, kept):
            worst = max(worst, make_runs(part, most=jobs))
            _keep(folder, rows)
            if worst >= 128:
                return worst
    return worst


def _figure_3(folder: Path, rows: Path, jobs: int) -> int:
    """Make the runs of Fig. 3, and keep their rows."""
    planned = figure_3(folder)
    status = make_runs(planned, most=jobs)
    print(f"kept: {keep_figure_3(planned, rows)} runs")
    return status


def _time(folder: Path, rows: Path, _: int) -> int:
    """Make the runs of Table 3 one at a time, and keep their training times."""
    timed = read_rows(rows).times
    done = set(timed[["arm", "seed"]].itertuples(index=False, name=None))
    for seed in TIMED:
        for name in TABLE_3:
            if (f"ddpg-{name}", seed) in done:
                continue
            first = comparisons(folder / "alone", (seed,))[0]
            one = replace(first, methods=(name,))
            status = make_runs(one, most=1)
            if status:
                return status
            keep_time(one.jobs[0], rows)
    return 0


if __name__ == "__main__":
    files.run_script(main)
