"""Rooms of 10 x 10 m with boxes that leave a path between any two of them."""

from __future__ import annotations

import math
import random
from typing import Final

from mpfa_envs.worlds.world import Box, World

_HALF: Final = 5.0
"""Half of a room's side [m]."""
_THICKNESS: Final = 0.5
_LENGTHS: Final = (0.5, 2.6)
"""Sides of a box [m], as those of the validation and the test world."""
_AT_WALL: Final = 0.3
"""Share of the sampled boxes that are at a wall; such boxes find a place more easily."""
_ATTEMPTS: Final = 20_000


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
    for _ in range(_ATTEMPTS):
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
