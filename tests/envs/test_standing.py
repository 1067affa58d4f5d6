"""What of a scan stands still as the plan says, and what may come: all else."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mpfa_envs import Box, Cylinder, Lidar, World
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.sensing.standing import standing_hits, standing_sectors
from tests.envs.exported import card

WALLS = (Box(-4.0, 0.6, 0.5, 0.8), Box(1.5, 0.6, 4.0, 0.8), Box(-4.0, -0.8, 4.0, -0.6))
PLAN = World(name="plan", size=(20.0, 20.0), boxes=WALLS)
HERE, FAR = np.zeros(3), 10.0


def known(world: World, plan: World = PLAN, shift: float = 0.0) -> np.ndarray:
    """The sectors that hold walls of the plan alone, ``[36]``, by rays among what is there."""
    lidar = Lidar(world, sectors=36, rays_per_sector=10, field_of_view=360.0, max_range=FAR)
    scan = HERE, lidar.angles, lidar.cast(0.0, 0.0, 0.0)
    hits = standing_hits(plan, (shift, 0.0, 0.0), *scan, FAR)
    return standing_sectors(hits, *scan, FAR, HERE, math.tau, 36)


def sector(degrees: float) -> int:
    """The number of the sector of a direction, left to right."""
    return math.floor((0.5 - degrees / 360.0) * 36) % 36


def test_walls_of_the_plan_stand_and_an_opening_and_its_edges_do_not() -> None:
    found = known(PLAN)
    assert found[[sector(angle) for angle in (95.0, 115.0, 65.0, -85.0, -45.0, -135.0)]].all()
    opening = [sector(angle) for angle in (55.0, 45.0, 35.0, 25.0)]
    assert not found[opening].any()
    # Behind the ends of the corridor there is nothing that the plan knows nearby.
    assert not found[[sector(1.0), sector(179.0)]].any()


@pytest.mark.parametrize("x", [-0.3, 0.3])
def test_what_stands_before_a_wall_or_is_not_in_the_plan_may_come(x: float) -> None:
    person = World(
        name="person", size=PLAN.size, boxes=WALLS, cylinders=(Cylinder(x, -0.45, 0.14),)
    )
    found, free = known(person), known(PLAN)
    seen = [sector(math.degrees(math.atan2(-0.45, x + across))) for across in (-0.1, 0.0, 0.1)]
    assert free[seen].all() and not found[seen].any()
    assert not (found & ~free).any()


def test_a_plan_that_lies_elsewhere_makes_nothing_stand() -> None:
    tilted = World(name="tilted", size=PLAN.size, boxes=(Box(-4.0, 0.7, 4.0, 0.9),))
    assert not known(PLAN, tilted).any()


def test_a_sector_seen_from_elsewhere_stands_if_all_its_hits_do() -> None:
    angles, ranges = np.array([0.1, 0.0, -0.1]), np.ones(3)
    standing = np.array([True, True, False])
    place = np.array([0.5, 0.0, 0.0])
    found = standing_sectors(standing, HERE, angles, ranges, FAR, place, math.tau, 36)
    # A meter ahead is half a meter ahead then, where angles are twice as large.
    assert np.flatnonzero(found).tolist() == [sector(math.degrees(0.2)), sector(0.0)]


def test_a_pilot_that_knows_its_corridor_drives_faster_than_one_that_does_not() -> None:
    corridor = World(
        name="corridor",
        size=(30.0, 20.0),
        boxes=(Box(-8.0, 0.45, 8.0, 0.6), Box(-8.0, -0.6, 8.0, -0.45)),
    )
    facts = card(robot=ROBOTS["kobuki"], field_of_view=360.0, sectors=36, memory="map")
    ahead = lambda seen: np.ones((1, 2), np.float32)  # noqa: E731
    lidar = Lidar(corridor, sectors=36, rays_per_sector=10, field_of_view=360.0)
    ranges = lidar.cast(0.0, 0.0, 0.0)
    scan = Scan(float(lidar.angles[0]), float(lidar.angles[1] - lidar.angles[0]), ranges)
    speeds = []
    for plan in (None, corridor):
        pilot = Pilot(facts, ahead, clearance=0.03, approach=0.5, latency=0.0)
        pilot.begin((3.0, 0.0), plan=plan)
        speeds.append(pilot.decide(scan, (0.0, 0.0, 0.0), (0.2, 0.0)).linear)
    assert speeds[1] > speeds[0] + 0.2
