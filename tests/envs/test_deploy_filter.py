"""What a pilot's filter and pace allow, for robots of all kinds."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import ROBOTS, RobotModel
from mpfa_envs.deploy import Pilot, Scan, ScanError
from mpfa_envs.deploy.adaptation import body_of, filter_of
from mpfa_envs.robots.drives import KinematicDrives
from tests.envs.exported import card

KOBUKI = ROBOTS["kobuki"]
ALL_ROUND = {"robot": KOBUKI, "sectors": 36, "field_of_view": 360.0, "observation_size": 42}


def a_pilot(action: tuple[float, float], **options: Any) -> Pilot:
    """A pilot of a Kobuki's policy that always wants the same, on its way."""
    made = Pilot(card(**ALL_ROUND), lambda _: np.array([action], np.float32), **options)
    made.begin((4.0, 0.0))
    return made


@pytest.mark.parametrize(
    ("change", "pace"),
    [
        ({"wheel_acceleration": 0.2}, 0.5),  # At a pace p wheels change by p² of 0.8 m/s².
        ({"wheel_acceleration": 0.05}, 0.25),
        ({"wheel_acceleration": 4.0}, 1.0),
        ({"wheel_acceleration": None}, 1.0),
        ({"deceleration": 0.2}, 0.5),
        ({"turn_acceleration": 1.0}, 1.0),  # The policy's wheels turn it as fast as they can.
        ({"turn_limit": 1.0}, 1.0 / math.pi),
        ({"max_wheel_speed": 0.35, "min_wheel_speed": -0.35}, 0.5),
        ({"radius": 0.19, "wheel_base": 0.345, "wheel_acceleration": 0.3}, 0.5),
    ],
)
def test_the_pace_is_one_at_which_the_robot_can_do_what_the_policy_knows(
    change: dict[str, Any], pace: float
) -> None:
    own = replace(KOBUKI, name="own", **change)
    assert a_pilot((1.0, 1.0), robot=own).pace == pytest.approx(pace, rel=0.03)
    if pace < 1.0:
        with pytest.raises(ValueError, match=r"pace must be .* at most .*, as own .* got 1.0"):
            a_pilot((1.0, 1.0), robot=own, pace=1.0)


def wall_at(distance: float) -> Scan:
    """A scan all around of a wall ahead [m]."""
    angles = -math.pi + np.arange(720) * math.tau / 720
    ahead = np.maximum(np.cos(angles), 1e-9)
    return Scan(-math.pi, math.tau / 720, np.minimum(distance / ahead, 5.0))


@pytest.mark.parametrize(
    "own",
    [
        KOBUKI,
        replace(KOBUKI, name="slow", wheel_acceleration=0.2),
        replace(KOBUKI, name="quick", wheel_acceleration=None),
        replace(KOBUKI, name="brakes", deceleration=0.4),
        replace(KOBUKI, name="turns", turn_acceleration=1.0),
        replace(KOBUKI, name="wider", radius=0.19, wheel_base=0.3),
        ROBOTS["turtlebot4"],
        ROBOTS["burger"],
    ],
)
@pytest.mark.parametrize("tick", [0.02, 0.1])
def test_a_filter_brakes_as_the_robot_does(own: RobotModel, tick: float) -> None:
    pilot, base = a_pilot((1.0, 1.0), robot=own, clearance=0.03), own.wheel_base
    drives = KinematicDrives(own, 1, time_step=tick)
    motions, told, due = np.zeros((1, 5)), (0.0, 0.0), 0.0
    fastest, least = 0.0, math.inf
    for step in range(round(25.0 / tick)):
        x, y, _, linear, _ = motions[0].tolist()
        if step * tick >= due - 1e-9:
            # The wall is at x = 3 m, and the robot drives straight on or stops.
            scan = wall_at(3.0 - x)
            command = pilot.decide(scan, (x, y, 0.0), (linear, 0.0))
            wanted = (command.linear, 0.0) if command.linear > 0.69 * pilot.pace else (0.0, 0.0)
            due = step * tick + pilot.period
        told = pilot.ramp(told, wanted, tick)
        speeds = np.array([[told[0], told[0]]]) - 0.5 * told[1] * base
        drives.move(motions, np.ones(1, dtype=np.bool_), speeds)
        fastest, least = max(fastest, linear), min(least, 3.0 - motions[0, 0] - own.radius)
    assert fastest > 0.6 * pilot.pace
    assert 0.01 <= least < 0.5


