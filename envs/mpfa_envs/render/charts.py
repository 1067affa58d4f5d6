"""Charts of runs and of their replay; matplotlib is imported where one is made."""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count
from mpfa_envs.files import write_atomically
from mpfa_envs.scene.colors import LINES, METHODS, VIRIDIS

Array = NDArray[np.float64]

Curve = tuple[Any, Any]
"""Steps and values of one run, each of shape ``[T]``."""
Band = Literal["interval", "runs"]
"""The band around a mean: its 95 % interval for other runs, or each run."""

_LEVEL = 0.95
_DASHES = ("-", "--", ":", "-.")


def plot_seeds(
    runs: Mapping[str, Sequence[Curve]],
    path: str | os.PathLike[str],
    *,
    xlabel: str = "actions",
    ylabel: str = "success",
    level: float | None = 0.9,
    band: Band = "interval",
    limits: tuple[float, float] | None = (0.0, 1.0),
    title: str = "",
) -> None:
    """Plot the mean of runs with its band, and the step at which each first reached a level.

    The mean goes to the end of the shortest run. On the line of the level, a tick marks the step at
    which a run first reached it, a triangle the median of all runs, if at least half of them did;
    the legend has its step. A replay method has its own color, and uniform replay is gray.

    Args:
        runs: Curves of the seeds of each method, by name.
        path: The PNG file.
        xlabel: Label of the steps.
        ylabel: Label of the values.
        level: The level; None: no marks.
        band: ``"interval"``: Student's 95 % interval of the mean; ``"runs"``: each run as a thin
            line, for so few of them that an interval says little. A single run has neither.
        limits: Bounds of the values, which cut the band; None: none.
        title: Of the chart.

    Raises:
        ValueError: If there is no run, or the steps of one do not rise or are not as many as its
            values.

    Examples:
        >>> import tempfile
        >>> from mpfa_envs.render import plot_seeds
        >>> runs = {"PER": [([0, 100, 200], [0.0, 0.7, 0.95]), ([0, 100, 200], [0.1, 0.9, 1.0])]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_seeds(runs, f"{folder}/seeds.png")
    """
    if band not in ("interval", "runs"):
        raise ValueError(f"band must be 'interval' or 'runs', got {band!r}")
    figure, axes = new_figure()
    draw_seeds(axes[0], runs, level=level, band=band, limits=limits)
    axes[0].set(xlabel=xlabel, ylabel=ylabel, title=title)
    finish(figure, axes, path)


def draw_seeds(
    axis: Any,
    runs: Mapping[str, Sequence[Curve]],
    *,
    level: float | None = None,
    band: Band = "interval",
    limits: tuple[float, float] | None = None,
    methods: Mapping[str, str] | None = None,
) -> None:
    """Draw what :func:`plot_seeds` plots into axes of matplotlib; ``methods`` give the colors."""
    if not any(runs.values()):
        raise ValueError("runs must hold a curve at least")
    if level is not None:
        axis.axhline(level, color="0.6", lw=0.8, ls=":")
    styles = looks(runs, methods)
    for name, curves in runs.items():
        if not curves:
            continue
        style = styles[name]
        steps, mean, low, high = seed_band(curves)
        if limits is not None:
            low, high = low.clip(*limits), high.clip(*limits)
        if len(curves) > 1 and band == "interval":
            axis.fill_between(steps, low, high, color=style["color"], alpha=0.18, lw=0)
        for curve in curves if len(curves) > 1 and band == "runs" else ():
            axis.plot(*curve, **style, lw=0.8, alpha=0.5)
        label = name if len(curves) == 1 else f"{name} ({len(curves)})"
        if level is not None:
            median = _mark_level(axis, [first_step(each, level) for each in curves], level, style)
            label += f": {level:g} at {_thousands(median, None)}" if math.isfinite(median) else ""
        axis.plot(steps, mean, **style, lw=1.8, label=label)
    if limits is not None:
        pad = 0.02 * (limits[1] - limits[0])
        axis.set_ylim(limits[0] - pad, limits[1] + pad)
    axis.xaxis.set_major_formatter(_thousands)
    axis.legend(frameon=False)


