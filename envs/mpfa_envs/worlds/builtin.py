"""The built-in worlds: A to D for training, and two that training never sees."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from mpfa_envs.worlds.world import Box, World


def _world(name: str, *boxes: tuple[float, float, float, float]) -> World:
    """Build a 10 x 10 m world from boxes given as (x_min, x_max, y_min, y_max) [m]."""
    return World(name=name, boxes=tuple(Box(x0, y0, x1, y1) for x0, x1, y0, y1 in boxes))


WORLDS: Final[Mapping[str, World]] = {
    world.name: world
    for world in (
        _world("A"),
        _world(
            "B",
            (-3.0, 3.0, 3.5, 4.0),
            (-3.0, 3.0, -4.0, -3.5),
            (-3.25, -2.75, -2.0, 2.0),
            (2.75, 3.25, -2.0, 2.0),
        ),
        _world(
            "C",
            (-1.5, 1.5, 1.5, 2.0),
            (-1.5, 1.5, -2.0, -1.5),
            (2.75, 3.25, -1.5, 1.5),
            (-3.25, -2.75, -1.5, 1.5),
        ),
        _world(
            "D",
            (-1.0, 2.0, 1.0, 1.5),
            (-2.0, 2.0, -1.5, -1.0),
            (0.0, 4.0, 3.5, 4.0),
            (-4.0, -3.5, 1.0, 4.0),
            (3.75, 4.25, -4.0, -1.0),
            (-4.0, 0.0, -4.0, -3.5),
        ),
        _world(
            "validation",
            (-2.9, -2.4, 2.2, 4.0),
            (-1.0, 1.2, 3.3, 3.8),
            (2.8, 3.3, 2.0, 4.0),
            (-5.0, -3.7, 0.6, 1.1),
            (-1.2, -0.3, 0.7, 1.6),
            (1.0, 1.5, -0.4, 1.9),
            (3.2, 4.1, -0.3, 0.2),
            (-3.2, -1.4, -1.2, -0.7),
            (-4.0, -3.5, -4.0, -2.3),
            (-1.2, -0.7, -3.9, -2.2),
            (0.9, 2.9, -2.6, -2.1),
            (2.6, 3.5, -4.1, -3.6),
        ),
        _world(
            "test",
            (-4.0, -1.4, 3.3, 3.8),
            (0.2, 0.7, 2.4, 5.0),
            (2.1, 3.6, 3.0, 3.5),
            (-3.6, -3.1, -0.6, 1.9),
            (-1.7, 0.9, 1.0, 1.5),
            (2.4, 2.9, -0.3, 1.7),
            (-1.5, -1.0, -1.9, -0.3),
            (0.2, 2.2, -1.9, -1.4),
            (3.9, 5.0, -1.2, -0.7),
            (-3.9, -2.5, -2.4, -1.9),
            (-1.9, 0.1, -3.7, -3.2),
            (1.5, 2.0, -5.0, -3.2),
            (3.2, 3.7, -3.9, -2.3),
        ),
    )
}
"""The built-in worlds by name.

The paper shows its maps without numbers. B, C and D have the boxes of the public training course
that it follows, by Tang, Kumar and Michmizos (https://arxiv.org/abs/2003.01157), moved to the
center of a 10 x 10 m room. Validation and test are ours: more boxes, passages of 0.9 m and more.
"""
