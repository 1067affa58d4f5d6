"""What earlier scans have seen where the last one did not look."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mpfa_envs import ROBOTS, RobotModel, TaskConfig
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.deploy.card import Card
from mpfa_envs.planners.piloted import card_of
from mpfa_envs.sensing.glances import Glances, nearest_hits
from mpfa_envs.sensing.sectors import Points, Sectors

SCOUT = replace(
    ROBOTS["kobuki"], name="scout", field_of_view=240.0, lidar_mount=(0.08, 0.0, 0.0), latency=0.3
)
HALF = 1.2
"""Half a side of the room around the robot [m]."""
TASK = {"robot": SCOUT, "physics": "kinematic", "closeness_distance": SCOUT.lidar_to_rim}


def a_card(robot: RobotModel = SCOUT) -> Card:
    return card_of(TaskConfig(**TASK | {"robot": robot}))


def room(pose: tuple[float, float, float], post: float = math.inf) -> Scan:
    """What the lidar sees in a square room, or of a post at (-0.5, 0) with a radius [m]."""
    angles = np.radians(np.linspace(-120.0, 120.0, 481))
    return Scan(
        float(angles[0]), float(angles[1] - angles[0]), ranges(pose, angles, post), 0.0, 9.0
    )


def ranges(pose: tuple[float, float, float], angles: np.ndarray, post: float) -> np.ndarray:
    x, y = pose[0] + 0.08 * math.cos(pose[2]), pose[1] + 0.08 * math.sin(pose[2])
    cosine, sine = np.cos(angles + pose[2]), np.sin(angles + pose[2])
    with np.errstate(divide="ignore"):
        walls = np.minimum(
            np.where(cosine >= 0.0, HALF - x, -HALF - x) / cosine,
            np.where(sine >= 0.0, HALF - y, -HALF - y) / sine,
        )
    if post < math.inf:
        along = (-0.5 - x) * cosine - y * sine
        inside = post**2 - ((-0.5 - x) ** 2 + y**2 - along**2)
        hit = np.where(
            (inside > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(inside, 0.0)), 9.0
        )
        walls = np.minimum(walls, hit)
    return np.asarray(walls)


def looked(*poses: tuple[float, float, float], post: float = math.inf, moves: bool = False):
    """Scans from some poses, a second after one another."""
    card = a_card()
    glances, sectors = Glances(card, SCOUT, moves=moves), Sectors(card, mount=SCOUT.lidar_mount)
    for time, pose in enumerate(poses):
        glances.add(np.array(pose), sectors.read(room(pose, post))[1], float(time))
    return glances


def far(glances: Glances, heading: float) -> np.ndarray:
    """How far each sector was seen by a robot in the middle with a heading [m]."""
    states = np.array([[0.0, 0.0, heading, 0.0, 0.0]])
    closeness = glances.closeness(states, np.ones(24, np.bool_))[0]
    return np.where(closeness < 1.0, SCOUT.lidar_to_rim / closeness, 0.0)


@pytest.mark.parametrize("post", [math.inf, 0.1])
def test_what_a_scan_has_seen_behind_is_known_as_far_as_it_is_free(post: float) -> None:
    # It looked back, and turned around.
    found = far(looked((0.0, 0.0, math.pi), (0.0, 0.0, 0.0), post=post), math.pi)
    rays = np.radians(np.linspace(120.0, -120.0, 24 * 20 + 1))
    true = ranges((0.0, 0.0, math.pi), rays, post)
    nearest = np.array([true[20 * k : 20 * k + 21].min() for k in range(24)])
    assert (found <= nearest + 0.01).all()
    assert (found >= np.minimum(nearest, 1.5) - 0.2).all()


def test_where_no_scan_has_looked_nothing_is_known_beyond_the_rim() -> None:
    found = far(looked((0.0, 0.0, 0.0)), math.pi)
    # Its rays end 120 degrees from its own direction, which are 60 from what is ahead now.
    assert (found[7:17] == 0.0).all() and (found[[0, -1]] > 0.5).all()
    assert (far(looked((0.0, 0.0, 0.0), moves=True), 0.0) == 0.0).all()


def test_scans_are_forgotten_in_time_and_where_odometry_jumps() -> None:
    glances = looked((0.0, 0.0, math.pi), (0.0, 0.0, 0.0))
    assert far(glances, math.pi)[12] > 0.5
    sectors = Sectors(a_card(), mount=SCOUT.lidar_mount)
    for time in np.arange(2.0, 6.0, 0.5).tolist():
        assert (far(glances, math.pi)[12] > 0.5) == (time <= 4.5)
        glances.add(np.zeros(3), sectors.read(room((0.0, 0.0, 0.0)))[1], time)
    glances = looked((0.0, 0.0, math.pi), (0.0, 0.0, 0.0))
    glances.add(np.array((0.3, 0.0, 0.0)), sectors.read(room((0.3, 0.0, 0.0)))[1], 1.1)
    assert far(glances, math.pi)[12] == 0.0


def test_what_an_earlier_scan_looked_through_stays_where_the_newest_hits_it() -> None:
    # Somebody came from behind since the first scan, and stands at the side of the second.
    card, sectors = a_card(), Sectors(a_card(), mount=SCOUT.lidar_mount)
    glances = Glances(card, SCOUT, moves=False)
    glances.add(np.array((0.0, 0.0, math.pi)), sectors.read(room((0.0, 0.0, math.pi)))[1], 0.0)
    newest = (0.0, 0.0, 1.6)
    glances.add(np.array(newest), sectors.read(room(newest, post=0.05))[1], 1.0)
    found = far(glances, math.pi)
    assert found[11:13].max() < 0.4 and found[[3, 20]].min() > 0.8


@pytest.mark.parametrize("rays", [97, 181, 241, 343, 721])
def test_a_direction_in_which_a_ray_has_hit_is_free_no_farther_than_that(rays: int) -> None:
    angles = np.radians(np.linspace(-120.0, 120.0, rays))
    for ray in range(2, rays - 2):
        hit = np.full(rays, 1.4)
        hit[ray] = 0.5
        nearest = nearest_hits(angles, hit)
        direction = int((angles[ray] / math.tau + 0.5) * len(nearest))
        assert nearest[direction] <= 0.5
        assert nearest.max() == 1.4


def test_a_lidar_with_a_roll_and_short_rays_is_read() -> None:
    rolled = replace(SCOUT, lidar_mount=(0.08, 0.0, 0.0, math.pi))
    glances = Glances(a_card(rolled), SCOUT, moves=False)
    far_away = Points(np.radians(np.arange(-120.0, 120.0)), np.full(240, 9.0), (0.08, 0.0), 1.0)
    glances.add(np.zeros(3), far_away, 0.0)
    states = np.zeros((1, 5))
    closeness = glances.closeness(states, np.ones(24, np.bool_))
    # It has looked a meter far, and nowhere behind.
    assert (closeness >= 0.99 * SCOUT.lidar_to_rim).all() and closeness.min() < 0.15


@pytest.mark.parametrize(("approach", "drives"), [(0.0, True), (1e-3, False)])
def test_a_robot_that_turns_while_orders_are_late_may_drive_where_it_looked_before(
    approach: float, drives: bool
) -> None:
    pilot = Pilot(
        a_card(), lambda _: np.ones((1, 2), np.float32), clearance=0.03, approach=approach
    )
    pilot.begin(goal=(3.0, 0.0))
    # It turns to the right, and back again.
    for number, (heading, turning) in enumerate(((0.0, -2.0), (-0.4, -2.0), (-0.8, 1.0))):
        pose, time = (0.0, 0.0, heading), 0.4 * number
        pilot.decide(room(pose), pose, (0.0, -2.0), time=time)
        pilot.give(time + (0.2 if turning < 0.0 else 0.01), 0.0, turning)
    command = pilot.decide(room(pose), pose, (0.0, 1.0), time=1.2)
    assert ((command.linear, command.angular) == pytest.approx((0.7, 0.0))) == drives
