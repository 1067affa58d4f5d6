"""Pictures of the study: curves, profiles, arms side by side, and replay volume by method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.study.designs import KEY, OF_VOLUMES
from benchmarks.study.intervals import (
    Array,
    mean_interval,
    performance_profile,
    resampled_means,
    widened_ends,
)
from benchmarks.study.protocol import HEIGHT, Table, short_names
from benchmarks.study.rows import Rows, by_run, scores_of
from benchmarks.study.tables import FEWEST, MEASURES
from mpfa_envs.render.charts import finish, look, new_figure
from torchrl_mpfa.methods import METHODS

_LEVELS = np.linspace(0.0, 1.0, 201)
_SIZE = (3.6, 2.8)
"""Of a panel [inch]: two stand side by side in the column of a page, with legible words."""
_SMALL = (2.4, 2.0)
"""Of one of three side by side [inch]."""
_DPI = 160
_SPREAD = 4
"""An arm with fewer runs has no distribution to be seen."""
_GRAY = {"color": "0.5", "linestyle": "-"}
"""Of what an arm is compared with."""


def plot_study(table: Table, rows: Rows, folder: Path) -> list[Path]:
    """Plot the figures of a table, of the arms that have enough runs to be compared.

    While no arm has, those with the most runs are shown.
    """
    scores = scores_of(rows, table)
    if not scores:
        return []
    enough = min(FEWEST, max(len(runs) for runs in scores.values()))
    told = {arm: runs for arm, runs in scores.items() if len(runs) >= enough}
    panels: dict[str, tuple[str, ...]] = {}
    for title, arms in table.panels.items():
        there = tuple(arm for arm in arms if arm in told)
        # What an earlier panel has as well is there for comparison alone.
        if there and not any(set(there) <= set(other) for other in panels.values()):
            panels[title] = there
    table = replace(table, panels=panels)
    paths = [folder / f"{table.name}_curves.png"]
    plot_curves(table, rows, paths[0])
    if max(len(runs) for runs in told.values()) >= _SPREAD:
        paths += [folder / f"{table.name}_{name}.png" for name in ("profiles", "arms")]
        plot_profiles(table, told, paths[1])
        plot_arms(table, told, paths[2])
    if table.name == "D":
        paths.append(folder / f"{table.name}_volumes.png")
        plot_volumes(scores, paths[-1])
    return paths


def mean_curve(
    curves: Sequence[pd.Series[Any]], rng: np.random.Generator, *, from_zero: bool = True
) -> Array:
    """Mean of curves, with the 95 % interval of the bootstrap over runs.

    Args:
        curves: Greedy success by action, one for each run.
        rng: Source of the resamples.
        from_zero: Whether they begin at zero before the first action; else at their first point.

    Returns:
        Actions, mean, lower and upper end, shape ``[4, points]``, to the end of the shortest run.
    """
    last = min(curve.index.max() for curve in curves)
    steps = np.unique([0, *(step for curve in curves for step in curve.index if step <= last)])
    steps = steps if from_zero else steps[1:]
    heights = np.stack(
        [np.interp(steps, [0, *curve.index], [0.0, *curve.to_numpy()]) for curve in curves], axis=1
    )
    low, high = widened_ends(resampled_means(heights, rng), len(curves))
    return np.stack((steps, heights.mean(axis=1), low.clip(0.0, 1.0), high.clip(0.0, 1.0)))


def plot_curves(table: Table, rows: Rows, path: Path) -> None:
    """Plot what a table has over actions, each arm beside the one that it is compared with.

    That one, uniform replay where it is in the panel and else the first, is gray. Lines are means
    of the runs, bands their intervals; where these would fill the panel, thin lines are the runs.
    """
    rng = np.random.default_rng(0)
    curves: dict[str, list[pd.Series[Any]]] = {}
    for arm, _, each in by_run(rows.curves):
        series = pd.Series(each["success"].to_numpy(), index=each["total_steps"].to_numpy())
        curves.setdefault(arm, []).append(series)
    # A score is not zero before the training, other than the share of goals reached.
    zero = table.height == HEIGHT
    means = {arm: mean_curve(of, rng, from_zero=zero) for arm, of in curves.items()}
    compared = compared_arms(table.panels, curves)
    columns = min(3, len(compared))
    lines = -(-len(compared) // columns)
    figure, axes = new_figure(lines, columns, panel=_SMALL, sharey=True)
    for axis, (label, (title, name, style, other)) in zip(axes, compared.items(), strict=False):
        for arm, words, of in ((other[0], other[1], _GRAY), (label, name, style)):
            steps, mean, low, high = means[arm]
            axis.plot(steps, mean, **of, label=f"{words} ({len(curves[arm])})")
            if len(curves[arm]) >= _SPREAD:
                axis.fill_between(steps, low, high, color=of["color"], alpha=0.2, lw=0)
            for run in curves[arm] if len(curves[arm]) < _SPREAD else ():
                axis.plot(run, **of, lw=0.7, alpha=0.5)
        axis.set_title(title, fontsize="medium")
        axis.set_ylim(-0.02, 1.02)
        axis.xaxis.set_major_formatter(lambda actions, _: f"{actions / 1000:g}")
        axis.legend(fontsize="x-small", frameon=False, handlelength=1.0)
    for axis in axes[len(compared) :]:
        axis.remove()
    figure.supxlabel("thousand actions", fontsize="medium")
    figure.supylabel(table.height, fontsize="medium")
    finish(figure, axes[: len(compared)], path, dpi=_DPI)


def compared_arms(
    panels: Mapping[str, Sequence[str]], there: Mapping[str, Any]
) -> dict[str, tuple[str, str, dict[str, str], tuple[str, str]]]:
    """Arms that have a panel of curves: its title, name and look, and with what it is compared."""
    compared: dict[str, tuple[str, str, dict[str, str], tuple[str, str]]] = {}
    for title, labels in panels.items():
        shown = looks_of(labels, there)
        bases = [each for each in shown if _method_of(each[2]) == "uniform"] or shown
        for place, name, label in shown:
            # An arm of an earlier panel is there for comparison alone.
            if label != bases[0][2] and label not in compared:
                compared[label] = title, name, look(place), (bases[0][2], bases[0][1])
    return compared


def plot_profiles(table: Table, scores: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Plot the share of runs above each value of the primary measure, with Wilson's intervals."""
    figure, axes = _panels(table)
    known = {arm: runs[table.primary].dropna().to_numpy() for arm, runs in scores.items()}
    for axis, labels in zip(axes, table.panels.values(), strict=True):
        for place, name, label in looks_of(labels, known):
            share, low, high = performance_profile(known[label], _LEVELS)
            style = look(place)
            axis.plot(_LEVELS, share, **style, label=name, drawstyle="steps-post")
            # Bands of all arms would hide each other; beyond its runs there is nothing to see.
            if place < 3:
                within = (known[label].min() <= _LEVELS) & (known[label].max() >= _LEVELS)
                how: dict[str, Any] = {"color": style["color"], "alpha": 0.12, "lw": 0}
                axis.fill_between(_LEVELS, low, high, where=within, step="post", **how)
        axis.set(xlabel=table.primary, ylabel="share of runs above", ylim=(-0.02, 1.02))
        axis.margins(x=0.0)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize="x-small")
    finish(figure, axes, path, dpi=_DPI)


