"""Pictures of a world from above, rendered without a display."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mpfa_envs.builtin_worlds import resolve_world

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from mpfa_envs.map_memory import Sketch
    from mpfa_envs.occupancy import OccupancyGrid
    from mpfa_envs.robot import RobotModel
    from mpfa_envs.worlds import World

Outcome = Literal["success", "collision", "timeout"]
"""How an episode ended."""

Color = tuple[int, int, int, int]
Point = tuple[float, float]

PAPER: Final = (255, 255, 255, 255)
FLOOR: Final = (250, 249, 246, 255)
GRID: Final = (236, 234, 228, 255)
WALL: Final = (52, 58, 70, 255)
OBSTACLE: Final = (104, 114, 130, 255)
OBSTACLE_EDGE: Final = (70, 78, 92, 255)
GOAL: Final = (214, 40, 40, 255)
GOAL_AREA: Final = (214, 40, 40, 34)
ROBOT: Final = (24, 26, 30, 255)
ROBOT_FRONT: Final = (255, 255, 255, 255)
RAY: Final = (0, 140, 150, 120)
RAY_AREA: Final = (0, 160, 170, 26)
TRAIL: Final = (37, 99, 186, 255)
WAY: Final = (230, 126, 0, 255)
MET: Final = (230, 126, 0, 52)
WALKER: Final = (104, 168, 96, 255)
WALKER_EDGE: Final = (48, 104, 48, 255)
ROUND: Final = (176, 210, 168, 255)
TEXT: Final = (40, 44, 52, 255)
OUTCOMES: Final[dict[str, Color]] = {
    "success": (37, 99, 186, 190),
    "collision": (222, 82, 32, 230),
    "timeout": (150, 120, 190, 230),
}
"""Colors of the lines of an episode; they differ in lightness too."""

_FINE = 3
"""Pictures are drawn this many times larger and then reduced, which smooths all edges."""
_MARGIN, _AFTER_TITLE, _BEFORE_LABEL, _AFTER_LABEL = (_FINE * n for n in (8, 18, 15, 16))
"""Spaces in the strip below a picture, in fine pixels."""
_BORDER = 0.2
"""Thickness of the walls in a picture [m]."""


class _Canvas:
    """A picture of a world to draw on in meters.

    Args:
        world: The world.
        size: Longer side of the picture [px].
        footer: Height of a strip for text below [px].
        least_width: Of the picture [px]; a narrower world has white on either side.
    """

    def __init__(self, world: World, *, size: int, footer: int = 0, least_width: int = 0) -> None:
        if isinstance(size, bool) or not isinstance(size, int) or size < 32:
            raise ValueError(f"size must be an integer of at least 32, got {size!r}")
        width, depth = (side + 2 * _BORDER for side in world.size)
        self._scale = _FINE * size / max(width, depth)
        pixels = [round(size * side / max(width, depth)) for side in (width, depth)]
        self._shape = max(pixels[0], least_width), pixels[1] + footer
        beside = _FINE * (self._shape[0] - pixels[0]) // 2
        self._left, self._top = width / 2 + beside / self._scale, depth / 2
        self.image = Image.new("RGBA", (_FINE * self._shape[0], _FINE * self._shape[1]), PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self.footer_top = _FINE * pixels[1]
        walls = [(beside, 0), (beside + _FINE * pixels[0] - 1, self.footer_top - 1)]
        self.draw.rectangle(walls, fill=WALL)
        self._draw_world(world)

    def at(self, x: float, y: float) -> Point:
        """Pixel of a position [m]."""
        return (x + self._left) * self._scale, (self._top - y) * self._scale

    def length(self, meters: float) -> float:
        """Pixels of a length [m]."""
        return meters * self._scale

    def _draw_world(self, world: World) -> None:
        room = world.room
        self.rectangle(room.x_min, room.y_min, room.x_max, room.y_max, fill=FLOOR)
        for x in range(math.ceil(room.x_min), math.floor(room.x_max) + 1):
            self.line([(x, room.y_min), (x, room.y_max)], GRID, 1.0)
        for y in range(math.ceil(room.y_min), math.floor(room.y_max) + 1):
            self.line([(room.x_min, y), (room.x_max, y)], GRID, 1.0)
        for box in world.boxes:
            self.rectangle(
                box.x_min, box.y_min, box.x_max, box.y_max, fill=OBSTACLE, outline=OBSTACLE_EDGE
            )
        for cylinder in world.cylinders:
            self.disc(cylinder.x, cylinder.y, cylinder.radius, fill=OBSTACLE, outline=OBSTACLE_EDGE)
        for polygon in world.polygons:
            self.polygon(polygon.vertices, fill=OBSTACLE, outline=OBSTACLE_EDGE)
        if world.occupancy is not None:
            self._draw_cells(world.occupancy)
        for walker in world.walkers:
            for leg in walker.legs:
                self.line(leg, ROUND, 1.2)

    def _draw_cells(self, grid: OccupancyGrid) -> None:
        """Fill the occupied cells; a pixel with any is an obstacle."""
        half = grid.size[0] / 2, grid.size[1] / 2
        left, top = map(round, self.at(-half[0], half[1]))
        right, bottom = map(round, self.at(half[0], -half[1]))
        cells = Image.fromarray(np.flipud(grid.occupied.T).astype(np.uint8) * 255)
        shrunk = cells.resize((right - left, bottom - top), Image.Resampling.BOX)
        mask = shrunk.point([0] + 255 * [255])
        self.image.paste(OBSTACLE, (left, top, right, bottom), mask)

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
        self.draw.rectangle(corners, fill=fill, outline=outline, width=_FINE)

    def polygon(self, vertices: Sequence[Point], *, fill: Color, outline: Color) -> None:
        """Fill a polygon given by its corners [m]."""
        corners = [self.at(*vertex) for vertex in vertices]
        self.draw.polygon(corners, fill=fill, outline=outline, width=_FINE)

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
        self.draw.ellipse(corners, fill=fill, outline=outline, width=_FINE)

    def line(self, points: Sequence[Point], color: Color, width: float) -> None:
        """Draw a line through positions [m], its width in final pixels."""
        if len(points) > 1:
            pixels = [self.at(*point) for point in points]
            self.draw.line(pixels, fill=color, width=round(width * _FINE), joint="curve")

    def layer(self) -> _Layer:
        """Open a transparent layer; leaving it lays it over the picture."""
        return _Layer(self)

    def goal(self, x: float, y: float, radius: float | None = None) -> None:
        """Draw a goal as the paper does, a red square of 0.4 m."""
        if radius is not None:
            with self.layer():
                self.disc(x, y, radius, fill=GOAL_AREA, outline=(*GOAL[:3], 130))
        self.rectangle(x - 0.2, y - 0.2, x + 0.2, y + 0.2, fill=GOAL)

    def robot(self, x: float, y: float, heading: float, radius: float) -> None:
        """Draw a robot as a black disc with a white arrow to its front."""
        self.disc(x, y, radius + 0.02, fill=ROBOT_FRONT)
        self.disc(x, y, radius, fill=ROBOT)
        arrow = [
            self.at(x + reach * radius * math.cos(angle), y + reach * radius * math.sin(angle))
            for reach, angle in ((0.78, heading), (0.6, heading + 2.5), (0.6, heading - 2.5))
        ]
        self.draw.polygon(arrow, fill=ROBOT_FRONT)

    def walker(self, state: Sequence[float]) -> None:
        """Draw a walker as a disc with a line to where it will be in a second."""
        x, y, speed_x, speed_y, radius = state
        self.disc(x, y, radius, fill=WALKER, outline=WALKER_EDGE)
        self.line([(x, y), (x + speed_x, y + speed_y)], WALKER_EDGE, 1.6)

    def text(self, x: float, y: float, text: str) -> float:
        """Write at fine pixels, centered in height; returns the fine pixel where it ends."""
        self.draw.text((x, y), text, fill=TEXT, font=_font(), anchor="lm")
        return x + _font().getlength(text)

    def pixels(self) -> NDArray[np.uint8]:
        """The finished picture, shape ``[height, width, 3]``."""
        picture = self.image.convert("RGB").resize(self._shape, Image.Resampling.BOX)
        return np.asarray(picture, dtype=np.uint8).copy()


class _Layer:
    """Redirects a canvas to a transparent picture and lays it over on leaving."""

    def __init__(self, canvas: _Canvas) -> None:
        self._canvas = canvas
        self._below = canvas.image

    def __enter__(self) -> None:
        self._canvas.image = Image.new("RGBA", self._below.size, (0, 0, 0, 0))
        self._canvas.draw = ImageDraw.Draw(self._canvas.image)

    def __exit__(self, *error: object) -> None:
        self._below.alpha_composite(self._canvas.image)
        self._canvas.image = self._below
        self._canvas.draw = ImageDraw.Draw(self._below)


def render_scene(
    world: World,
    *,
    robot: RobotModel,
    pose: tuple[float, float, float],
    goal: Point,
    goal_radius: float,
    trail: Sequence[Point] = (),
    rays: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    sketch: Sketch | None = None,
    walkers: NDArray[np.float64] | None = None,
    size: int = 480,
) -> NDArray[np.uint8]:
    """Render one moment of an episode.

    Args:
        world: The room and its obstacles.
        robot: The robot.
        pose: Where it is, (x, y, heading) [m, m, rad].
        goal: Where it should go (x, y) [m].
        goal_radius: Distance that reaches the goal [m].
        trail: Where it has been (x, y) [m].
        rays: Angles in the robot's frame [rad] and ranges [m] of its lidar.
        sketch: What the robot remembers, if it makes a map.
        walkers: (x, y), the speeds in both directions and the radius [m, m/s] of each walker,
            ``[K, 5]``.
        size: Longer side of the picture [px].

    Returns:
        Picture of shape ``[height, width, 3]``.

    Raises:
        ValueError: If the size is not an integer of at least 32.

    Examples:
        >>> from mpfa_envs import ROBOTS, WORLDS
        >>> from mpfa_envs.render import render_scene
        >>> render_scene(
        ...     WORLDS["B"], robot=ROBOTS["turtlebot2"], pose=(0.0, 0.0, 0.0), goal=(2.0, 3.0),
        ...     goal_radius=0.5,
        ... ).shape
        (480, 480, 3)
    """
    canvas = _Canvas(world, size=size)
    x, y, heading = pose
    if sketch is not None:
        half = sketch.resolution / 2
        with canvas.layer():
            for at_x, at_y in sketch.blocked:
                canvas.rectangle(at_x - half, at_y - half, at_x + half, at_y + half, fill=MET)
        canvas.line([(x, y), *sketch.way], WAY, 1.5)
    if rays is not None:
        ends = [
            (x + reach * math.cos(heading + angle), y + reach * math.sin(heading + angle))
            for angle, reach in zip(rays[0].tolist(), rays[1].tolist(), strict=True)
        ]
        with canvas.layer():
            if len(ends) > 1:
                canvas.draw.polygon([canvas.at(*end) for end in ((x, y), *ends)], fill=RAY_AREA)
            for end in ends:
                canvas.line([(x, y), end], (*RAY[:3], 46), 0.7)
            for end in ends:
                canvas.disc(*end, 0.035, fill=RAY)
    canvas.goal(*goal, goal_radius)
    canvas.line(trail, TRAIL, 2.0)
    for walker in () if walkers is None else walkers.tolist():
        canvas.walker(walker)
    canvas.robot(x, y, heading, robot.radius)
    return canvas.pixels()


def render_trajectories(
    world: str | os.PathLike[str] | World,
    trajectories: Sequence[Sequence[Point] | NDArray[np.float64]],
    goals: Sequence[Point],
    outcomes: Sequence[Outcome],
    *,
    title: str = "",
    walkers: NDArray[np.float64] | None = None,
    size: int = 480,
) -> NDArray[np.uint8]:
    """Render the paths of many episodes into one picture of their world.

    A ring marks a start, a red dot a goal and a cross a collision. The strip below counts how the
    episodes ended. Of walkers the rounds between their waypoints are shown.

    Args:
        world: A name, the path of a YAML file or a world.
        trajectories: Positions of each episode, each of shape ``[steps, 2]`` [m].
        goals: Goal of each episode (x, y) [m].
        outcomes: ``"success"``, ``"collision"`` or ``"timeout"`` for each episode.
        title: What to write in the strip.
        walkers: Where walkers are at one moment, as in :func:`render_scene`.
        size: Longer side of the picture without the strip [px].

    Returns:
        Picture of shape ``[height, width, 3]``, as wide as the strip's text at least.

    Raises:
        ValueError: If the three lists differ in length, an outcome is unknown, or the size is not
            an integer of at least 32.

    Examples:
        >>> from mpfa_envs import render_trajectories
        >>> render_trajectories("A", [[(0, 0), (1, 1), (2, 3)]], [(2, 3)], ["success"]).shape
        (508, 480, 3)
    """
    world = resolve_world(world)
    if not len(trajectories) == len(goals) == len(outcomes):
        raise ValueError(
            "trajectories, goals and outcomes must have one entry per episode, got "
            f"{len(trajectories)}, {len(goals)} and {len(outcomes)}"
        )
    for outcome in outcomes:
        if outcome not in get_args(Outcome):
            raise ValueError(f"outcomes must be among {get_args(Outcome)}, got {outcome!r}")
    legend = _legend(outcomes)
    canvas = _Canvas(world, size=size, footer=28, least_width=_footer_width(title, legend))
    ways = [[(float(x), float(y)) for x, y in trajectory] for trajectory in trajectories]
    # Successes first: they are many, and the failures above them are what one looks for.
    order = sorted(range(len(ways)), key=lambda i: outcomes[i] != "success")
    for walker in () if walkers is None else walkers.tolist():
        canvas.walker(walker)
    for i in order:
        with_color = OUTCOMES[outcomes[i]]
        with canvas.layer():
            canvas.line(ways[i], with_color, 1.4)
    for i in order:
        canvas.disc(*goals[i], 0.09, fill=GOAL, outline=ROBOT_FRONT)
        if ways[i]:
            canvas.disc(*ways[i][0], 0.07, fill=ROBOT_FRONT, outline=TRAIL)
    for i in order:
        if outcomes[i] == "collision" and ways[i]:
            x, y = ways[i][-1]
            for sign in (-1.0, 1.0):
                tips = [(x - 0.12, y - 0.12 * sign), (x + 0.12, y + 0.12 * sign)]
                canvas.line(tips, (*OUTCOMES["collision"][:3], 255), 2.2)
    _write_footer(canvas, title, legend)
    return canvas.pixels()


def _legend(outcomes: Sequence[str]) -> dict[str, Color]:
    """How many episodes ended in each way, and the color of these; empty without episodes."""
    if not outcomes:
        return {}
    return {
        f"{name} {sum(outcome == name for outcome in outcomes)}": (*color[:3], 255)
        for name, color in OUTCOMES.items()
    }


def _write_footer(canvas: _Canvas, title: str, legend: dict[str, Color]) -> None:
    """Write the title and, if there are episodes, how they ended."""
    middle = canvas.footer_top + 14 * _FINE
    x = float(_MARGIN)
    if title:
        x = canvas.text(x, middle, title) + _AFTER_TITLE
    for label, color in legend.items():
        box = [(x, middle - 5 * _FINE), (x + 10 * _FINE, middle + 5 * _FINE)]
        canvas.draw.rectangle(box, fill=color)
        x = canvas.text(x + _BEFORE_LABEL, middle, label) + _AFTER_LABEL


def _footer_width(title: str, legend: Iterable[str]) -> int:
    """How wide a picture must be for its title and legend [px]."""
    width = _MARGIN + sum(
        _BEFORE_LABEL + _font().getlength(label) + _AFTER_LABEL for label in legend
    )
    if title:
        width += _font().getlength(title) + _AFTER_TITLE
    return math.ceil(width / _FINE)


@cache
def _font() -> Any:
    return ImageFont.load_default(13 * _FINE)
