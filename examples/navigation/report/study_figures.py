"""Pictures of the study: curves, profiles, arms side by side, and replay volume by method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mpfa_envs.render.charts import finish, look, new_figure
from navigation.report.intervals import (
    Array,
    mean_interval,
    performance_profile,
    resampled_means,
    widened_ends,
)
from navigation.report.study_rows import Rows, by_run, scores_of
from navigation.report.study_tables import MEASURES
from navigation.studies.protocol import HEIGHT, OF_VOLUMES, VOLUMES, Table, short_names

_LEVELS = np.linspace(0.0, 1.0, 201)
_SIZE = (5.0, 3.6)
"""Of a panel [inch]."""


def plot_study(table: Table, rows: Rows, folder: Path) -> list[Path]:
    """Plot the figures of a table, of what runs there are.

    Args:
        table: The table.
        rows: Its rows.
        folder: Where they go.

    Returns:
        The files.
    """
    scores = scores_of(rows, table)
    if not scores:
        return []
    panels = {title: arms for title, arms in table.panels.items() if set(arms) & set(scores)}
    table = replace(table, panels=panels)
    paths = [folder / f"{table.name}_{name}.png" for name in ("curves", "profiles", "arms")]
    plot_curves(table, rows, paths[0])
    plot_profiles(table, scores, paths[1])
    plot_arms(table, scores, paths[2])
    if table.name == "D":
        paths.append(folder / f"{table.name}_volumes.png")
        plot_volumes(scores, paths[-1])
    return paths


def mean_curve(curves: Sequence[pd.Series[Any]], rng: np.random.Generator) -> Array:
    """Mean of curves that begin at zero, with the 95 % interval of the bootstrap over runs.

    Args:
        curves: Greedy success by action, one for each run.
        rng: Source of the resamples.

    Returns:
        Actions, mean, lower and upper end, shape ``[4, points]``, to the end of the shortest run.
    """
    last = min(curve.index.max() for curve in curves)
    steps = np.unique([0, *(step for curve in curves for step in curve.index if step <= last)])
    heights = np.stack(
        [np.interp(steps, [0, *curve.index], [0.0, *curve.to_numpy()]) for curve in curves], axis=1
    )
    low, high = widened_ends(resampled_means(heights, rng), len(curves))
    return np.stack((steps, heights.mean(axis=1), low.clip(0.0, 1.0), high.clip(0.0, 1.0)))


def plot_curves(table: Table, rows: Rows, path: Path) -> None:
    """Plot what a table has over actions, the mean of the runs and its interval.

    Args:
        table: Says which arms share a panel.
        rows: Its rows.
        path: The PNG file.
    """
    rng = np.random.default_rng(0)
    curves: dict[str, list[pd.Series[Any]]] = {}
    for arm, _, each in by_run(rows.curves):
        series = pd.Series(each["success"].to_numpy(), index=each["total_steps"].to_numpy())
        curves.setdefault(arm, []).append(series)
    figure, axes = _panels(table)
    for axis, labels in zip(axes, table.panels.values(), strict=True):
        for place, name, label in _shown(labels, curves):
            steps, mean, low, high = mean_curve(curves[label], rng)
            style = look(place)
            axis.plot(steps, mean, **style, label=f"{name} ({len(curves[label])})")
            if len(curves[label]) > 1:
                axis.fill_between(steps, low, high, color=style["color"], alpha=0.15, lw=0)
        axis.set(xlabel="actions", ylabel=table.height, ylim=(-0.02, 1.02))
        _legend(axis)
    finish(figure, axes, path)


def plot_profiles(table: Table, scores: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Plot the share of runs above each value of the primary measure, with Wilson's intervals.

    Args:
        table: Says which arms share a panel.
        scores: The measures of each run, by arm.
        path: The PNG file.
    """
    figure, axes = _panels(table)
    known = {arm: runs[table.primary].dropna().to_numpy() for arm, runs in scores.items()}
    for axis, labels in zip(axes, table.panels.values(), strict=True):
        for place, name, label in _shown(labels, known):
            share, low, high = performance_profile(known[label], _LEVELS)
            style = look(place)
            axis.plot(_LEVELS, share, **style, label=name, drawstyle="steps-post")
            # Bands of all arms would hide each other.
            if place < 3:
                axis.fill_between(
                    _LEVELS, low, high, color=style["color"], alpha=0.12, lw=0, step="post"
                )
        axis.set(xlabel=table.primary, ylabel="share of runs above", ylim=(-0.02, 1.02))
        axis.margins(x=0.0)
        _legend(axis)
    finish(figure, axes, path)


