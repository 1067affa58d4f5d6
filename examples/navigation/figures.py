"""Pictures of how runs learn."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Runs = Mapping[str, Mapping[str, pd.DataFrame]]
"""Tables by the name of their arm, then of their run."""


def plot_learning_curve(episodes: pd.DataFrame, path: Path, *, window: int = 20) -> None:
    """Plot success and average reward over the episodes of a run, and where its world changes.

    Args:
        episodes: A row for each training episode.
        path: The PNG file.
        window: Episodes of the running mean.
    """
    figure, axes = pyplot().subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
    number = np.arange(1, len(episodes) + 1)
    worlds = episodes["world"].to_numpy()
    labels = {"success": "success rate", "average_reward": "average reward per step"}
    for axis, (name, label) in zip(axes, labels.items(), strict=True):
        axis.plot(number, episodes[name].astype(float), ".", color="0.75", markersize=3)
        axis.plot(number, running_mean(episodes[name], window), color="tab:blue")
        axis.set_ylabel(label)
        for change in np.flatnonzero(worlds[1:] != worlds[:-1]):
            axis.axvline(change + 1.5, color="0.5", linestyle=":")
    axes[0].set_title(f"mean of {window} episodes; dots are single ones")
    axes[1].set_xlabel("episode")
    finish(figure, axes, path)


def plot_training(runs: Runs, path: Path, *, window: int = 20) -> None:
    """Plot success and average reward of the training episodes, over episodes and over steps.

    Args:
        runs: Tables with a row for each training episode.
        path: The PNG file.
        window: Episodes of the running mean.
    """
    figure, axes = pyplot().subplots(2, 2, figsize=(10, 6), sharey="row", layout="constrained")
    labels = {"success": "success rate", "average_reward": "average reward per step"}
    for place, (arm, tables) in enumerate(runs.items()):
        for number, table in enumerate(tables.values()):
            for line, name in enumerate(labels):
                values = running_mean(table[name], window)
                for column, x in enumerate((np.arange(1, len(table) + 1), table["total_steps"])):
                    label = arm if number == 0 else None
                    axes[line, column].plot(x, values, **look(place), alpha=0.6, lw=1, label=label)
    for line, title in enumerate(labels.values()):
        axes[line, 0].set_ylabel(f"{title}, mean of {window}")
    axes[1, 0].set_xlabel("episode")
    axes[1, 1].set_xlabel("step")
    axes[0, 1].legend()
    finish(figure, axes.flat, path)


def plot_evaluations(runs: Runs, path: Path) -> None:
    """Plot greedy success in the validation world over the steps, a line for each run.

    Args:
        runs: Tables with a row for each evaluation.
        path: The PNG file.
    """
    figure, axis = pyplot().subplots(figsize=(7, 4), layout="constrained")
    for place, (arm, tables) in enumerate(runs.items()):
        for number, table in enumerate(tables.values()):
            axis.plot(
                table["total_steps"],
                table["success"],
                **look(place),
                alpha=0.7,
                marker=".",
                label=arm if number == 0 else None,
            )
    axis.set(xlabel="step", ylabel="greedy success in the validation world", ylim=(-0.02, 1.02))
    axis.legend()
    finish(figure, [axis], path)


def running_mean(values: pd.Series[Any], window: int) -> NDArray[np.float64]:
    """Mean of the last ``window`` values, of fewer at the start."""
    return values.astype(float).rolling(window, min_periods=1).mean().to_numpy()


def look(place: int) -> dict[str, str]:
    """Color of an arm's lines, and another dash once all ten colors are taken."""
    return {"color": f"C{place % 10}", "linestyle": ("-", "--", ":", "-.")[place // 10 % 4]}


def pyplot() -> Any:
    """Matplotlib's pyplot, which draws to files alone; imported where a figure is made."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def finish(figure: Any, axes: Iterable[Any], path: Path) -> None:
    """Give the axes of a figure their grids, and write it to a file."""
    for axis in axes:
        axis.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    pyplot().close(figure)
