"""Figure 3: TD errors and rewards of DDPG with PER over 200 episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.paper.rows import write_rows
from benchmarks.paper.runs import SEEDS, SETTINGS, finished
from mpfa_envs.render.charts import Curve, draw_seeds, finish, new_figure
from training import files
from training.comparison.jobs import Comparison, Evaluation
from training.comparison.report import p_text, table
from training.figures import running_mean
from training.records import read_table
from training.statistics import mean_interval, sign_p

FILE = "figure_3.csv.gz"
"""Rows of seed, measure, episode and value."""
EPISODES = 200
_STAGES = f"curriculum.stages=[{{world: A, episodes: {EPISODES}}}]"
MEASURES = {"td_error": "mean size of TD errors", "reward": "reward per step"}
_WINDOWS = ((61, 80), (181, 200))
"""Episodes between which the paper's TD error rises."""
_SMOOTH = 10
"""Episodes of the running mean of a reward."""


def figure_3(folder: Path) -> Comparison:
    """Return the runs of Fig. 3; their policies are tested once, as no table needs more."""
    evaluation = Evaluation(("test",), episodes=1)
    return Comparison(
        folder / "figure_3", ("per",), (*SETTINGS, _STAGES), SEEDS, evaluation=evaluation
    )


def keep_figure_3(planned: Comparison, rows: Path) -> int:
    """Write the rows of the finished runs; return their number."""
    tables = []
    for _, job in finished([planned]):
        updates = read_table(job.path / "updates.csv").dropna(subset=["td_error"])
        # Of several rows in an episode the mean, in the order of the episodes.
        errors = updates.groupby("episode")["td_error"].mean()
        episodes = read_table(job.path / files.EPISODES)
        rewards = pd.Series(
            (episodes["reward"] / episodes["steps"]).to_numpy(), index=np.arange(len(episodes))
        )
        for name, values in (("td_error", errors), ("reward", rewards)):
            tables.append(
                pd.DataFrame(
                    {
                        "seed": job.seed,
                        "measure": name,
                        "episode": values.index.to_numpy() + 1,
                        "value": values.to_numpy().round(4),
                    }
                )
            )
    if tables:
        write_rows(pd.concat(tables), rows / FILE)
    return len(tables) // len(MEASURES)


def curves_of(rows: Path, measure: str) -> list[Curve]:
    """Return the curve of each run."""
    found = read_table(rows / FILE)
    if not len(found):
        return []
    runs = found[found["measure"] == measure].groupby("seed")
    return [(run["episode"].to_numpy(), run["value"].to_numpy()) for _, run in runs]


def plot_figure_3(rows: Path, path: Path) -> bool:
    """Plot TD errors and rewards over the episodes; return False without runs."""
    errors, rewards = (curves_of(rows, measure) for measure in MEASURES)
    if not errors:
        return False
    smooth = [(steps, running_mean(pd.Series(values), _SMOOTH)) for steps, values in rewards]
    figure, axes = new_figure(2, 1, panel=(7, 3), sharex=True)
    for axis, curves, label in zip(axes, (errors, smooth), MEASURES.values(), strict=True):
        draw_seeds(axis, {"PER": curves})
        axis.set(ylabel=label)
    axes[-1].set_xlabel("episode")
    finish(figure, axes, path)
    return True


def errors_table(rows: Path) -> str:
    """Return the means of two parts of the training, and their difference; empty without runs."""
    lines = []
    for measure, label in MEASURES.items():
        curves = curves_of(rows, measure)
        if not curves:
            return ""
        parts = [
            np.array([_mean_within(curve, first, last) for curve in curves])
            for first, last in _WINDOWS
        ]
        gaps = parts[1] - parts[0]
        texts = [
            f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]"
            for found in map(mean_interval, (*parts, gaps))
        ]
        lines.append([label, *texts, p_text(sign_p(gaps)), str(len(curves))])
    spans = [f"episodes {first} to {last}, 95 %" for first, last in _WINDOWS]
    return table(["Fig. 3", *spans, "difference, 95 %", "p", "runs"], lines)


def _mean_within(curve: Curve, first: int, last: int) -> float:
    """Return the mean of a curve over some episodes."""
    episodes, values = curve
    inside = (np.asarray(episodes) >= first) & (np.asarray(episodes) <= last)
    return float(np.asarray(values)[inside].mean())