def plot_arms(table: Table, scores: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Plot the primary measure of every arm: its runs, their mean and its 95 % interval.

    Args:
        table: Says which arms share a panel.
        scores: The measures of each run, by arm.
        path: The PNG file.
    """
    rng = np.random.default_rng(0)
    known = {arm: runs[table.primary].dropna().to_numpy() for arm, runs in scores.items()}
    figure, axes = _panels(table, tall=max(map(len, table.panels.values())) * 0.24 + 1.0)
    for axis, labels in zip(axes, table.panels.values(), strict=True):
        shown = sorted(_shown(labels, known), key=lambda each: known[each[2]].mean())
        for height, (place, _, label) in enumerate(shown):
            runs, color = known[label], look(place)["color"]
            found = mean_interval(runs, rng=rng)
            axis.plot(runs, np.full(len(runs), height), ".", color=color, alpha=0.3)
            ends = np.clip([found.low, found.high], 0.0, 1.0)
            axis.plot(ends, [height, height], color=color, lw=2)
            axis.plot(found.value, height, "o", color=color)
        axis.set_yticks(range(len(shown)), [name for _, name, _ in shown])
        axis.set_xlabel(f"{table.primary}; dots are runs")
    finish(figure, axes, path)


def plot_volumes(scores: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Plot the area by replay volume and method, colored by the difference from uniform replay.

    Args:
        scores: The measures of each run of table D, by arm.
        path: The PNG file.
    """
    volumes = {"sparse": tuple(VOLUMES), "dense": (32, 256)}
    widths = [len(each) for each in volumes.values()]
    figure, axes = new_figure(1, 2, panel=(5, 4), width_ratios=widths)
    for axis, (reward, of) in zip(axes, volumes.items(), strict=True):
        gaps = np.full((len(OF_VOLUMES), len(of)), np.nan)
        for column, volume in enumerate(of):
            suffix = "" if volume == 32 else f"/v{volume}"
            uniform = scores.get(f"{reward}/td3/uniform{suffix}")
            for row, method in enumerate(OF_VOLUMES):
                runs = scores.get(f"{reward}/td3/{method}{suffix}")
                if runs is None or not len(runs):
                    continue
                areas, text = runs["area"], f"{runs['area'].mean():.2f}"
                # Of the same seeds, as in the tables; one run has no color.
                shared = (areas - uniform["area"]).dropna() if uniform is not None else areas[:0]
                if len(shared) > 1:
                    gaps[row, column] = gap = shared.mean()
                    text += f", {gap:+.2f}" if row else ""
                color = "white" if abs(np.nan_to_num(gaps[row, column])) > 0.14 else "black"
                text += f"\n{len(runs)} runs" if len(runs) > 1 else "\n1 run"
                axis.text(column, row, text, ha="center", va="center", color=color)
        image = axis.imshow(gaps, cmap="RdBu", vmin=-0.2, vmax=0.2, aspect="auto")
        axis.set_xticks(range(len(of)), [str(volume) for volume in of])
        axis.set_yticks(range(len(OF_VOLUMES)), OF_VOLUMES)
        axis.set(xlabel="replay volume", title=f"{reward} reward")
    axes[1].set_yticks([])
    figure.colorbar(image, ax=axes, label="area less that of uniform replay")
    figure.suptitle(MEASURES["area"].format(height=HEIGHT))
    finish(figure, [], path)


def _panels(table: Table, *, tall: float = _SIZE[1]) -> tuple[Any, list[Any]]:
    """A figure with a panel for each group of arms."""
    count = len(table.panels)
    columns = count if count < 4 else -(-count // 2)
    lines = -(-count // columns)
    figure, axes = new_figure(lines, columns, panel=(_SIZE[0], tall))
    for axis, title in zip(axes, table.panels, strict=False):
        axis.set_title(title)
    for axis in axes[count:]:
        axis.remove()
    return figure, axes[:count]


def _shown(labels: Sequence[str], there: Mapping[str, Any]) -> list[tuple[int, str, str]]:
    """Arms of a panel of which there are runs: place, name and label."""
    names = short_names(labels)
    return [
        (place, names[label], label)
        for place, label in enumerate(labels)
        if label in there and len(there[label])
    ]


def _legend(axis: Any) -> None:
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize="x-small", ncols=2)