def plot_arms(table: Table, scores: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Plot the primary measure of every arm: its runs, their mean and its 95 % interval."""
    rng = np.random.default_rng(0)
    known = {arm: runs[table.primary].dropna().to_numpy() for arm, runs in scores.items()}
    tall = max(map(len, table.panels.values())) * 0.26 + 0.9
    figure, axes = _panels(table, tall=tall, sharex=True)
    for axis, labels in zip(axes, table.panels.values(), strict=True):
        shown = sorted(looks_of(labels, known), key=lambda each: known[each[2]].mean())
        for height, (place, _, label) in enumerate(shown):
            runs, color = known[label], look(place)["color"]
            found = mean_interval(runs, rng=rng)
            axis.plot(runs, np.full(len(runs), height), ".", color=color, alpha=0.3)
            ends = np.clip([found.low, found.high], 0.0, 1.0)
            axis.plot(ends, [height, height], color=color, lw=2)
            axis.plot(found.value, height, "o", color=color)
        axis.set_yticks(range(len(shown)), [name for _, name, _ in shown])
        axis.set_ylim(-0.6, len(shown) - 0.4)
        axis.set_xlabel(f"{table.primary}; dots are runs")
    finish(figure, axes, path, dpi=_DPI)


def plot_volumes(scores: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Plot the area by replay volume and method, colored by the difference from uniform replay."""
    gaps: dict[int, dict[str, tuple[float, str]]] = {}
    for volume, of_volume in OF_VOLUMES.items():
        suffix = "" if volume == 32 else f"/v{volume}"
        uniform = scores.get(f"sparse/td3/uniform{suffix}", pd.DataFrame({"area": []}))["area"]
        for method in of_volume:
            runs = scores.get(f"sparse/td3/{method}{suffix}", uniform[:0].to_frame())["area"]
            # Of the same seeds, as in the tables; one run shows nothing.
            shared = (runs - uniform).dropna()
            if len(shared) > 1:
                text = f"{runs.mean():.2f}"
                # No minus before what is nothing when rounded.
                text += f", {round(shared.mean(), 2) + 0.0:+.2f}" if method != "uniform" else ""
                cell = shared.mean(), f"{text}\n{len(runs)} runs"
                gaps.setdefault(volume, {})[method] = cell
    named = [name for name in OF_VOLUMES[32] if any(name in cells for cells in gaps.values())]
    found = np.full((len(named), len(gaps)), np.nan)
    figure, (axis,) = new_figure(1, 1, panel=(7.2, 0.5 * len(named) + 1.2))
    for column, cells in enumerate(gaps.values()):
        for name, (gap, text) in cells.items():
            row = named.index(name)
            found[row, column] = gap
            color = "white" if abs(gap) > 0.14 else "black"
            axis.text(column, row, text, ha="center", va="center", color=color, fontsize="small")
    axis.set_facecolor("0.85")  # of cells without runs
    image = axis.imshow(found, cmap="RdBu", vmin=-0.2, vmax=0.2, aspect="auto")
    axis.set_xticks(range(len(gaps)), [str(volume) for volume in gaps])
    axis.set_yticks(range(len(named)), named)
    axis.set(xlabel="replay volume", title="sparse reward")
    figure.colorbar(image, ax=axis, label="minus that of uniform replay")
    figure.suptitle(MEASURES["area"].format(height=HEIGHT), fontsize="medium")
    finish(figure, [], path, dpi=_DPI)


def _panels(table: Table, *, tall: float = _SIZE[1], sharex: bool = False) -> tuple[Any, list[Any]]:
    """A figure with a panel for each group of arms."""
    number = len(table.panels)
    columns = min(number, 2)
    lines = -(-number // columns)
    figure, axes = new_figure(lines, columns, panel=(_SIZE[0], tall))
    for axis in axes[1:number] if sharex else ():
        axis.sharex(axes[0])
    for axis, title in zip(axes, table.panels, strict=False):
        # A centered one, wider than its panel, would be cut at the edge of the figure.
        axis.set_title(title, loc="right")
    for axis in axes[number:]:
        axis.remove()
    return figure, axes[:number]


def looks_of(labels: Sequence[str], there: Mapping[str, Any]) -> list[tuple[int, str, str]]:
    """Arms of a panel of which there are runs: number of their look, name and label.

    A method has the same look in all figures, whichever others stand beside it.
    """
    names = short_names(labels)
    of_methods = [KEY.index(name) if name in KEY else None for name in map(_method_of, labels)]
    known = [look for look in of_methods if look is not None]
    free = (number for number in count() if number not in known)
    looks = []
    for place, number in enumerate(of_methods):
        # The second arm of a method has a look of its own.
        first = number is not None and number not in of_methods[:place]
        looks.append(number if first and number is not None else next(free))
    return [
        (number, names[label], label)
        for number, label in zip(looks, labels, strict=True)
        if label in there and len(there[label])
    ]


def _method_of(label: str) -> str:
    """The method of an arm, which is followed by the name of the arm if it has any."""
    # From the end: a learner may have the name of a method.
    return next((part for part in reversed(label.split("/")) if part in METHODS), "")
