"""What the controller says of a goal: unreachable in seconds, and disturbances as notes alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
pytest.importorskip("numba", reason="maps need Numba")

from mpfa_envs import ROBOTS, Box, Cylinder, World, export_policy, load_policy
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.ros.controller import Controller
from mpfa_envs.ros.simulated_robot import SimulatedRobot

BOX = (
    Box(1.0, -1.0, 2.6, -0.9),
    Box(1.0, 0.9, 2.6, 1.0),
    Box(1.0, -0.9, 1.1, 0.9),
    Box(2.5, -0.9, 2.6, 0.9),
)
"""Four walls without a door."""
WALL = (Box(0.5, -3.0, 0.6, -0.5), Box(0.5, 0.5, 0.6, 3.0))
"""A wall across the room, with a door of 1 m."""
DOOR = Cylinder(0.55, 0.0, 0.3)
"""Who stands in the door."""


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy")
    return export_policy(load_policy("td3-rooms"), folder / "policy.onnx")


def room(*obstacles: Any) -> World:
    """A room of 8 x 6 m."""
    boxes = tuple(each for each in obstacles if isinstance(each, Box))
    cylinders = tuple(each for each in obstacles if isinstance(each, Cylinder))
    return World(name="room", size=(8.0, 6.0), boxes=boxes, cylinders=cylinders)


class Drive:
    """A Kobuki at (-2, 0) and its controller."""

    def __init__(self, policy: Path, world: World, **options: Any) -> None:
        self.robot = SimulatedRobot(world, robot="kobuki", physics="kinematic", time_step=0.1)
        self.robot.place((-2.0, 0.0, 0.0))
        self.controller = Controller(Pilot.load(policy, clearance=0.03, **options))
        self.notes: list[tuple[float, str]] = []

    def run(
        self,
        limit: float,
        *,
        sees: Callable[[Scan, float], Scan] = lambda scan, _: scan,
        feels: Callable[[Any, float], Any] = lambda motion, _: motion,
        share: float = 1.0,
    ) -> tuple[str, str, float]:
        """Drive for a time at most; state and reason at the end, and the time [s]."""
        start, reason = self.robot.time, ""
        while self.robot.time < start + limit:
            now = self.robot.time
            motion = feels(self.robot.motion, now - start)
            self.controller.feel(tuple(motion[:3]), tuple(motion[3:]), now)
            self.controller.see(sees(self.robot.scan(), now - start), now)
            order = self.controller.tick(now)
            note = self.controller.note(now)
            if note and (not self.notes or self.notes[-1][1] != note):
                self.notes.append((now - start, note))
            if order is not None:
                reason = order.reason
                self.robot.obey(share * order.linear, share * order.angular)
            if self.controller.state not in ("accepted", "driving", "waiting"):
                break
            self.robot.step()
            assert not self.robot.touched
        return self.controller.state, reason, self.robot.time - start


def test_a_goal_in_a_closed_box_is_said_to_be_unreachable(policy: Path) -> None:
    drive = Drive(policy, room(*BOX))
    drive.controller.aim((1.8, 0.0))
    state, reason, time = drive.run(60.0)
    assert (state, reason) == (
        "given up",
        "unreachable: for 10 s walls that were seen have closed the goal in",
    )
    # It drives round the box first; without the map's word it would take 57 s.
    assert time < 30.0
    assert drive.notes[0][1] == "unreachable so far: walls that were seen close the goal in"
    assert drive.notes[0][0] < 20.0


def test_a_goal_behind_a_wall_is_said_at_once(policy: Path) -> None:
    drive = Drive(policy, room(Box(0.5, -3.0, 0.6, 3.0)))
    drive.controller.aim((2.5, 0.0))
    state, _, time = drive.run(60.0)
    assert state == "given up" and time < 16.0 and drive.notes[0][0] < 5.0


def test_who_stands_in_the_only_door_for_a_while_closes_nothing_for_good(policy: Path) -> None:
    drive = Drive(policy, room(*WALL, DOOR))
    drive.controller.aim((2.5, 0.0))
    assert drive.run(6.0)[0] == "driving" or drive.controller.state == "waiting"
    assert drive.notes and drive.notes[-1][1].startswith("unreachable so far")
    drive.robot.become(room(*WALL))
    drive.run(4.0)
    assert not drive.controller.note(drive.robot.time).startswith("unreachable")
    assert drive.run(60.0)[0] == "arrived"


@pytest.mark.parametrize("goal", [(1.8, 0.0), (3.0, 0.0)])
def test_a_goal_that_the_plan_closes_in_is_rejected_at_once(
    policy: Path, goal: tuple[float, float]
) -> None:
    drive = Drive(policy, room(*BOX))
    drive.controller.know(room(*BOX), (0.0, 0.0, 0.0))
    drive.controller.aim(goal)
    closed = goal[0] < 2.0
    state, reason, time = drive.run(30.0)
    assert state == ("rejected" if closed else "arrived")
    assert not closed or reason == "goal must be reachable, got (1.80, 0.00): the plan closes it in"
    assert not closed or time == 0.0


def test_a_ray_that_ends_inside_the_robot_is_named(policy: Path) -> None:
    def sees(scan: Scan, _: float) -> Scan:
        ranges = np.array(scan.ranges)
        ranges[160] = 0.05
        return scan._replace(ranges=ranges, range_min=0.02)

    drive = Drive(policy, room())
    drive.controller.aim((2.0, 0.0))
    drive.run(1.0, sees=sees)
    assert drive.notes == [
        (
            pytest.approx(0.0),
            "the ray at -20 degrees of the scan ends 0.13 m inside the robot: "
            "filter the robot's own parts out of the scan, or clean the lidar",
        )
    ]


def test_what_is_at_the_rim_is_not_inside_the_robot(policy: Path) -> None:
    drive = Drive(policy, room())
    drive.controller.aim((2.0, 0.0))
    drive.run(0.1, sees=lambda scan, _: scan._replace(ranges=np.full(360, 0.16), range_min=0.12))
    assert drive.notes == []


def test_wheels_that_are_slow_are_said_and_the_robot_arrives(policy: Path) -> None:
    drive = Drive(policy, room())
    drive.controller.aim((3.0, 0.0))
    assert drive.run(60.0, share=0.4)[0] == "arrived"
    assert next(note for _, note in drive.notes) == (
        "wheels are slow: the robot moves 40% of the ordered distance"
    )


def test_wheels_that_obey_are_not_slow(policy: Path) -> None:
    drive = Drive(policy, room(*WALL))
    drive.controller.aim((3.0, 0.0))
    assert drive.run(60.0)[0] == "arrived" and drive.notes == []


@pytest.mark.parametrize("turn", [0.0, 20.0])
def test_a_small_jump_of_the_pose_is_said_and_the_robot_arrives(policy: Path, turn: float) -> None:
    off = (0.15, math.radians(turn)) if not turn else (0.0, math.radians(turn))

    def feels(motion: Any, time: float) -> Any:
        if time < 1.95:
            return motion
        return motion._replace(x=motion.x + off[0], heading=motion.heading + off[1])

    drive = Drive(policy, room())
    drive.controller.aim((2.0, 0.0))
    assert drive.run(60.0, feels=feels)[0] == "arrived"
    assert len(drive.notes) == 1 and drive.notes[0][0] == pytest.approx(2.0)
    assert drive.notes[0][1].startswith("pushed, or its pose corrected: ")


@pytest.mark.parametrize("lost", [False, True])
def test_a_scan_that_is_late_or_lacks_rays_while_the_robot_turns_keeps_the_goal(
    policy: Path, lost: bool
) -> None:
    robot = replace(ROBOTS["kobuki"], name="scout", field_of_view=240.0)
    pilot = Pilot.load(policy, robot=robot, clearance=0.03, unseen=0.3, latency=0.1)
    controller, told = Controller(pilot), set()
    controller.aim((3.0, 0.0))
    for step in range(60):
        now, turned = 0.05 * step, 2.5 * 0.05 * step
        controller.feel((0.0, 0.0, turned), (0.0, 2.5), now)
        if step % 5 == 0:  # The scans of a lidar with 5 Hz, now and then one less.
            ranges = np.full(241, 4.0) + 0.001 * step
            ranges[:60] = math.nan if lost and step % 10 == 0 else ranges[:60]
            controller.see(Scan(-math.radians(120), math.radians(1), ranges, 0.1, 10.0), now)
        order = controller.tick(now)
        assert order is not None
        told.add((order.reason.partition(" of ")[0], controller.state))
        assert order.reason == "driving" or order[:2] == (0.0, 0.0)
    brakes = {("no ray", "waiting")} if lost else set()
    assert told == {("driving", "driving")} | brakes
    assert controller.pilot.goal is not None
