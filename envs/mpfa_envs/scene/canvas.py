"""The canvas of pictures from above: the world, the strip below with title and legend, tiles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mpfa_envs.checks import check_count
from mpfa_envs.scene.colors import (
    FLOOR,
    GOAL,
    GOAL_AREA,
    GOAL_EDGE,
    GRID,
    OBSTACLE,
    OBSTACLE_EDGE,
    PAPER,
    ROBOT,
    ROBOT_FRONT,
    ROUND,
    TEXT,
    WALKER,
    WALKER_EDGE,
    WALL,
    Color,
    viridis,
)
from mpfa_envs.worlds.world import World

Point = tuple[float, float]

FINE: Final = 3
"""Pictures are drawn this many times larger and then reduced, which smooths all edges."""
_BORDER: Final = 0.2
"""Thickness of the walls in a picture [m]."""


class Canvas:
    """A picture of a world, its longer side ``size`` [px], to draw on in meters."""

    def __init__(self, world: World, *, size: int, footer: int = 0, least_width: int = 0) -> None:
        if isinstance(size, bool) or not isinstance(size, int) or size < 32:
            raise ValueError(f"size must be an integer of at least 32, got {size!r}")
        width, depth = (side + 2 * _BORDER for side in world.size)
        self._scale = FINE * size / max(width, depth)
        pixels = [round(size * side / max(width, depth)) for side in (width, depth)]
        self._shape = max(pixels[0], least_width), pixels[1] + footer
        beside = FINE * (self._shape[0] - pixels[0]) // 2
        self._left, self._top = width / 2 + beside / self._scale, depth / 2
        self.image = Image.new("RGBA", (FINE * self._shape[0], FINE * self._shape[1]), PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self.footer_top = FINE * pixels[1]
        walls = [(beside, 0), (beside + FINE * pixels[0] - 1, self.footer_top - 1)]
        self.draw.rectangle(walls, fill=WALL)
        self._draw_world(world)

    def at(self, x: float, y: float) -> Point:
        """Pixel of a position [m]."""
        return (x + self._left) * self._scale, (self._top - y) * self._scale

    def _draw_world(self, world: World) -> None:
        room = world.room
        self.rectangle(room.x_min, room.y_min, room.x_max, room.y_max, fill=FLOOR)
        for x in range(math.ceil(room.x_min), math.floor(room.x_max) + 1):
            self.line([(x, room.y_min), (x, room.y_max)], GRID, 1.0)
        for y in range(math.ceil(room.y_min), math.floor(room.y_max) + 1):
            self.line([(room.x_min, y), (room.x_max, y)], GRID, 1.0)
        self.obstacles(world)
        for walker in world.walkers:
            for leg in walker.legs:
                self.line(leg, ROUND, 1.2)

    def obstacles(self, world: World) -> None:
        """Draw the obstacles of a world."""
        for box in world.boxes:
            self.rectangle(
                box.x_min, box.y_min, box.x_max, box.y_max, fill=OBSTACLE, outline=OBSTACLE_EDGE
            )
        for cylinder in world.cylinders:
            self.disc(cylinder.x, cylinder.y, cylinder.radius, fill=OBSTACLE, outline=OBSTACLE_EDGE)
        for polygon in world.polygons:
            self.polygon(polygon.vertices, fill=OBSTACLE, outline=OBSTACLE_EDGE)
        if world.occupancy is not None:
            self.cells(world.occupancy.occupied, world.occupancy.resolution, OBSTACLE)

    def cells(self, filled: NDArray[np.bool_], resolution: float, color: Color) -> None:
        """Fill cells ``[columns, rows]`` around the middle, of a side [m], and all their pixels."""
        half = filled.shape[0] * resolution / 2, filled.shape[1] * resolution / 2
        left, top = map(round, self.at(-half[0], half[1]))
        right, bottom = map(round, self.at(half[0], -half[1]))
        picture = Image.fromarray(np.flipud(filled.T).astype(np.uint8) * 255)
        scaled = picture.resize((right - left, bottom - top), Image.Resampling.BOX)
        # The canvas stays opaque: the mask alone says how much of the color is seen.
        mask = scaled.point([0] + 255 * [color[3]])
        self.image.paste((*color[:3], 255), (left, top, right, bottom), mask)

    def rectangle(
        self,
        x_min: float,
        y_min: float,
        x_max: float,
        y_max: float,
        *,
        fill: Color,
        outline: Color | None = None,
    ) -> None:
        """Fill a rectangle given by its edges [m]."""
        corners = [self.at(x_min, y_max), self.at(x_max, y_min)]
        self.draw.rectangle(corners, fill=fill, outline=outline, width=FINE)

    def polygon(self, vertices: Sequence[Point], *, fill: Color, outline: Color) -> None:
        """Fill a polygon given by its corners [m]."""
        corners = [self.at(*vertex) for vertex in vertices]
        self.draw.polygon(corners, fill=fill, outline=outline, width=FINE)

    def disc(
        self,
        x: float,
        y: float,
        radius: float,
        *,
        fill: Color | None = None,
        outline: Color | None = None,
    ) -> None:
        """Fill a disc given by its center and radius [m]."""
        corners = [self.at(x - radius, y + radius), self.at(x + radius, y - radius)]
        self.draw.ellipse(corners, fill=fill, outline=outline, width=FINE)

    def ring(self, x: float, y: float, radius: float, color: Color) -> None:
        """Draw a circle as thick as a path."""
        corners = [self.at(x - radius, y + radius), self.at(x + radius, y - radius)]
        self.draw.ellipse(corners, outline=color, width=round(1.5 * FINE))

    def line(self, points: Sequence[Point], color: Color, width: float) -> None:
        """Draw a line through positions [m], its width in final pixels."""
        if len(points) > 1:
            pixels = [self.at(*point) for point in points]
            self.draw.line(pixels, fill=color, width=round(width * FINE), joint="curve")

    @contextmanager
    def layer(self) -> Iterator[None]:
        """Draw on a transparent layer, which is laid over the picture at the end."""
        below = self.image
        self.image = Image.new("RGBA", below.size, (0, 0, 0, 0))
        self.draw = ImageDraw.Draw(self.image)
        yield
        # A layer is empty but for a small part, which takes less time.
        box = self.image.getbbox()
        if box is not None:
            below.alpha_composite(self.image, box[:2], box)
        self.image, self.draw = below, ImageDraw.Draw(below)

    def goal(self, x: float, y: float, radius: float | None = None) -> None:
        """Draw a goal as the paper does, a square of 0.4 m, and the disc that reaches it."""
        if radius is not None:
            with self.layer():
                self.disc(x, y, radius, fill=GOAL_AREA, outline=GOAL_EDGE)
        self.rectangle(x - 0.2, y - 0.2, x + 0.2, y + 0.2, fill=GOAL)

    def robot(
        self, x: float, y: float, heading: float, radius: float, color: Color = ROBOT
    ) -> None:
        """Draw a robot as a disc with a white arrow to its front."""
        self.disc(x, y, radius + 0.02, fill=ROBOT_FRONT)
        self.disc(x, y, radius, fill=color)
        arrow = [
            self.at(x + reach * radius * math.cos(angle), y + reach * radius * math.sin(angle))
            for reach, angle in ((0.78, heading), (0.6, heading + 2.5), (0.6, heading - 2.5))
        ]
        self.draw.polygon(arrow, fill=ROBOT_FRONT)

    def cross(self, x: float, y: float, color: Color) -> None:
        """Draw a cross of 0.24 m, as where a collision was."""
        for sign in (-1.0, 1.0):
            tips = [(x - 0.12, y - 0.12 * sign), (x + 0.12, y + 0.12 * sign)]
            self.line(tips, color, 2.4)

    def square(self, x: float, y: float, color: Color) -> None:
        """Draw a hollow square of 0.24 m, as where the time was up."""
        corners = [self.at(x - 0.12, y + 0.12), self.at(x + 0.12, y - 0.12)]
        self.draw.rectangle(corners, fill=ROBOT_FRONT, outline=color, width=2 * FINE)

    def walker(self, state: Sequence[float]) -> None:
        """Draw a walker as a disc with a line to where it will be in a second."""
        x, y, speed_x, speed_y, radius = state
        self.disc(x, y, radius, fill=WALKER, outline=WALKER_EDGE)
        self.line([(x, y), (x + speed_x, y + speed_y)], WALKER_EDGE, 1.6)

    def pixels(self) -> NDArray[np.uint8]:
        """The finished picture, shape ``[height, width, 3]``."""
        picture = self.image.convert("RGB").reduce(FINE)
        return np.asarray(picture, dtype=np.uint8).copy()


@cache
def font(size: int = 13) -> Any:
    """The font of all words, in final pixels."""
    return ImageFont.load_default(size * FINE)


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


def tiled(
    pictures: Sequence[NDArray[np.uint8]], *, columns: int | None = None, gap: int = 8
) -> NDArray[np.uint8]:
    """Put pictures side by side, row by row.

    Args:
        pictures: Each of shape ``[height, width, 3]``; smaller ones are filled up with white.
        columns: Pictures in a row; None: as many as there are rows.
        gap: White between two of them [px].

    Returns:
        One picture.

    Raises:
        ValueError: If there is no picture, or an argument is out of its range.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs.render import tiled
        >>> tiled([np.zeros((40, 50, 3), np.uint8)] * 3).shape
        (88, 108, 3)
    """
    if not pictures:
        raise ValueError("pictures must not be empty")
    if columns is None:
        columns = math.ceil(math.sqrt(len(pictures)))
    check_count("gap", gap, least=0)
    columns = min(check_count("columns", columns), len(pictures))
    height, width = (max(each.shape[axis] for each in pictures) for axis in (0, 1))
    lines = math.ceil(len(pictures) / columns)
    shape = lines * (height + gap) - gap, columns * (width + gap) - gap, 3
    whole = np.full(shape, 255, dtype=np.uint8)
    for number, each in enumerate(pictures):
        top = number // columns * (height + gap)
        left = number % columns * (width + gap) + (width - each.shape[1]) // 2
        whole[top : top + each.shape[0], left : left + each.shape[1]] = each
    return whole