def seed_band(curves: Sequence[Curve]) -> tuple[Array, Array, Array, Array]:
    """Steps that all runs have, their mean and the ends of its 95 % interval, ``[T]``."""
    # Takes half a second to import, which whoever makes no chart need not wait.
    from scipy import stats

    checked = [_checked(curve) for curve in curves]
    first = max(steps[0] for steps, _ in checked)
    last = min(steps[-1] for steps, _ in checked)
    steps = np.unique(np.concatenate([each for each, _ in checked]))
    steps = steps[(steps >= first) & (steps <= last)]
    values = np.stack([np.interp(steps, *each) for each in checked])
    mean = values.mean(axis=0)
    if len(values) == 1:
        return steps, mean, mean, mean
    count = len(values)
    reach = stats.t.ppf(0.5 + _LEVEL / 2, count - 1) / math.sqrt(count) * values.std(axis=0, ddof=1)
    return steps, mean, mean - reach, mean + reach


def first_step(curve: Curve, level: float) -> float:
    """Step at which a run first reaches a level; infinite if it never does."""
    steps, values = _checked(curve)
    reached = np.flatnonzero(values >= level)
    return float(steps[reached[0]]) if len(reached) else math.inf


def _checked(curve: Curve) -> tuple[Array, Array]:
    steps, values = (np.asarray(each, dtype=np.float64) for each in curve)
    if steps.ndim != 1 or steps.shape != values.shape or not len(steps):
        raise ValueError(
            f"steps and values of a run must be equally many, got {steps.shape} and {values.shape}"
        )
    if (np.diff(steps) <= 0).any():
        raise ValueError("steps of a run must rise")
    return steps, values


def _mark_level(axis: Any, steps: Sequence[float], level: float, style: Mapping[str, str]) -> float:
    """Mark the steps at which runs reached the level and return their median."""
    reached = [step for step in steps if math.isfinite(step)]
    axis.plot(reached, [level] * len(reached), "|", color=style["color"], ms=9, mew=1.2, zorder=3)
    median = float(np.median(steps))
    if math.isfinite(median):
        axis.plot(median, level, "v", color=style["color"], ms=8, mec="white", mew=0.7, zorder=4)
    return median


