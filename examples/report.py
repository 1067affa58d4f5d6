"""Make tables and figures of studies, from the rows that ``compare.py`` kept; trains nothing.

    python examples/report.py runs/compare
    python examples/report.py runs/compare runs/more           the runs of both, together
    python examples/report.py docs/results --output runs/results

Writes ``tables.md``, ``training.png`` (success and average reward over episodes and steps) and
``evaluations.png`` (greedy success in the validation world over steps). What varies is the run, not
the episode: intervals are for other runs, or for other runs and pairs of start and goal, and tests
compare the means of runs (``navigation/intervals.py``).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from navigation import files
from navigation.figures import Runs, plot_evaluations, plot_training
from navigation.records import read_table
from navigation.tables import (
    comparison_table,
    interval_table,
    outcome_table,
    power_lines,
    speed_table,
)
from torchrl_mpfa.saving import write_text_atomically

_OF_A_GENERATOR = r"^([a-z]+)(?:-validation|-test)?-\d+(?:@.*)?$"


def read_studies(folders: Sequence[Path]) -> pd.DataFrame:
    """The evaluation episodes of studies.

    Args:
        folders: Their folders; seeds in two of them are two runs.

    Returns:
        The rows of ``compare.py``; with ``arm`` (learner and method), ``run`` (its name, unique in
        its arm), ``path`` (its folder) and ``family``: the generator of its world, or the world.
    """
    tables = []
    for folder in folders:
        found = read_table(folder / files.EPISODES)
        if not len(found):
            continue
        seed = found["seed"].astype(str)
        found["arm"] = found["learner"] + "/" + found["method"]
        found["run"] = seed if len(folders) == 1 else folder.name + "/" + seed
        name = found["learner"] + "-" + found["method"] + "-" + seed
        found["path"] = [str(folder / each) for each in name]
        generator = found["world"].str.extract(_OF_A_GENERATOR, expand=False)
        found["family"] = generator.fillna(found["world"])
        tables.append(found)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def tables_of_runs(rows: pd.DataFrame, name: str) -> Runs:
    """A table of each run's own folder, by arm and run; runs without it are left out."""
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for (arm, run, path), _ in rows.groupby(["arm", "run", "path"], sort=False):
        table = read_table(Path(str(path)) / name)
        if len(table):
            found.setdefault(str(arm), {})[str(run)] = table
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the rows, write tables and figures.

    Args:
        arguments: The command line.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", help="folders of studies")
    parser.add_argument("--output", type=Path, help="folder (default: that of the first study)")
    options = parser.parse_args(arguments)
    output = options.output or options.folders[0]
    rows = read_studies(options.folders)
    if not len(rows):
        folders = ", ".join(str(folder) for folder in options.folders)
        parser.error(f"{folders}: no {files.EPISODES} with rows, which compare.py writes")
    output.mkdir(parents=True, exist_ok=True)
    parts = []
    for family, found in rows.groupby("family", sort=False):
        parts += [
            f"## {family}",
            outcome_table(found, with_paper=family == "test"),
            interval_table(found),
            comparison_table(found),
            power_lines(found),
        ]
    training = tables_of_runs(rows, files.EPISODES)
    if training:
        plot_training(training, output / "training.png")
    evaluations = tables_of_runs(rows, files.EVALUATIONS)
    if evaluations:
        parts += ["## Evaluations during training", speed_table(evaluations)]
        plot_evaluations(evaluations, output / "evaluations.png")
    text = "\n\n".join(part for part in parts if part)
    write_text_atomically(text + "\n", output / "tables.md")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