def test_orders_change_no_faster_than_the_policy_knows() -> None:
    quick = a_pilot((1.0, 1.0), robot="burger")
    most = 0.8 * quick.pace**2
    assert quick.ramp((0.0, 0.0), (0.2, 0.0), 0.5) == pytest.approx((0.5 * most, 0.0))
    linear, angular = quick.ramp((0.1, 0.0), (0.0, 1.0), 0.5)
    assert (linear, 0.115 * angular) == pytest.approx((0.1 - 0.25 * most, 0.25 * most), abs=0.02)
    assert quick.ramp((0.1, 0.0), (0.11, 0.0), 0.5) == pytest.approx((0.11, 0.0))
    at_once = Pilot(card(), lambda _: np.zeros((1, 2), np.float32))
    assert at_once.ramp((0.0, 0.0), (0.5, 1.0), 0.0) == (0.5, 1.0)


@pytest.mark.parametrize("clearance", [None, 0.03])
@pytest.mark.parametrize(
    ("half", "action", "drives"),
    [
        (179.5, (-0.5, -0.5), True), (135.0, (-0.5, -0.5), False), (90.0, (-0.5, -0.4), False),
        (135.0, (0.5, 0.5), True), (90.0, (0.5, 0.4), True), (30.0, (0.5, 0.5), False),
        (135.0, (-0.3, 0.3), True),
    ],
)  # fmt: skip
def test_it_does_not_drive_where_the_scan_does_not_look(
    half: float, action: tuple[float, float], drives: bool, clearance: float | None
) -> None:
    count = round(2 * half) + 1
    scan = Scan(-math.radians(half), math.pi / 180, np.full(count, 3.0))
    for unseen in (10.0, 0.5):
        pilot = a_pilot(action, unseen=unseen, clearance=clearance)
        if clearance and half < 90.0:
            with pytest.raises(ScanError, match="up to 90 degrees from ahead for the filter"):
                pilot.decide(scan, (0.0, 0.0, 0.0), (0.0, 0.0))
            continue
        command = pilot.decide(scan, (0.0, 0.0, 0.0), (0.0, 0.0))
        linear, angular = 0.35 * sum(action), 0.7 * (action[1] - action[0]) / 0.23
        wanted = (linear if drives else 0.0, angular)
        assert command[2:] == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("view", [60.0, 120.0, 179.0])
def test_a_filter_of_a_robot_that_sees_too_little_is_rejected(view: float) -> None:
    narrow = replace(KOBUKI, field_of_view=view)
    with pytest.raises(ValueError, match=f"field_of_view must be at least 180 .* got {view:.0f}"):
        a_pilot((0.5, 0.5), robot=narrow, clearance=0.03)
    assert not a_pilot((0.5, 0.5), robot=narrow).has_filter


def test_a_robot_that_cannot_stop_has_no_filter() -> None:
    message = r"clearance must be None for a policy of turtlebot2, .* 0.05 m/s .*, got 0.03"
    with pytest.raises(ValueError, match=message):
        Pilot(card(), lambda _: np.zeros((1, 2), np.float32), clearance=0.03)


def test_what_a_robot_can_do_at_a_pace_is_more_in_the_units_of_the_training() -> None:
    learned = ROBOTS["kobuki"]
    robot = replace(learned, turn_acceleration=1.0, wheel_acceleration=0.1)
    body = body_of(learned, robot, 0.5)
    # At half of the pace time passes half as fast, so that changes of speed count four times.
    assert (body.turn_acceleration, body.wheel_acceleration) == (4.0, pytest.approx(0.4))
    assert body_of(robot, learned, 1.0).turn_acceleration == 1.0
    ahead = replace(learned, reverse=False)
    assert not body_of(learned, ahead, 1.0).reverse and not body_of(ahead, learned, 1.0).reverse
    assert body_of(learned, learned, 1.0).reverse


@pytest.mark.parametrize(("reduction", "rays"), [("single", 1), ("min", 5), ("median", 5)])
def test_a_sector_may_have_been_met_in_any_direction_but_where_it_has_one_ray(
    reduction: str, rays: int
) -> None:
    keep = filter_of(card(**ALL_ROUND, reduction=reduction), KOBUKI, KOBUKI, 0.03)
    assert keep is not None and keep._rays == rays
