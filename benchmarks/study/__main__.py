"""``python -m benchmarks.study COMMAND ...``: make the study's runs, pages and pictures."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

import training.extra  # noqa: F401

COMMANDS = {
    "run": ("run", "train and evaluate the runs of tables A to D"),
    "gym": ("gym.script", "train the runs of table F, on Gymnasium tasks"),
    "report": ("report", "make the pages and figures of the tables"),
    "statistics": ("statistics", "make every statistic of comparisons by compare.py"),
    "paper": ("paper_report", "make the paper's figures and tables"),
    "drivers": ("drivers", "compare learned policies with planners, by their evaluations"),
    "strength": ("strength", "measure how strongly methods prioritize"),
    "cliffwalk": ("cliffwalk", "count updates to convergence on the blind cliffwalk"),
    "sampling": ("sampling", "plot how often each method samples which transitions"),
    "pictures": ("pictures", "make the pictures of docs/pictures.md and of the README"),
}
"""Modules of the commands, each with a function ``main``, and what they do."""


def main() -> int:
    """Run the command that the command line names, with what follows it."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study",
        description="\n".join(f"{name:10} {text}" for name, (_, text) in COMMANDS.items()),
        epilog="COMMAND --help shows its options.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...")
    options = parser.parse_args()
    module = import_module(f"benchmarks.study.{COMMANDS[options.command][0]}")
    return int(module.main(options.arguments))


if __name__ == "__main__":
    sys.exit(main())
