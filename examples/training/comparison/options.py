"""Options of the scripts that make many runs, without the parts of a run, which take seconds."""

from __future__ import annotations

import argparse
from pathlib import Path

JOBS = 2
"""Runs at a time on one machine."""
WORLDS = ("test",)
"""Worlds in which the runs of a comparison are evaluated."""
EPISODES = 200
"""Episodes in each of them."""


def add_options(parser: argparse.ArgumentParser, *, folder: str, what: str) -> None:
    """Add the options of where a script makes its runs or trials, and how many at a time."""
    parser.add_argument("--folder", type=Path, default=Path(folder), help=f"(default: {folder})")
    parser.add_argument(
        "--jobs",
        type=int,
        help=f"{what} at a time (default: {JOBS}; with --ray as many as fit)",
    )
    parser.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="run on a Ray cluster (default: that of RAY_ADDRESS, or of this machine)",
    )
