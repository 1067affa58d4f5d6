"""``python -m benchmarks.values COMMAND``: which replay learns the values of a policy sooner.

    python -m benchmarks.values capture           make the frozen buffers, some twenty minutes
    python -m benchmarks.values run               table G: every arm, buffer and seed, three hours
    python -m benchmarks.values run per mpfa_per --seeds 3    two arms, three seeds
    python -m benchmarks.values report            its page and figures

``run`` continues where it was stopped. ``docs/results/values.md`` tests a signal of your own.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from benchmarks.values.arms import AGAINST, ARMS
from benchmarks.values.capture import capture_all
from benchmarks.values.frozen import FOLDER, frozen_buffers
from benchmarks.values.report import missing, write_report
from benchmarks.values.running import make_rows, read_rows
from torchrl_mpfa.checks import unknown
from training.files import run_script
from training.options import check_least

ROWS = "rows.csv"


def main(arguments: Sequence[str] | None = None) -> int:
    """Capture buffers, make the trainings of table G, or report them."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.values",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=["capture", "run", "report"])
    parser.add_argument("arms", nargs="*", metavar="ARM", help="of run (default: all)")
    parser.add_argument("--seeds", type=int, default=5, help="of each arm (default: 5)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument(
        "--folder", type=Path, default=FOLDER, help="of buffers, rows and page (default: docs)"
    )
    options = parser.parse_args(arguments)
    check_least(parser, options, seeds=1, jobs=1)
    for arm in options.arms:
        if arm not in ARMS:
            parser.error(unknown("arm", arm, ARMS))
    path = options.folder / ROWS
    if options.command == "capture":
        capture_all(options.folder)
        return 0
    try:
        buffers = frozen_buffers(options.folder)
    except FileNotFoundError as error:
        parser.error(str(error))
    if options.command == "run":
        seeds = range(options.seeds)
        arms = options.arms or list(ARMS)
        make_rows(path, arms, seeds, jobs=options.jobs, folder=options.folder)
        return 0
    rows = read_rows(path)
    if AGAINST not in set(rows["method"]) or rows["method"].nunique() < 2:
        parser.error(f"{path} must have rows of {AGAINST} and of another arm: `run` makes them")
    for written in write_report(rows, buffers, options.folder):
        print(f"written: {written}")
    left = missing(rows, [each.name for each in buffers], options.seeds)
    if left:
        print(f"{left} trainings are missing: python -m benchmarks.values run")
    return 0


if __name__ == "__main__":
    run_script(main)
