"""Make tables and figures of studies, from the rows that ``compare.py`` kept; trains nothing.

    python examples/report.py runs/compare
    python examples/report.py runs/compare runs/more           the runs of both together
    python examples/report.py docs/results --output runs/results

Writes ``tables.md`` and ``evaluations.png`` (greedy success in the validation world over actions;
the training of each run has a ``learning_curve.png`` in its folder). The arms of a study
(``compare.py --arm``) have rows and lines of their own, and evaluations with other physics have
tables of their own. The unit is the run, not the episode: intervals are over runs, or over runs and
pairs of start and goal, and tests compare the means of runs; see
``training/report/intervals.py``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import training.extra  # noqa: F401

# isort: split
import pandas as pd

from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.jobs import run_name
from training.figures import Runs, plot_evaluations
from training.records import read_table
from training.report.tables import (
    comparison_table,
    interval_table,
    outcome_table,
    power_lines,
    rate_table,
    speed_table,
    success_table,
)
from training.worlds import family


def read_studies(folders: Sequence[Path]) -> pd.DataFrame:
    """The evaluation episodes of studies.

    Args:
        folders: Their folders; seeds in two of them are two runs.

    Returns:
        The rows of ``compare.py``; with ``arm`` (learner, method and the arm of the study, if it
        has any), ``run`` (its name, unique in its arm), ``path`` (its folder) and ``family``: the
        split of a generator that its world is of, BARN, or the world; studies that are older than
        ``physics`` have an empty one.
    """
    names = [folder.name for folder in folders]
    tables = []
    for folder in folders:
        found = read_table(folder / files.EPISODES)
        if not len(found):
            continue
        missing = [name for name in ("learner", "method", "seed", "world") if name not in found]
        if missing:
            raise ValueError(
                f"{folder / files.EPISODES} has no column {missing[0]}: name the folder of a "
                "study, which compare.py made, not that of a run"
            )
        for column in ("arm", "physics"):
            found[column] = found[column].fillna("") if column in found else ""
        words = found[["learner", "method", "arm", "seed"]]
        found["path"] = [str(folder / run_name(*each)) for each in words.itertuples(index=False)]
        found["arm"] = words[["learner", "method", "arm"]].agg("/".join, axis=1).str.rstrip("/")
        seed = found["seed"].astype(str)
        name = str(folder) if names.count(folder.name) > 1 else folder.name
        found["run"] = seed if len(folders) == 1 else f"{name}/" + seed
        found["family"] = found["world"].map(family)
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
    parser.add_argument("--output", type=Path, help="folder (default: the first study's)")
    options = parser.parse_args(arguments)
    output = options.output or options.folders[0]
    there = [folder.resolve() for folder in options.folders]
    for folder, path in zip(options.folders, there, strict=True):
        if there.count(path) > 1:
            parser.error(f"{folder} is named twice: its runs count once")
    try:
        files.check_folder(output)
        return report(options.folders, output)
    except ValueError as error:
        parser.error(" ".join(str(error).split()))


def report(folders: Sequence[Path], output: Path) -> int:
    """Write tables and figures of some studies.

    Args:
        folders: Their folders.
        output: Where they go.

    Returns:
        Exit status.

    Raises:
        ValueError: If there are no rows, or none that can be read.
    """
    rows = read_studies(folders)
    if not len(rows):
        names = ", ".join(str(folder) for folder in folders)
        raise ValueError(f"{names}: no {files.EPISODES} with rows, which compare.py writes")
    output.mkdir(parents=True, exist_ok=True)
    parts = []
    for physics, driven in rows.groupby("physics", sort=False):
        how = f", {physics!s}" if physics else ""
        for where, found in driven.groupby("family", sort=False):
            parts += [
                f"## {where}{how}",
                outcome_table(found),
                interval_table(found),
                comparison_table(found),
                power_lines(found),
            ]
        if driven["family"].nunique() > 1:
            parts += [f"## Success in all worlds{how}", success_table(driven)]
    evaluations = tables_of_runs(rows, files.EVALUATIONS)
    if evaluations:
        parts += [
            "## Evaluations during training",
            speed_table(evaluations),
            rate_table(evaluations),
        ]
        plot_evaluations(evaluations, output / "evaluations.png")
    text = "\n\n".join(part for part in parts if part)
    write_text_atomically(text + "\n", output / "tables.md")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
