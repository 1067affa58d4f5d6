"""Tables of the runs on goal tasks, from their kept rows."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

import pandas as pd

from benchmarks.goals.arms import ARMS, EVERY, EXPLORATORY, PARTS, PLANNED, SB3, STEPS
from benchmarks.planned import Planned, planned_table
from training.comparison.report import interval, number, table
from training.records import area_under, read_table
from training.statistics import Array, mean_interval

KEPT = Path(__file__).parents[2] / "docs" / "results" / "goals.csv"
SEARCHED, EXPLORED, BESIDE = (
    KEPT.with_name(f"goals_{name}.csv") for name in ("search", "exploratory", "beside")
)
SAMPLED: Final = {
    "share/reward": "share of the reward",
    "share/td_error": "of the TD error",
    "share/action_gradient": "of the action gradient",
    "positive_fraction_buffer": "positive in the buffer",
    "positive_fraction_batch": "positive in a batch",
    "effective_sample_size": "effective sample size",
}
"""What is kept of the statistics of a replay (``docs/metrics.md``), and how a table names it."""


def sampled_of(kept: Path) -> Path:
    """Return the file of what was sampled, beside that of the scores."""
    return kept.with_name(f"{kept.stem}_replay.csv")


def areas(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the area under the curve of each run."""
    found = [
        {"task": task, "method": arm, "seed": seed, "area": area_under(of["steps"], of["score"])}
        for (task, arm, seed), of in rows.groupby(["task", "method", "seed"])
    ]
    return pd.DataFrame(found)


def tables(kept: Path = KEPT) -> str:
    """Return what the design planned, a table of each task, and what was sampled."""
    rows = read_table(kept)
    of_runs = areas(rows)
    parts = [planned_differences(of_runs)]
    for task in [name for name in STEPS if (rows["task"] == name).any()]:
        parts += [f"## {task}", task_table(rows[rows["task"] == task], of_runs)]
    if sampled_of(kept).exists():
        parts += ["## What was sampled", sampled_table(read_table(sampled_of(kept)))]
    return "\n\n".join(parts)


def planned_differences(of_runs: pd.DataFrame) -> str:
    """Return the planned table, or which runs it still needs."""
    # Stable-Baselines3 and a task that is apart are in no planned comparison.
    areas_of = of_runs[of_runs["task"].isin(PLANNED) & of_runs["method"].isin(list(ARMS))]
    runs = areas_of.pivot_table("area", "seed", ["method", "task"])
    runs = runs.reindex(columns=pd.MultiIndex.from_product([list(ARMS), PLANNED]))
    short = runs.isna().any() | (not len(runs))
    if short.any():
        names = [f"{arm} on {task}" for (arm, task), lacks in short.items() if lacks]
        return f"The planned comparisons need more runs: {', '.join(names)}."
    mean = runs.T.groupby(level=0).mean()

    def planned(ours: str, theirs: str) -> Planned:
        sides = ({str(s): float(v) for s, v in mean.loc[arm].items()} for arm in (ours, theirs))
        return Planned(f"{ours} − {theirs}", "area, mean of the tasks", *sides)

    uniform, her, per, mpfa, halves = ARMS
    primary = [planned(per, her)]
    secondary = [planned(mpfa, per), planned(halves, her), planned(her, uniform)]
    return planned_table(primary, secondary)


def task_table(rows: pd.DataFrame, of_runs: pd.DataFrame) -> str:
    """Return a task's areas and last scores: means, their intervals, and each run."""
    task, lines = rows["task"].iloc[0], []
    for arm in [name for name in EVERY if (rows["method"] == name).any()]:
        own = of_runs[(of_runs["task"] == task) & (of_runs["method"] == arm)]["area"].to_numpy()
        of_arm = rows[rows["method"] == arm].sort_values("steps")
        last = of_arm.groupby("seed")["score"].last().to_numpy()
        line = [arm]
        for found in (own, last):
            middle = mean_interval(found)
            line += [number(middle.value), interval(middle, [found], number)]
        lines.append([*line, ", ".join(f"{value:.2f}" for value in own)])
    return table(["arm", "area", "95 %", "at the end", "95 %", "area of each run"], lines)


def unplanned_table(kept: Path = KEPT, explored: Path = EXPLORED) -> str:
    """Return differences in each planned task and in their mean, of which few were planned."""
    rows = pd.concat([read_table(kept), read_table(explored)])
    runs = areas(rows).pivot(index=["method", "seed"], columns="task", values="area")
    runs = runs[list(PLANNED)].assign(mean=runs[list(PLANNED)].mean(axis=1))
    _, her, per, mpfa, halves = ARMS
    lines = []
    pairs = [(per, her), (mpfa, per), (mpfa, her), (halves, her)]
    pairs += [(mpfa, part) for part in PARTS if part in runs.index]
    for ours, theirs in pairs:
        gaps = (runs.loc[ours] - runs.loc[theirs]).dropna()
        found = [difference(gaps[name].to_numpy()) for name in gaps]
        lines.append([f"{ours} − {theirs}", *(" ".join(each) for each in found)])
    return table(["unplanned", *PLANNED, "mean"], lines)


def peer_table(kept: Path = KEPT, beside: Path = BESIDE) -> str:
    """Return the difference of Stable-Baselines3's HER and ours, on the seeds that both have."""
    rows = areas(pd.concat([read_table(kept), read_table(beside)]))
    runs = rows.pivot(index=["task", "seed"], columns="method", values="area")
    gaps = (runs[SB3] - runs["HER"]).dropna()
    lines = []
    for task in [name for name in STEPS if name in gaps.index]:
        own = gaps.loc[task].to_numpy()
        lines.append([task, str(len(own)), *difference(own)])
    return table(["task", "seeds", f"{SB3} − HER", "95 %"], lines)


def difference(gaps: Array) -> tuple[str, str]:
    """Return the mean of differences by seed, and its interval; of none two empty words."""
    if not len(gaps):
        return "", ""
    signed = partial(number, sign=True)
    middle = mean_interval(gaps)
    return signed(middle.value), interval(middle, [gaps], signed)


def explored_table(explored: Path = EXPLORED, kept: Path = KEPT) -> str:
    """Return the areas of exploratory arms, and their differences from HER on the same seeds."""
    rows = areas(pd.concat([read_table(explored), read_table(kept)]))
    runs = rows.pivot(index=["method", "seed"], columns="task", values="area")
    runs = runs.loc[:, [task for task in STEPS if task in set(read_table(explored)["task"])]]
    lines = []
    for arm in [name for name in EXPLORATORY if name in runs.index]:
        line, gaps = [arm], runs.loc[arm] - runs.loc["HER"]
        for task in runs:
            own = gaps[task].dropna()
            area = runs.loc[arm][task][own.index].mean()
            line.append(f"{number(area)} ({len(own)})" if len(own) else "")
            line.append(" ".join(difference(own.to_numpy())))
        lines.append([*line, " ".join(difference(gaps.dropna().mean(axis=1).to_numpy()))])
    heads = [head for task in runs for head in (f"{task} (runs)", "− HER")]
    return table(["arm", *heads, "− HER, mean of the tasks"], lines)


def sampled_table(rows: pd.DataFrame) -> str:
    """Return what was sampled in each task: means over evaluations after updates, and runs."""
    learned = rows.dropna(subset="effective_sample_size")
    lines = []
    for (task, arm), found in learned.groupby(["task", "method"], sort=False):
        means = found[list(SAMPLED)].mean().tolist()
        lines.append([str(task), str(arm), *("" if v != v else number(v) for v in means)])
    return table(["task", "arm", *SAMPLED.values()], lines)
