"""What the library of ORCA is told: the robot as it moves, and all that stands."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mpfa_envs import Box, Cylinder, Polygon, Walker, World
from mpfa_envs.walkers.batch import OrcaRoom, WalkerBatch, _outlines
from mpfa_envs.worlds.batch import WorldBatch

pytest.importorskip("pyrvo", reason="an extra")
AVOIDER = Walker(behavior="orca", waypoints=((-3.0, 1.5), (3.0, 1.5)), speed=1.0)
TRIANGLE = ((0.5, -0.5), (1.5, 0.0), (0.5, 0.5))


def chosen(world: World, walker: tuple[float, float], robot: tuple[float, ...]) -> np.ndarray:
    """The velocity that a walker chooses towards (3, 1.5), which it moves with now."""
    speed = np.array([3.0, 1.5]) - walker
    states = np.array([[*walker, *(speed / np.hypot(*speed))]])
    room = OrcaRoom(world, radius=0.18, time_step=0.1)
    room.choose(np.array(robot), states, np.ones(1, dtype=np.int64))
    return states[0, 2:]


@pytest.mark.parametrize(
    "shapes",
    [
        {"boxes": (Box(0.5, -0.5, 1.5, 0.5),)},
        {"cylinders": (Cylinder(1.0, 0.0, 0.5),)},
        {"polygons": (Polygon(TRIANGLE),)},
    ],
    ids=lambda shapes: next(iter(shapes)),
)
def test_a_walker_keeps_off_each_kind_of_obstacle(shapes: dict[str, tuple[object, ...]]) -> None:
    far = (-4.0, -4.0, 0.0, 0.0, 0.0)
    free = chosen(World(name="free", walkers=(AVOIDER,)), (0.1, 0.0), far)
    np.testing.assert_allclose(free, np.array([2.9, 1.5]) / math.hypot(2.9, 1.5), atol=1e-5)
    world = World(name="full", walkers=(AVOIDER,), **shapes)
    across, _ = chosen(world, (0.1, 0.0), far)
    # For a second it would not touch what stands 0.15 m from its rim.
    assert across < 0.6 * free[0]


def test_obstacles_lie_left_of_their_edges_and_the_room_right() -> None:
    world = World(
        name="full",
        boxes=(Box(0.5, -0.5, 1.5, 0.5),),
        cylinders=(Cylinder(-1.0, 0.0, 0.5),),
        polygons=(Polygon(((-3.0, 1.5), (-1.5, 2.0), (-3.0, 3.0))),),
    )
    walls, *others = (np.array(outline) for outline in _outlines(world))

    def signed_area(corners: np.ndarray) -> float:
        following = np.roll(corners, -1, axis=0)
        return float(np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0])) / 2

    assert signed_area(walls) == pytest.approx(-100.0)
    box, cylinder, polygon = map(signed_area, others)
    assert (box, polygon) == pytest.approx((1.0, 1.125))
    assert math.pi * 0.25 < cylinder < 1.05 * math.pi * 0.25


def test_a_velocity_into_a_wall_is_not_driven(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    velocity = [0.0, 0.0]

    def choose(self: OrcaRoom, motion: object, states: np.ndarray, targets: object) -> None:
        states[0, 2:] = velocity

    monkeypatch.setattr(OrcaRoom, "choose", choose)
    worlds = WorldBatch([World(name="free", walkers=(AVOIDER,))])
    batch = WalkerBatch(worlds, radius=0.18, time_step=0.1)
    targets = np.ones(1, dtype=np.int64)
    # The wall is at 5 m, and the walker's radius 0.25 m.
    for x, speed, moves in ((4.7, 1.0, False), (4.6, 1.0, True), (4.9, -1.0, True)):
        batch.begin(0, (np.array([[x, 0.0, speed, 0.0]]), targets))
        velocity[0] = speed
        batch.move(np.ones(1, dtype=np.bool_), np.zeros((1, 5)))
        expected = (x + 0.1 * speed, speed) if moves else (x, 0.0)
        assert batch.of(0)[0, [0, 2]] == pytest.approx(expected)
