"""Worlds with walkers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from mpfa_envs import Box, Cylinder, Polygon, Walker, World

ROUND = ((-3.0, 0.5), (3.0, 0.5), (3.0, -3.0))
BUSY = World(
    name="busy",
    boxes=(Box(1.0, 1.0, 2.0, 3.0),),
    cylinders=(Cylinder(-2.0, -2.0, 0.5),),
    polygons=(Polygon(((-3.0, 1.5), (-1.5, 2.0), (-3.0, 3.0))),),
    walkers=(
        *(Walker(speed=0.2 + 0.1 * number, radius=0.2) for number in range(4)),
        *(Walker(behavior="waypoints", waypoints=ROUND, speed=speed) for speed in (0.3, 0.5)),
    ),
)
STANDING = replace(BUSY, walkers=())
POLITE = replace(
    BUSY,
    name="polite",
    walkers=(
        *(
            Walker(behavior="orca", waypoints=points, radius=0.2, speed=0.4)
            for points in (
                ROUND,
                ROUND[::-1],
                ((-4.0, -4.0), (4.0, -4.0)),
                ((4.0, -4.0), (-4.0, -4.0)),
            )
        ),
        Walker(radius=0.2),
    ),
)


def needs(arguments: dict[str, Any]) -> None:
    """Skip a test whose arguments need a package that is not installed."""
    if POLITE in list(arguments["world"]):
        pytest.importorskip("pyrvo", reason="an extra")
