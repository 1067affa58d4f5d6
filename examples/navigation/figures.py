"""Pictures of how runs learn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from mpfa_envs.render.charts import draw_seeds, finish, look, new_figure, plot_seeds

Runs = Mapping[str, Mapping[str, pd.DataFrame]]
"""Tables by the name of their arm, then of their run."""


def plot_learning_curve(episodes: pd.DataFrame, path: Path, *, window: int = 20) -> None:
    """Plot success and average reward over the episodes of a run, and where its world changes.

    Args:
        episodes: A row for each training episode.
        path: The PNG file.
        window: Episodes of the running mean.
    """
    figure, axes = new_figure(2, 1, panel=(7, 2.5), sharex=True)
    number = np.arange(1, len(episodes) + 1)
    worlds = episodes["world"].to_numpy()
    labels = {"success": "success rate", "average_reward": "average reward per step"}
    for axis, (name, label) in zip(axes, labels.items(), strict=True):
        axis.plot(number, episodes[name].astype(float), ".", color="0.75", markersize=3)
        axis.plot(number, running_mean(episodes[name], window), color=look(0)["color"])
        axis.set_ylabel(label)
        for change in np.flatnonzero(worlds[1:] != worlds[:-1]):
            axis.axvline(change + 1.5, color="0.5", linestyle=":")
    axes[0].set_title(f"mean of {window} episodes; dots are single ones")
    axes[1].set_xlabel("episode")
    finish(figure, axes, path)


def plot_training(runs: Runs, path: Path, *, window: int = 20) -> None:
    """Plot success and average reward of the training episodes, over episodes and over steps.

    Each arm has the mean of its runs and the 95 % interval of that mean.

    Args:
        runs: Tables with a row for each training episode.
        path: The PNG file.
        window: Episodes of the running mean.
    """
    figure, axes = new_figure(2, 2, panel=(5, 3), sharey="row")
    labels = {"success": "success rate", "average_reward": "average reward per step"}
    for row, (name, label) in enumerate(labels.items()):
        for column, x in enumerate(("episode", "step")):
            axis = axes[2 * row + column]
            curves = {
                arm: [_smoothed(each, name, x, window) for each in tables.values()]
                for arm, tables in runs.items()
            }
            draw_seeds(axis, curves, limits=(0.0, 1.0) if name == "success" else None)
            axis.set_xlabel(x if row else "")
            if row or column:
                axis.get_legend().remove()
        axes[2 * row].set_ylabel(f"{label}, mean of {window}")
    finish(figure, axes, path)


def _smoothed(table: pd.DataFrame, name: str, x: str, window: int) -> tuple[Any, Any]:
    """A column's running mean over the episodes of a run, or over the steps at their ends."""
    values = running_mean(table[name], window)
    if x == "episode":
        return np.arange(1, len(table) + 1), values
    # Of robots whose episodes ended at one step, the last one's mean has all of them in it.
    steps = table["total_steps"].to_numpy()
    last = np.append(steps[1:] != steps[:-1], True)
    return steps[last], values[last]


def plot_evaluations(runs: Runs, path: Path) -> None:
    """Plot greedy success in the validation world over the steps, and when 90 % were reached.

    Args:
        runs: Tables with a row for each evaluation.
        path: The PNG file.
    """
    curves = {
        arm: [(each["total_steps"], each["success"]) for each in tables.values()]
        for arm, tables in runs.items()
    }
    ylabel = "greedy success in the validation world"
    plot_seeds(curves, path, xlabel="step", ylabel=ylabel)


def running_mean(values: pd.Series[Any], window: int) -> NDArray[np.float64]:
    """Mean of the last ``window`` values, of fewer at the start."""
    return values.astype(float).rolling(window, min_periods=1).mean().to_numpy()
