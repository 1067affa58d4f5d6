"""Generators of rooms with obstacles: bars, clutter, crowds of walkers, halls, and boxes."""

from __future__ import annotations

import math
import random
from typing import Final

from mpfa_envs.worlds.shapes import Point
from mpfa_envs.worlds.walker import Walker
from mpfa_envs.worlds.world import Box, Cylinder, Polygon, World

_LEAST_SIDE = 0.05
"""Least side of a box that a wall cuts [m]."""


def between(low: float, high: float, difficulty: float) -> float:
    """Interpolate between the values at difficulty 0 and 1."""
    return low + (high - low) * difficulty


def sample_size(rng: random.Random, low: float, high: float) -> tuple[float, float]:
    """Width and depth of a room, each in the range, in whole decimeters [m]."""
    return round(rng.uniform(low, high), 1), round(rng.uniform(low, high), 1)


def cut_box(
    x: float, y: float, width: float, depth: float, size: tuple[float, float]
) -> Box | None:
    """A box around a center, cut off at the walls, in whole millimeters; None if little is left."""
    half_x, half_y = size[0] / 2, size[1] / 2
    x_min, x_max = max(round(x - width / 2, 3), -half_x), min(round(x + width / 2, 3), half_x)
    y_min, y_max = max(round(y - depth / 2, 3), -half_y), min(round(y + depth / 2, 3), half_y)
    if x_max - x_min < _LEAST_SIDE or y_max - y_min < _LEAST_SIDE:
        return None
    return Box(x_min, y_min, x_max, y_max)


def fit_cylinder(x: float, y: float, radius: float, size: tuple[float, float]) -> Cylinder:
    """A cylinder as near to a place as the walls allow, in whole millimeters."""
    # A millimeter less than the room has: the sum of center and radius is rounded too.
    half_x, half_y = (side / 2 - radius - 0.001 for side in size)
    return Cylinder(
        round(max(-half_x, min(half_x, x)), 3), round(max(-half_y, min(half_y, y)), 3), radius
    )


def fit_polygon(
    x: float, y: float, outline: list[tuple[float, float]], size: tuple[float, float]
) -> Polygon:
    """A polygon as near to a place as the walls allow, in whole millimeters."""
    # Sines and cosines differ in the last digit between machines; millimeters do not.
    corners = [(round(across, 3), round(up, 3)) for across, up in outline]
    place = []
    for at, side, values in zip((x, y), size, zip(*corners, strict=True), strict=True):
        low, high = -side / 2 - min(values) + 0.001, side / 2 - max(values) - 0.001
        place.append(round(max(low, min(high, at)), 3))
    return Polygon(tuple((round(place[0] + a, 3), round(place[1] + b, 3)) for a, b in corners))


