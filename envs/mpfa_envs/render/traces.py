"""Numbers over the time of an episode, next to its pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mpfa_envs.scene.canvas import FINE, font
from mpfa_envs.scene.colors import GRID, LINES, PAPER, TEXT


class Panel(NamedTuple):
    """Numbers of every step of an episode, on one pair of axes."""

    title: str
    lines: Mapping[str, Sequence[float]]
    """The numbers by the name of their line; one without a name needs no legend."""
    last: int | None = None
    """Number of steps shown, up to the present one; None: the whole episode."""


_LEFT, _RIGHT, _TOP, _BELOW = (FINE * n for n in (44, 14, 30, 22))
"""Margins of a panel in fine pixels."""
_SMALL: Final = 11


def render_traces(
    panels: Sequence[Panel],
    step: int,
    *,
    step_time: float,
    width: int = 240,
    height: int = 480,
) -> NDArray[np.uint8]:
    """Render panels with lines up to one step of an episode.

    Args:
        panels: The numbers of all steps; axes of height span all of them.
        step: Number of the step up to which the lines go.
        step_time: Time of a step [s].
        width: Of the picture [px].
        height: Of the picture [px]; the panels share it.

    Returns:
        Picture of shape ``[height, width, 3]``.

    Raises:
        ValueError: If a line has no number, or they differ in length.

    Examples:
        >>> from mpfa_envs.render import Panel, render_traces
        >>> render_traces([Panel("Q", {"": [1.0, 2.0, 4.0]})], 1, step_time=0.2).shape
        (480, 240, 3)
    """
    lengths = {len(line) for panel in panels for line in panel.lines.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(
            f"lines of panels must be equally long and not empty, got {sorted(lengths)}"
        )
    image = Image.new("RGB", (FINE * width, FINE * height), PAPER[:3])
    draw = ImageDraw.Draw(image)
    tall = FINE * height / len(panels)
    for number, panel in enumerate(panels):
        box = (_LEFT, number * tall + _TOP, FINE * width - _RIGHT, (number + 1) * tall - _BELOW)
        _draw_panel(draw, box, panel, step, step_time)
    small = image.reduce(FINE)
    return np.asarray(small, dtype=np.uint8).copy()


def _draw_panel(
    draw: ImageDraw.ImageDraw,
    box: tuple[float, float, float, float],
    panel: Panel,
    step: int,
    step_time: float,
) -> None:
    """One panel: frame, title, the ends of the axes, and the lines."""
    left, top, right, bottom = box
    values = np.array(list(panel.lines.values()), dtype=np.float64)
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    count = values.shape[1] if panel.last is None else panel.last
    first = 0 if panel.last is None else max(step + 1 - panel.last, 0)

    def at(place: int, value: float) -> tuple[float, float]:
        share = (place - first) / max(count - 1, 1)
        return left + share * (right - left), bottom - (value - low) / (high - low) * (bottom - top)

    if low < 0.0 < high:
        draw.line([at(first, 0.0), at(first + count - 1, 0.0)], fill=GRID, width=FINE)
    draw.rectangle(box, outline=GRID, width=FINE)
    x = left
    draw.text((x, top - 9 * FINE), panel.title, fill=TEXT, font=font(13), anchor="lm")
    x += font(13).getlength(panel.title) + 10 * FINE
    for (name, line), color in zip(panel.lines.items(), LINES, strict=False):
        if name:
            draw.text((x, top - 9 * FINE), name, fill=color, font=font(13), anchor="lm")
            x += font(13).getlength(name) + 8 * FINE
        points = [at(place, line[place]) for place in range(first, step + 1)]
        if len(points) > 1:
            draw.line(points, fill=color, width=2 * FINE, joint="curve")
        (end_x, end_y), r = points[-1], 3 * FINE
        draw.ellipse([(end_x - r, end_y - r), (end_x + r, end_y + r)], fill=color)
    for value, y in ((high, top + 5 * FINE), (low, bottom - 5 * FINE)):
        text = f"{value:.{_digits(low, high)}f}"
        draw.text((left - 5 * FINE, y), text, fill=TEXT, font=font(_SMALL), anchor="rm")
    below = bottom + 10 * FINE
    for place, x, anchor in ((first, left, "lm"), (first + count - 1, right, "rm")):
        text = f"{place * step_time:.0f} s"
        draw.text((x, below), text, fill=TEXT, font=font(_SMALL), anchor=anchor)


def _digits(low: float, high: float) -> int:
    """Decimals by which the ends of an axis differ."""
    return min(max(1 - math.floor(math.log10(high - low)), 0), 3)
