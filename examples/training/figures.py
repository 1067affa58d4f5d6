"""Pictures of how runs learn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from mpfa_envs.render.charts import Curve, draw_seeds, finish, look, new_figure, plot_seeds

Runs = Mapping[str, Mapping[str, pd.DataFrame]]
"""Tables by the name of their arm, then of their run."""
_SPREAD = 6
"""Fewest runs with an interval of the mean; of fewer runs it would fill the panel."""


def plot_learning_curve(episodes: pd.DataFrame, path: Path, *, window: int = 20) -> None:
    """Plot success and average reward over the episodes of a run, and where its world changes."""
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


def plot_evaluations(runs: Runs, path: Path) -> None:
    """Plot greedy success in the validation world over the actions, and when 90 % were reached.

    Of a few runs of an arm each is a thin line, else there is the interval of their mean.
    """
    curves = {
        arm: [(each["total_steps"], each["success"]) for each in tables.values()]
        for arm, tables in runs.items()
    }
    few = max(map(len, curves.values())) < _SPREAD
    ylabel = "greedy success in the validation world"
    plot_seeds(curves, path, ylabel=ylabel, band="runs" if few else "interval")


def plot_scores(
    tasks: Mapping[str, Mapping[str, Mapping[str, Curve]]], path: Path, *, columns: int = 3
) -> None:
    """Plot the curves of each task in a panel of its own, a method in the same color in all.

    Args:
        tasks: Curves by task, method and run.
        path: The PNG file.
        columns: Panels side by side at most.
    """
    methods = dict.fromkeys(method for runs in tasks.values() for method in runs)
    columns = min(len(tasks), columns)
    figure, axes = new_figure(-(-len(tasks) // columns), columns, panel=(5.0, 3.6))
    for axis, (task, runs) in zip(axes, tasks.items(), strict=False):
        # A method without a run here keeps its color.
        curves = {method: list(runs.get(method, {}).values()) for method in methods}
        few = max(map(len, curves.values())) < _SPREAD
        draw_seeds(axis, curves, band="runs" if few else "interval")
        axis.set(xlabel="steps", ylabel="score", title=task)
    for axis in axes[len(tasks) :]:
        axis.remove()
    finish(figure, axes[: len(tasks)], path)


def running_mean(values: pd.Series[Any], window: int) -> NDArray[np.float64]:
    """Mean of the last ``window`` values, of fewer at the start."""
    return values.astype(float).rolling(window, min_periods=1).mean().to_numpy()
