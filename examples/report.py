"""Make tables and a figure of many runs, with intervals and tests; trains nothing.

    python examples/report.py runs/compare
    python examples/report.py runs/compare runs/more    the runs of both together
    python examples/report.py scores.csv                scores that any script wrote
    python examples/report.py runs/mine                 all such tables in a folder

Of comparisons of ``compare.py`` it writes ``tables.md`` and ``evaluations.png``, greedy success in
the validation world over actions (each run has its ``learning_curve.png``). Each arm has a row and
a line (``compare.py --arm``); each kind of worlds, and evaluations with other physics, have tables
of their own: success, its interval and that of each run, and the differences between arms with
their intervals and p.

A table of scores is a CSV file with the columns task, method, seed, steps and score: a row for each
evaluation of each run, of which a higher score is better. Of these it writes ``tables.md`` and
``curves.png``. The unit is the run, not the episode.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
from training import files
from training.comparison.report import write_report
from training.comparison.scores import CURVES, are_scores, write_scores


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
    parser.add_argument(
        "paths", type=Path, nargs="+", help="folders of comparisons, or tables of scores"
    )
    parser.add_argument("--output", type=Path, help="folder (default: that of the first path)")
    options = parser.parse_args(arguments)
    try:
        for path in options.paths:
            files.check_name(path)
    except ValueError as error:
        parser.error(str(error))
    there = [path.resolve() for path in options.paths]
    for given, path in zip(options.paths, there, strict=True):
        if there.count(path) > 1:
            parser.error(f"{given} is named twice: its runs count once")
        if not path.exists():
            parser.error(f"there is no {given}")
    kinds = {are_scores(path) for path in options.paths}
    if len(kinds) > 1:
        parser.error("comparisons and tables of scores have reports of their own: name one kind")
    first = options.paths[0]
    output = options.output or (first.parent if first.is_file() else first)
    write = write_scores if kinds == {True} else write_report
    try:
        print(write(options.paths, output))
    except ValueError as error:
        parser.error(" ".join(str(error).split()))
    picture = CURVES if kinds == {True} else "evaluations.png"
    made = [output / name for name in ("tables.md", picture) if (output / name).exists()]
    print(f"written: {', '.join(map(str, made))}")
    return 0


if __name__ == "__main__":
    files.run_script(main)
