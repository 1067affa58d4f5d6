from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from mpfa_envs import WORLDS, Box, Cylinder, PathPlanner, World

BLOCK = World(name="block", boxes=(Box(-1.0, -2.0, 1.0, 2.0),))


def around_a_corner(radius: float) -> float:
    """Length from (-3, 0) to (3, 0) around the block: tangents, two arcs and a straight [m]."""
    reach = math.hypot(2.0, 2.0)
    tangent = math.sqrt(reach**2 - radius**2)
    # The tangent leaves at this angle from the x axis and the arc turns it into the x axis.
    turn = math.atan2(2.0, 2.0) + math.asin(radius / reach)
    return 2 * tangent + 2 * radius * turn + 2.0


def test_a_free_line_is_the_path_and_its_length_is_exact() -> None:
    planner = PathPlanner(WORLDS["A"], radius=0.18)
    assert planner.find((0.0, 0.0), (3.0, 4.0)) == [(0.0, 0.0), (3.0, 4.0)]
    assert planner.length((0.0, 0.0), (3.0, 4.0)) == 5.0


@pytest.mark.parametrize("radius", [0.05, 0.18, 0.35])
def test_the_way_around_a_box_is_within_a_percent_of_the_optimum(radius: float) -> None:
    optimum = around_a_corner(radius)
    length = PathPlanner(BLOCK, radius=radius).length((-3.0, 0.0), (3.0, 0.0))
    assert optimum - 1e-9 <= length <= 1.01 * optimum


def test_the_way_around_a_cylinder_is_within_a_percent_of_the_optimum() -> None:
    world = World(name="pillar", cylinders=(Cylinder(0.0, 0.0, 1.0),))
    reach = 1.18
    optimum = 2 * math.sqrt(9 - reach**2) + reach * (math.pi - 2 * math.acos(reach / 3))
    length = PathPlanner(world, radius=0.18).length((-3.0, 0.0), (3.0, 0.0))
    assert optimum - 1e-9 <= length <= 1.01 * optimum


@pytest.mark.parametrize("name", ["D", "validation", "test"])
def test_no_point_of_a_path_comes_nearer_than_the_margin(name: str) -> None:
    world = WORLDS[name]
    planner = PathPlanner(world, radius=0.35)
    rng = np.random.default_rng(1)
    found = 0
    while found < 15:
        (x, y), goal = rng.uniform(-4.5, 4.5, (2, 2)).tolist()
        path = planner.find((x, y), tuple(goal))
        assert (path is not None) == planner.is_reachable((x, y), tuple(goal))
        if path is None:
            continue
        found += 1
        for (x0, y0), (x1, y1) in itertools.pairwise(path):
            for share in np.linspace(0.0, 1.0, 20):
                at = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
                assert world.clearance(*at) >= 0.35 - 1e-6


def test_a_narrow_passage_is_open_to_a_thin_robot_only() -> None:
    world = World(name="door", boxes=(Box(-0.2, -5.0, 0.2, -0.3), Box(-0.2, 0.3, 0.2, 5.0)))
    ends = (-2.0, 1.0), (2.0, -1.0)
    assert PathPlanner(world, radius=0.18).length(*ends) < 5.0
    assert PathPlanner(world, radius=0.35).length(*ends) == math.inf
    assert PathPlanner(world, radius=0.35).find(*ends) is None
    assert not PathPlanner(world, radius=0.35).is_reachable(*ends)


def test_there_is_no_path_from_within_a_margin() -> None:
    assert PathPlanner(BLOCK, radius=0.18).find((-1.1, 0.0), (3.0, 0.0)) is None


def test_a_bad_radius_is_refused() -> None:
    with pytest.raises(ValueError, match="radius must be positive, got 0"):
        PathPlanner(BLOCK, radius=0)
