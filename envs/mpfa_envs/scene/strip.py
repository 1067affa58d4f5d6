"""The strip below a picture: title, legend and counts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mpfa_envs.scene.canvas import FINE, Canvas, font
from mpfa_envs.scene.colors import ROBOT, ROBOT_FRONT, TEXT, Color, viridis

HEIGHT: Final = 28
"""Height of the strip [px]."""
_MARGIN, _AFTER_TITLE, _BEFORE_LABEL, _AFTER_LABEL = (FINE * n for n in (8, 18, 15, 16))
"""Spaces in fine pixels."""
_BAR: Final = FINE * 90
"""Length of the bar of a scale in fine pixels."""

Mark = Literal["box", "cross", "square", "ring"]


class Key(NamedTuple):
    """The meaning of a color."""

    label: str
    color: Color
    mark: Mark = "box"

    @property
    def width(self) -> float:
        """Width in fine pixels."""
        return _BEFORE_LABEL + font().getlength(self.label) + _AFTER_LABEL

    def write(self, canvas: Canvas, x: float, middle: float) -> None:
        """Write it from ``x`` on."""
        r = 5 * FINE
        box = [(x, middle - r), (x + 2 * r, middle + r)]
        center = x + r
        if self.mark == "ring":
            canvas.draw.ellipse(box, fill=ROBOT_FRONT, outline=self.color, width=2 * FINE)
        else:
            canvas.draw.rectangle(box, fill=self.color)
        if self.mark == "cross":
            for sign in (-1, 1):
                tips = [(center - 7, middle - 7 * sign), (center + 7, middle + 7 * sign)]
                canvas.draw.line(tips, fill=ROBOT_FRONT, width=4)
        elif self.mark == "square":
            canvas.draw.rectangle([(center - 7, middle - 7), (center + 7, middle + 7)], ROBOT_FRONT)
        _write(canvas, x + _BEFORE_LABEL, middle, self.label)


class Scale(NamedTuple):
    """The meaning of the colors of viridis."""

    name: str
    low: float
    high: float

    @property
    def width(self) -> float:
        """Width in fine pixels."""
        words = sum(font().getlength(each) + 5 * FINE for each in self._words())
        return words + _BAR + _AFTER_LABEL

    def _words(self) -> tuple[str, str, str]:
        return f"{self.name}:", f"{self.low:.3g}", f"{self.high:.3g}"

    def write(self, canvas: Canvas, x: float, middle: float) -> None:
        """Write it from ``x`` on."""
        name, low, high = self._words()
        x = _write(canvas, x, middle, name) + 5 * FINE
        x = _write(canvas, x, middle, low) + 5 * FINE
        colors: NDArray[np.uint8] = viridis(np.linspace(0.0, 1.0, _BAR))
        bar = np.tile(colors, (10 * FINE, 1, 1))
        canvas.image.paste(Image.fromarray(bar), (round(x), round(middle - 5 * FINE)))
        _write(canvas, x + _BAR + 5 * FINE, middle, high)


class Title(NamedTuple):
    """The title of a picture."""

    text: str

    @property
    def width(self) -> float:
        """Width in fine pixels."""
        length: float = font().getlength(self.text)
        return length + _AFTER_TITLE

    def write(self, canvas: Canvas, x: float, middle: float) -> None:
        """Write it from ``x`` on."""
        _write(canvas, x, middle, self.text)


class Facing(NamedTuple):
    """The heading of all robots of a picture."""

    heading: float

    @property
    def width(self) -> float:
        """Width in fine pixels."""
        return _BEFORE_LABEL + 6 * FINE + font().getlength("all face this way") + _AFTER_LABEL

    def write(self, canvas: Canvas, x: float, middle: float) -> None:
        """Write it from ``x`` on."""
        r = 8 * FINE
        canvas.draw.ellipse([(x, middle - r), (x + 2 * r, middle + r)], fill=ROBOT)
        arrow = [
            (x + r + reach * r * math.cos(angle), middle - reach * r * math.sin(angle))
            for reach, angle in (
                (0.8, self.heading),
                (0.6, self.heading + 2.5),
                (0.6, self.heading - 2.5),
            )
        ]
        canvas.draw.polygon(arrow, fill=ROBOT_FRONT)
        _write(canvas, x + _BEFORE_LABEL + 6 * FINE, middle, "all face this way")


Entry = Facing | Key | Scale | Title


def strip_width(entries: Sequence[Entry]) -> int:
    """Least width of a picture for its strip [px]."""
    return math.ceil((_MARGIN + sum(entry.width for entry in entries)) / FINE)


def write_strip(canvas: Canvas, entries: Sequence[Entry]) -> None:
    """Write the entries side by side below a picture that has a footer."""
    x = float(_MARGIN)
    for entry in entries:
        entry.write(canvas, x, canvas.footer_top + HEIGHT // 2 * FINE)
        x += entry.width


def titled(title: str, *others: Entry) -> list[Entry]:
    """The entries of a strip, without a title if that is empty."""
    return [Title(title), *others] if title else list(others)


def _write(canvas: Canvas, x: float, middle: float, text: str) -> float:
    """Write at fine pixels, centered in height; give the end."""
    canvas.draw.text((x, middle), text, fill=TEXT, font=font(), anchor="lm")
    end: float = x + font().getlength(text)
    return end
