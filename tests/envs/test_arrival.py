"""The end of a pilot's drive, and the plan that it may have: radius, heading, map."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import ROBOTS, Box, RobotModel, World
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.deploy.map_path import plan_at
from mpfa_envs.robots.drives import KinematicDrives
from tests.envs.exported import card
from tests.envs.test_deploy_filter import ALL_ROUND, KOBUKI, a_pilot, wall_at


def drive_to(pilot: Pilot, start: tuple[float, float, float], timeout: float = 60.0) -> Any:
    """Drive in an empty hall until the pilot says that it has arrived; the last motion."""
    drives, tick = KinematicDrives(pilot.robot, 1, time_step=0.02), 0.02
    motions, told, due = np.array([[*start, 0.0, 0.0]]), (0.0, 0.0), 0.0
    drives.place(0, *start)
    for step in range(round(timeout / tick)):
        pose, speeds = tuple(motions[0, :3].tolist()), tuple(motions[0, 3:].tolist())
        if pilot.arrived(pose):
            wanted = (0.0, 0.0)
            if max(map(abs, speeds)) < 1e-3:
                return motions[0]
        elif step * tick >= due - 1e-9:
            wanted = pilot.decide(wall_at(8.0), pose, speeds)[2:]
            due = step * tick + pilot.period
        told = pilot.ramp(told, wanted, tick)
        turn = 0.5 * told[1] * pilot.robot.wheel_base
        drives.move(motions, np.ones(1, np.bool_), np.array([[told[0] - turn, told[0] + turn]]))
    return None


def seek(seen: np.ndarray) -> np.ndarray:
    """A policy that turns to the goal and drives there as fast as it can."""
    off = math.atan2(seen[0, 37], seen[0, 36])
    forward, turn = max(math.cos(off), 0.0), min(max(off, -0.5), 0.5)
    return np.array([(forward - turn, forward + turn)], np.float32)


@pytest.mark.parametrize(
    ("robot", "heading", "radius"),
    [
        (KOBUKI, 3.0, 0.1),
        (ROBOTS["turtlebot4"], 0.0, None),
        (replace(KOBUKI, deceleration=0.4), -1.5, 0.1),
    ],
)
def test_it_stops_at_the_goal_with_the_heading_that_is_wanted(
    robot: RobotModel, heading: float, radius: float | None
) -> None:
    pilot = Pilot(card(**ALL_ROUND), seek, robot=robot, goal_radius=radius)
    pilot.begin((2.0, 1.5), heading=heading)
    end = drive_to(pilot, (0.0, 0.0, -2.0))
    assert math.dist(end[:2], (2.0, 1.5)) <= 1.05 * (radius or 0.5)
    assert abs(math.remainder(end[2] - heading, math.tau)) < math.radians(6.0)


def test_angles_in_degrees_are_answered_by_the_ones_meant() -> None:
    pilot = a_pilot((1.0, 1.0))
    with pytest.raises(ValueError, match=r"heading must be at most 6.283 rad .* did you mean 1.57"):
        pilot.begin((2.0, 0.0), heading=90.0)
    with pytest.raises(ValueError, match=r"plan_pose must be .* did you mean 1.571, which is 90"):
        plan_at(World(name="empty"), (0.0, 0.0, 90.0))


def test_a_heading_needs_a_robot_that_turns_on_the_spot() -> None:
    pilot = Pilot(card(), lambda _: np.zeros((1, 2), np.float32))
    with pytest.raises(ValueError, match="heading must be None for turtlebot2, which cannot turn"):
        pilot.begin((2.0, 0.0), heading=0.0)
    assert pilot.goal is None
    with pytest.raises(ValueError, match="goal_radius must be positive, got 0"):
        Pilot(card(), lambda _: np.zeros((1, 2), np.float32), goal_radius=0.0)


MAPPED = {**ALL_ROUND, "observation_size": 45, "memory": "map"}


@pytest.mark.parametrize("turn", [0.0, 0.4, -math.pi / 2])
def test_a_plan_shows_the_path_around_what_no_scan_has_seen(turn: float) -> None:
    seen: list[np.ndarray] = []

    def ahead(observation: np.ndarray) -> np.ndarray:
        seen.append(observation[0].copy())
        return np.zeros((1, 2), np.float32)

    wall = World(name="wall", size=(12.0, 8.0), boxes=(Box(1.0, -4.0, 1.2, 2.5),))
    pilot = Pilot(card(**MAPPED), ahead)
    for plan in (None, wall):
        goal = 3.0 * math.cos(turn) + 5.0, 3.0 * math.sin(turn) - 2.0
        where = {} if plan is None else {"plan": plan, "plan_pose": (5.0, -2.0, turn)}
        pilot.begin(goal, **where)
        free = Scan(-math.pi, math.pi / 180, np.full(360, math.inf), 0.0, 10.0)
        pilot.decide(free, (5.0, -2.0, turn), (0.0, 0.0))
    without, with_plan = (each[[42, 43, 44]] for each in seen)
    assert without[0] > 0.99 and without[2] == pytest.approx(0.3, abs=0.02)
    assert with_plan[1] > 0.5 and with_plan[2] > 0.6
    assert pilot.plan is wall


def test_a_plan_moves_with_the_localization_and_bounds_the_goal() -> None:
    pilot = Pilot(card(**MAPPED), lambda _: np.zeros((1, 2), np.float32))
    plan = World(name="plan", size=(12.0, 8.0))
    with pytest.raises(ValueError, match=r"12 m x 8 m \(plan\) around \(0.00, 0.00\), got \(7.00"):
        pilot.begin((7.0, 0.0), plan=plan)
    with pytest.raises(ValueError, match="plan must be given to begin"):
        pilot.move_plan((0.0, 0.0, 0.0))
    pilot.begin((5.0, 0.0), plan=plan)
    pilot.move_plan((0.05, 0.0, 0.0))
    assert pilot._ground.plan is not None and pilot._ground.plan.pose == (0.0, 0.0, 0.0)
    pilot.move_plan((0.3, 0.0, 0.0))
    assert pilot._ground.plan.pose == (0.3, 0.0, 0.0)
    with pytest.raises(ValueError, match="plan must be a World, got 'plan"):
        pilot.begin((5.0, 0.0), plan="plan.yaml")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="plan must be None for a policy without a map"):
        a_pilot((0.0, 0.0)).begin((1.0, 0.0), plan=plan)
