"""Options that scripts share, without the parts of a run, which take seconds to import."""

from __future__ import annotations

import argparse
from pathlib import Path

from training.plugins import load_plugin

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


def add_plugin(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--plugin``, which is loaded while the command line is parsed."""

    def loaded(text: str) -> str:
        try:
            return load_plugin(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    parser.add_argument(
        "--plugin",
        type=loaded,
        metavar="FILE",
        help="file with methods, signals, robots or generators of your own",
    )


def add_robot(parser: argparse.ArgumentParser, whose: str) -> None:
    """Add the option ``--robot``; ``whose`` says which robot is the default."""
    # Imported here, as robots take seconds.
    from mpfa_envs.robots.model import ROBOTS

    parser.add_argument("--robot", help=f"{', '.join(ROBOTS)} or a YAML file (default: {whose})")


def add_filter(parser: argparse.ArgumentParser) -> None:
    """Add the options ``--filter`` and ``--no-filter``."""
    parser.add_argument(
        "--filter",
        action=argparse.BooleanOptionalAction,
        help="let actions pass a filter that keeps the robot off what its lidar sees (default: for "
        "policies that had it in all of their training)",
    )


def check_least(parser: argparse.ArgumentParser, options: argparse.Namespace, **least: int) -> None:
    """Reject options that are below the least of their names."""
    for name, lowest in least.items():
        value = getattr(options, name)
        if value is not None and value < lowest:
            parser.error(f"--{name.replace('_', '-')} must be at least {lowest}, got {value}")