def plot_histograms(
    histories: Mapping[str, tuple[Any, Any, Any]],
    path: str | os.PathLike[str],
    *,
    columns: int = 2,
    xlabel: str = "actions",
) -> None:
    """Plot how the distribution of some numbers changes with time, a panel each.

    The darker a place, the larger the share of the numbers there at that time; darkest is what only
    one place in a hundred exceeds. The line is their median. Bins are on a logarithmic scale.

    Args:
        histories: Steps ``[T]``, edges of the bins ``[E + 1]`` and counts ``[T, E]`` of each kind
            of number by its name, as ``ReplayHistory.histograms()`` of the scripts gives them.
        path: The PNG file.
        columns: Panels in a row.
        xlabel: Label of the steps.

    Raises:
        ValueError: If there is nothing to plot, or arrays of a history do not fit together.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from mpfa_envs.render import plot_histograms
        >>> counts = np.array([[1, 4, 1], [0, 2, 4]])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     history = [100, 200], [0.1, 1.0, 10.0, 100.0], counts
        ...     plot_histograms({"priority": history}, f"{folder}/histograms.png")
    """
    if not histories:
        raise ValueError("histories must not be empty")
    check_count("columns", columns)
    for name, (steps, edges, counts) in histories.items():
        shape = len(steps), len(edges) - 1
        if np.shape(counts) != shape or 0 in shape:
            raise ValueError(f"counts of {name!r} must have shape {shape}, got {np.shape(counts)}")
    columns = min(columns, len(histories))
    figure, axes = new_figure(-(-len(histories) // columns), columns, panel=(3.6, 2.5))
    from matplotlib.colors import LinearSegmentedColormap

    paled = LinearSegmentedColormap.from_list(
        "paled", ["white", *(np.array(VIRIDIS[::-1]) / 255.0)]
    )
    for axis, (name, (steps, edges, counts)) in zip(axes, histories.items(), strict=False):
        times = np.asarray(steps, dtype=np.float64)
        shares = np.asarray(counts, dtype=np.float64)
        shares = shares / np.maximum(shares.sum(axis=1, keepdims=True), 1.0)
        # Many equal numbers would leave all others pale.
        most = float(np.quantile(shares[shares > 0], 0.99)) if shares.any() else 1.0
        heat = axis.pcolormesh(
            _ends(times), edges, shares.T, cmap=paled, vmin=0.0, vmax=most, rasterized=True
        )
        medians = _medians(np.asarray(edges, dtype=np.float64), shares)
        axis.plot(times, medians, color="black", lw=1)
        used = np.flatnonzero(shares.max(axis=0) > 1e-3)
        axis.set(yscale="log", ylabel=name, xlabel=xlabel)
        axis.set_ylim(edges[used[0]], edges[used[-1] + 1])
        axis.xaxis.set_major_formatter(_thousands)
        figure.colorbar(heat, ax=axis, format=lambda share, _: f"{share:.0%}")
    figure.suptitle("share of the buffer; line: median", fontsize="medium")
    for axis in axes[len(histories) :]:
        axis.remove()
    finish(figure, [], path)


def _ends(times: Array) -> Array:
    """Edges of the columns of a heat map, in the middle between two times."""
    middles = (times[1:] + times[:-1]) / 2
    width = float(np.diff(times).mean()) if len(times) > 1 else 1.0
    return np.concatenate(([times[0] - width / 2], middles, [times[-1] + width / 2]))


def _medians(edges: Array, shares: Array) -> Array:
    """Median of each histogram, within its bin by the logarithm."""
    logs = np.log(edges)
    risen = np.concatenate((np.zeros((len(shares), 1)), shares.cumsum(axis=1)), axis=1)
    return np.exp([np.interp(0.5, each, logs) for each in risen])


def new_figure(
    rows: int = 1, columns: int = 1, *, panel: tuple[float, float] = (7.0, 4.0), **kwargs: Any
) -> tuple[Any, list[Any]]:
    """A figure of matplotlib and its axes, row by row; a panel has a size [inch]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * panel[0], rows * panel[1]), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, **kwargs)
    return figure, list(np.atleast_1d(axes).flat)


def finish(
    figure: Any, axes: Iterable[Any], path: str | os.PathLike[str], *, dpi: int = 120
) -> None:
    """Give axes their grids, and write their figure in one step to a file whose folder is made."""
    for axis in axes:
        axis.grid(alpha=0.3)
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dpi, format=file.suffix[1:] or "png")
    write_atomically(drawn.getvalue(), file)


def look(place: int) -> dict[str, str]:
    """Color of the line of a number, and another dash once all colors are taken."""
    return _style(LINES[place % len(LINES)], _DASHES[place // len(LINES) % len(_DASHES)])


def looks(
    names: Iterable[str], methods: Mapping[str, str] | None = None
) -> dict[str, dict[str, str]]:
    """Color and dash of each name: those of its replay method, or else the next that are free.

    A second arm of a method has the color of the method and another dash.
    """
    every, styles = list(names), dict[str, dict[str, str]]()
    method_of = methods or {name: method for name in every if (method := _method_in(name))}

    def choose(name: str, options: Sequence[dict[str, str]]) -> None:
        if name not in styles:
            free = (style for style in options if style not in styles.values())
            styles[name] = next(free, options[0])

    # The looks of methods come before those of second arms, and these before those of others.
    arms = [name for name in every if name in method_of]
    first_arms = {method_of[name]: name for name in reversed(arms)}.values()
    for name in [arm for arm in arms if arm in first_arms] + arms:
        color, dash = METHODS[method_of[name]]
        choose(name, [_style(color, dash), *(_style(color, other) for other in _DASHES)])
    for name in every:
        choose(name, [look(place) for place in range(len(LINES) * len(_DASHES))])
    return {name: styles[name] for name in every}


def _method_in(name: str) -> str:
    """The replay method in a name such as "td3/per" or "MPFA-PER, weak"; empty if there is none."""
    parts = re.split(r"[/\s,:(]+", name.lower().replace("-", "_"))
    return next((part for part in reversed(parts) if part in METHODS), "")


def _style(color: tuple[int, int, int], dash: str) -> dict[str, str]:
    return {"color": "#" + "".join(f"{channel:02x}" for channel in color), "linestyle": dash}


def _thousands(value: float, _: object) -> str:
    """A number of steps, short."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if abs(value) >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"