def bars(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 8 to 14 m a side with bars, Ls and Us, of which some meet.

    Walls are 0.15 to 0.5 m thick and 1 to 4 m long. Half of the pieces are straight, a quarter each
    are an L, which has a corner, and a U, a pocket that a robot has to leave as it came.

    Difficulty: 5 pieces in 100 m² at 0, 12 at 1.
    """
    size = sample_size(rng, 8.0, 14.0)
    boxes: list[Box | None] = []
    for _ in range(round(size[0] * size[1] * between(0.05, 0.12, difficulty))):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        length, thick = rng.uniform(1.0, 4.0), rng.uniform(0.15, 0.5)
        arm = rng.uniform(0.4, 0.9) * length
        arms = rng.choice((0, 0, 1, 2))
        lies, side, end = rng.random() < 0.5, rng.choice((-1, 1)), rng.choice((-1, 1))
        # The bar lies along one axis; its arms leave one end, or both, to one side.
        pieces = [(0.0, 0.0, length, thick)]
        for sign in (end, -end)[:arms]:
            along, across = sign * (length - thick) / 2, side * (arm - thick) / 2
            pieces.append((along, across, thick, arm))
        for along, across, width, depth in pieces:
            if lies:
                boxes.append(cut_box(x + along, y + across, width, depth, size))
            else:
                boxes.append(cut_box(x + across, y + along, depth, width, size))
    return World(name="bars", size=size, boxes=tuple(box for box in boxes if box is not None))


def clutter(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 8 to 14 m a side with boxes and cylinders anywhere in it.

    Boxes have sides of 0.3 to 2.5 m, cylinders, one obstacle in four, radii of 0.1 to 0.6 m. They
    may overlap and leave gaps of any width.

    Difficulty: 5 obstacles in 100 m² at 0, 16 at 1.
    """
    size = sample_size(rng, 8.0, 14.0)
    boxes: list[Box] = []
    cylinders: list[Cylinder] = []
    for _ in range(round(size[0] * size[1] * between(0.05, 0.16, difficulty))):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        if rng.random() < 0.25:
            radius = round(rng.uniform(0.1, 0.6), 3)
            cylinders.append(fit_cylinder(x, y, radius, size))
        else:
            box = cut_box(x, y, rng.uniform(0.3, 2.5), rng.uniform(0.3, 2.5), size)
            if box is not None:
                boxes.append(box)
    return World(name="clutter", size=size, boxes=tuple(boxes), cylinders=tuple(cylinders))


_CORNERS: Final = 3
"""Waypoints of a round."""
_LEG: Final = 2.5
"""Least distance between two waypoints [m]."""
_WALKER_ATTEMPTS: Final = 500


def crowd(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 9 to 11 m a side with a few obstacles and some walkers.

    There are two to five boxes and cylinders. Half of the walkers go straight and bounce, the
    others have a round of three waypoints. They are 0.2 to 0.3 m in radius and walk at 0.1 to
    0.3 m/s, slower than a robot that cannot look back.

    Difficulty: 2 walkers at 0, 6 at 0.5, 10 at 1.
    """
    size = sample_size(rng, 9.0, 11.0)
    boxes: list[Box] = []
    cylinders: list[Cylinder] = []
    for _ in range(rng.randint(2, 5)):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        if rng.random() < 0.5:
            cylinders.append(fit_cylinder(x, y, round(rng.uniform(0.15, 0.4), 3), size))
        else:
            box = cut_box(x, y, rng.uniform(0.4, 1.5), rng.uniform(0.4, 1.5), size)
            if box is not None:
                boxes.append(box)
    room = World(name="crowd", size=size, boxes=tuple(boxes), cylinders=tuple(cylinders))
    walkers = []
    for number in range(round(between(2, 10, difficulty))):
        radius, speed = round(rng.uniform(0.2, 0.3), 3), round(rng.uniform(0.1, 0.3), 3)
        waypoints = _sample_round(rng, room, radius) if number % 2 else None
        if waypoints is None:
            walkers.append(Walker(radius=radius, speed=speed))
        else:
            walker = Walker(radius=radius, speed=speed, behavior="waypoints", waypoints=waypoints)
            walkers.append(walker)
    return World(
        name="crowd", size=size, boxes=room.boxes, cylinders=room.cylinders, walkers=tuple(walkers)
    )


def _sample_round(rng: random.Random, room: World, radius: float) -> tuple[Point, ...] | None:
    """Corners of a round on which nothing stands; None if none was found."""
    corners: list[Point] = []
    for _ in range(_WALKER_ATTEMPTS):
        x, y = (round(rng.uniform(radius - side / 2, side / 2 - radius), 3) for side in room.size)
        legs = [(corner, (x, y)) for corner in corners[-1:]]
        if len(corners) == _CORNERS - 1:
            legs.append(((x, y), corners[0]))
        if room.clearance(x, y) >= radius and all(
            math.dist(*leg) >= _LEG and room.clearance_along(*leg) >= radius for leg in legs
        ):
            corners.append((x, y))
            if len(corners) == _CORNERS:
                return tuple(corners)
    return None


Outline = list[tuple[float, float]]
"""Corners around the origin (x, y) [m]."""


def halls(rng: random.Random, difficulty: float) -> World:
    """Sample a hall of 10 to 20 m a side with rotated boxes, polygons and columns.

    Four obstacles in ten are boxes with sides of 0.3 to 3 m, three are polygons of three to seven
    corners and up to 2.4 m across, two have the shape of an L, and one is a column with a radius of
    0.15 to 0.5 m. They may overlap.

    Difficulty: 5 obstacles in 100 m² at 0, 16 at 1.
    """
    size = sample_size(rng, 10.0, 20.0)
    polygons: list[Polygon] = []
    cylinders: list[Cylinder] = []
    for _ in range(round(size[0] * size[1] * between(0.05, 0.16, difficulty))):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        kind = rng.random()
        if kind < 0.1:
            cylinders.append(fit_cylinder(x, y, round(rng.uniform(0.15, 0.5), 3), size))
            continue
        sample = _sample_turned_box if kind < 0.5 else _sample_corners if kind < 0.8 else _sample_l
        polygons.append(fit_polygon(x, y, _turn(sample(rng), rng.uniform(0, math.tau)), size))
    return World(name="halls", size=size, polygons=tuple(polygons), cylinders=tuple(cylinders))


def _sample_turned_box(rng: random.Random) -> Outline:
    """A box."""
    across, up = rng.uniform(0.15, 1.5), rng.uniform(0.15, 0.7)
    return [(-across, -up), (across, -up), (across, up), (-across, up)]


def _sample_corners(rng: random.Random) -> Outline:
    """Corners on an ellipse, one somewhere in each of its equal parts."""
    count = rng.randrange(3, 8)
    across, up = rng.uniform(0.3, 1.2), rng.uniform(0.3, 1.2)
    angles = [math.tau * (i + rng.uniform(0.0, 0.8)) / count for i in range(count)]
    return [(across * math.cos(angle), up * math.sin(angle)) for angle in angles]


def _sample_l(rng: random.Random) -> Outline:
    """Two arms that meet at a right angle."""
    along, up, thick = rng.uniform(0.8, 2.4), rng.uniform(0.8, 2.4), rng.uniform(0.2, 0.6)
    corners = [(0.0, 0.0), (along, 0.0), (along, thick), (thick, thick), (thick, up), (0.0, up)]
    return [(x - along / 2, y - up / 2) for x, y in corners]


def _turn(outline: Outline, angle: float) -> Outline:
    """An outline turned around the origin by an angle [rad]."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return [(cosine * x - sine * y, sine * x + cosine * y) for x, y in outline]


_HALF: Final = 5.0
"""Half of a room's side [m]."""
_THICKNESS: Final = 0.5
_LENGTHS: Final = (0.5, 2.6)
"""Sides of a box [m], as those of the validation and the test world."""
_AT_WALL: Final = 0.3
"""Share of the sampled boxes that are at a wall; such boxes find a place more easily."""
_BOX_ATTEMPTS: Final = 20_000


def rooms(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 10 x 10 m with boxes 0.5 m thick and 0.5 to 2.6 m long.

    About half of them touch a wall, where they make dead ends. What does not touch leaves a
    passage, so that a narrower robot reaches every free place.

    Difficulty: 8 boxes that leave 1.1 m at 0, 13 and 0.9 m at 0.5, 18 and 0.7 m at 1;
    fewer where so many find no place.
    """
    boxes = round(8 + 10 * difficulty)
    passage = round(1.1 - 0.4 * difficulty, 3)
    placed: list[Box] = []
    for _ in range(_BOX_ATTEMPTS):
        box = _sample_box(rng)
        if _leaves_passages(box, placed, passage):
            placed.append(box)
            if len(placed) == boxes:
                break
    return World(name="rooms", boxes=tuple(placed))


def _sample_box(rng: random.Random) -> Box:
    """A box somewhere in the room or at one of its walls."""
    width, depth = rng.uniform(*_LENGTHS), _THICKNESS
    if rng.random() < 0.5:
        width, depth = depth, width
    x = rng.uniform(width / 2 - _HALF, _HALF - width / 2)
    y = rng.uniform(depth / 2 - _HALF, _HALF - depth / 2)
    if rng.random() < _AT_WALL:
        left, right, low, high = range(4)
        side = rng.choice((left, right, low, high))
        if side == left:
            return Box(-_HALF, y - depth / 2, width - _HALF, y + depth / 2)
        if side == right:
            return Box(_HALF - width, y - depth / 2, _HALF, y + depth / 2)
        if side == low:
            return Box(x - width / 2, -_HALF, x + width / 2, depth - _HALF)
        return Box(x - width / 2, _HALF - depth, x + width / 2, _HALF)
    return Box(x - width / 2, y - depth / 2, x + width / 2, y + depth / 2)


def _leaves_passages(box: Box, others: list[Box], passage: float) -> bool:
    """Return True if a box touches or is a passage away from each wall and every other box."""
    walls = (box.x_min + _HALF, _HALF - box.x_max, box.y_min + _HALF, _HALF - box.y_max)
    return not any(0.0 < gap < passage for gap in walls) and all(
        _gap(box, other) >= passage for other in others
    )


def _gap(one: Box, other: Box) -> float:
    """Distance between two boxes [m]."""
    across = max(one.x_min - other.x_max, other.x_min - one.x_max, 0.0)
    up = max(one.y_min - other.y_max, other.y_min - one.y_max, 0.0)
    return math.hypot(across, up)
