"""The paper's Figures 3, 5, 8 to 11 and 13 from kept rows: mean over runs and its 95 % interval."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper.errors import plot_figure_3
from benchmarks.paper.published import CURVES, NAMES, PHIS, TABLE_4
from benchmarks.paper.rows import Rows
from mpfa_envs.render.charts import Curve, draw_seeds, finish, new_figure
from training.figures import running_mean

MAPS = "ABCD"
_EPISODES = 10
"""Episodes of the running mean of a reward."""
_BLOCK = 10_000
"""Steps of a point in Fig. 13."""
_REWARD = f"reward per step, mean of {_EPISODES} episodes"
_METHODS = {name: method for method, name in NAMES.items()}
"""Method of each of the paper's names, which has its own color."""


def plot_figures(rows: Rows, folder: Path) -> list[Path]:
    """Plot the figures that have runs; return their files."""
    made = []
    for number in (3, 5, *CURVES, 13):
        path = folder / f"figure_{number}.png"
        if number == 3:
            drawn = plot_figure_3(rows.folder, path)
        elif number in CURVES:
            drawn = plot_rewards_by_map(rows, CURVES[number], path)
        else:
            drawn = (plot_figure_5 if number == 5 else plot_figure_13)(rows, path)
        if drawn:
            made.append(path)
    return made


def plot_figure_5(rows: Rows, path: Path) -> bool:
    """Plot Fig. 5, the average reward in map A with φ = 2, 3 and 4; return False without runs."""
    runs = {
        f"φ = {phi}": rewards(rows.episodes(f"ddpg-mpfa_per-phi{phi}").values(), MAPS[0])
        for phi in PHIS
    }
    if not any(runs.values()):
        return False
    figure, (axis,) = new_figure(panel=(7, 4))
    draw_seeds(axis, runs)
    axis.set(xlabel="episode", ylabel=_REWARD)
    _finish(figure, [axis], path)
    return True


def plot_rewards_by_map(rows: Rows, methods: Sequence[str], path: Path) -> bool:
    """Plot Figs. 8 to 11, the average reward in each map; return False without runs."""
    episodes = {NAMES[name]: rows.episodes(f"ddpg-{name}") for name in methods}
    if not any(episodes.values()):
        return False
    figure, axes = new_figure(2, 2, panel=(5, 3.5), sharey=True)
    for axis, world in zip(axes, MAPS, strict=True):
        runs = {name: rewards(found.values(), world) for name, found in episodes.items()}
        draw_seeds(axis, runs, methods=_METHODS)
        axis.set(title=f"map {world}", xlabel="episode in this map")
        if axis is not axes[0]:
            axis.get_legend().remove()
    for axis in axes[::2]:
        axis.set_ylabel(_REWARD)
    _finish(figure, axes, path)
    return True


def plot_figure_13(rows: Rows, path: Path) -> bool:
    """Plot Fig. 13, the total reward of every 10,000 steps; return False without runs."""
    runs = {
        NAMES[name]: [reward_of_blocks(each) for each in rows.episodes(f"ddpg-{name}").values()]
        for name in NAMES
        if name in TABLE_4
    }
    if not any(runs.values()):
        return False
    figure, (axis,) = new_figure(panel=(8, 5))
    draw_seeds(axis, runs, methods=_METHODS)
    axis.set(xlabel="step", ylabel=f"total reward of {_BLOCK:,} steps")
    _finish(figure, [axis], path)
    return True


def _finish(figure: Any, axes: Sequence[Any], path: Path) -> None:
    """Write a figure whose heights fit the means: the interval of two runs is larger than all."""
    heights = np.concatenate([line.get_ydata() for axis in axes for line in axis.get_lines()])
    low, high = heights.min(), heights.max()
    axes[0].set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
    finish(figure, axes, path)


def rewards(runs: Iterable[pd.DataFrame], world: str) -> list[Curve]:
    """Return reward per step over the episodes of each run in a world, smoothed."""
    found = []
    for episodes in runs:
        here = episodes[episodes["world"] == world]
        if len(here):
            values = running_mean(here["reward"] / here["steps"], _EPISODES)
            found.append((np.arange(1, len(here) + 1), values))
    return found


def reward_of_blocks(episodes: pd.DataFrame, *, steps: int = _BLOCK) -> Curve:
    """Return the total reward of every so many steps of a run, whole blocks alone.

    The reward of an episode counts in the block in which the episode ended.
    """
    ends = episodes["total_steps"]
    block = -(-ends // steps)
    whole = block * steps <= ends.max()
    totals = episodes["reward"][whole].groupby(block[whole] * steps).sum()
    return totals.index.to_numpy(), totals.to_numpy()
