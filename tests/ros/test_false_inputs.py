"""Sensors, odometry and policies that fail in a closed loop: the robot stops in time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="exported policies are of the extra onnx")

from mpfa_envs import ROBOTS, Cylinder, World
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.ros.controller import Controller, Order
from mpfa_envs.ros.simulated_robot import SimulatedRobot
from mpfa_envs.sensing.sectors import Silent
from tests.envs.exported import card

HALL = World(name="hall", size=(30.0, 6.0))
POST = World(name="post", size=(30.0, 6.0), cylinders=(Cylinder(0.0, 0.0, 0.03),))
Sees = Callable[[Scan, float], Scan]
Feels = Callable[[Any, float], tuple[Any, Any]]


def ahead(_: Any) -> Any:
    """A policy that drives straight ahead."""
    return np.ones((1, 2), np.float32)


class Loop:
    """A robot 2 m before the middle of a hall, and a controller of the policy."""

    def __init__(
        self,
        network: Any = ahead,
        *,
        world: World = HALL,
        start: tuple[float, float, float] = (-2.0, 0.0, 0.0),
        goal: tuple[float, float] = (14.0, 0.0),
        goal_radius: float = 0.5,
        pilot: dict[str, Any] | None = None,
        learned: Any = ROBOTS["turtlebot2"],
        max_range: float = 40.0,
    ) -> None:
        # Where it sees the ends of the hall, it sees something else from everywhere.
        self.robot = SimulatedRobot(world, robot=learned, physics="kinematic", max_range=max_range)
        self.robot.place(start)
        made = Pilot(card(robot=learned, goal_radius=goal_radius), network, **(pilot or {}))
        self.controller = Controller(made)
        self.controller.aim(goal)
        self.told: list[str] = []
        """The reasons of all orders."""

    def run(
        self,
        seconds: float,
        sees: Sees = lambda scan, _: scan,
        feels: Feels = lambda motion, _: (motion[:3], motion[3:]),
    ) -> Order | None:
        """Go on for a while, with what the sensors make of it; the last order."""
        end, order = self.robot.time + seconds - 1e-6, None
        while self.robot.time < end:
            now = self.robot.time
            self.controller.feel(*feels(self.robot.motion, now), now)
            self.controller.see(sees(self.robot.scan(), now), now)
            order = self.controller.tick(now)
            if order is not None:
                self.told.append(order.reason.partition(":")[0])
                self.robot.obey(order.linear, order.angular)
            self.robot.step()
            assert not self.robot.touched
        return order

    @property
    def stands(self) -> bool:
        return self.robot.motion[3:] == (0.0, 0.0)


def blind(range_min: float, tells: float | None) -> Sees:
    """A sensor that tells what is too near by some value; None: by the distance."""

    def sees(scan: Scan, _: float) -> Scan:
        ranges = np.asarray(scan.ranges)
        if tells is not None:
            ranges = np.where(ranges < range_min, tells, ranges)
        return scan._replace(ranges=ranges, range_min=range_min)

    return sees


@pytest.mark.parametrize(
    ("tells", "world", "silent"),
    [
        (math.nan, POST, "reject"),
        (0.0, HALL, "far"),
        (-math.inf, POST, "far"),
        (None, HALL, "reject"),
    ],
)
def test_it_stops_for_what_is_too_near_for_its_sensor(
    tells: float | None, world: World, silent: Silent
) -> None:
    # The stop distance ends 0.23 m from the center, where the sensor has long been blind.
    start = (-2.0, 0.0, 0.0) if world is POST else (13.0, 0.0, 0.0)
    loop = Loop(
        world=world, start=start, goal=(14.9, 0.0), goal_radius=0.01, pilot={"silent": silent}
    )
    loop.run(6.0, blind(0.45, tells))
    assert loop.stands and loop.robot.motion.x - start[0] > 1.2
    assert loop.controller.pilot.goal is not None


def test_stopping_beyond_the_blind_zone_needs_no_valid_rays() -> None:
    loop = Loop(world=POST)
    loop.controller = Controller(loop.controller.pilot, stop_distance=0.3)

    def misses(scan: Scan, _: float) -> Scan:
        ranges = np.array(scan.ranges)
        ranges[90] = math.nan  # A ray in front, to the right.
        return scan._replace(ranges=ranges, range_min=0.45)

    assert loop.run(1.0, misses).reason == "driving"
    loop.run(5.0, misses)
    assert loop.stands and loop.told[-1] == "obstacle"


def test_the_message_of_a_hiding_ray_says_what_helps() -> None:
    loop = Loop()
    order = loop.run(
        0.1, lambda scan, _: scan._replace(range_min=0.45, ranges=[3.0, math.nan] * 180)
    )
    assert order is not None and order.reason == (
        "a ray in front is not valid, and may hide what is nearer than range_min, 0.45 m: "
        "raise stop_distance by 0.22 m"
    )


@pytest.mark.parametrize(("x", "more"), [(0.0, "0.22"), (0.1, "0.32"), (-0.1, "0.22")])
def test_a_ray_that_may_hide_something_is_answered_by_what_helps(x: float, more: str) -> None:
    loop = Loop(pilot={"mount": (x, 0.0, 0.0)})
    hiding = {"range_min": 0.45, "ranges": [3.0, math.nan] * 180}
    order = loop.run(0.1, lambda scan, _: scan._replace(**hiding))
    assert order is not None and order.reason == (
        "a ray in front is not valid, and may hide what is nearer than range_min, 0.45 m: "
        f"raise stop_distance by {more} m"
    )


def test_a_scan_that_repeats_itself_stops_it_until_it_changes() -> None:
    loop = Loop()
    loop.run(1.0)
    frozen = loop.robot.scan()
    start = loop.robot.motion.x
    order = loop.run(3.0, lambda *_: frozen)
    assert order is not None and order.reason == "repeated scan: 2.9 s old"
    # Half a second at 0.5 m/s, and what it drives until the next scan.
    assert loop.stands and loop.robot.motion.x - start < 0.36
    assert loop.run(0.2).reason == "driving"


def test_a_repeated_scan_counts_from_its_first_time_for_obstacles() -> None:
    loop = Loop(start=(14.0, 0.0, 0.0), goal=(14.9, 0.0), goal_radius=0.01)
    loop.run(0.8)
    frozen = loop.robot.scan()
    loop.run(3.0, lambda *_: frozen)
    assert loop.stands and loop.robot.motion.x < 14.78


def test_equal_scans_while_standing_do_not_stop_it() -> None:
    standing = [True]
    loop = Loop(lambda seen: ahead(seen) * (-1.0 if standing else 1.0), learned=still_wheels())
    loop.run(3.0)
    assert loop.stands and set(loop.told) == {"driving"}
    standing.clear()
    loop.run(3.0)
    assert loop.robot.motion.x > -1.0 and set(loop.told) == {"driving"}


@pytest.mark.parametrize("behind", [1, 2])
def test_odometry_that_lags_does_not_make_a_scan_repeat_itself(behind: int) -> None:
    loop = Loop(start=(13.5, 0.0, 0.0), goal=(14.9, 0.0), goal_radius=0.01)
    late: list[Any] = []

    def feels(motion: Any, _: float) -> tuple[Any, Any]:
        late.append((motion[:3], motion[3:]))
        return late[max(len(late) - 1 - behind, 0)]

    loop.run(8.0, feels=feels)
    assert loop.stands and loop.told[-1] == "obstacle"


def slides(motion: Any, time: float) -> tuple[Any, Any]:
    """0.19 m with each message, every 20 ms or every 100 ms."""
    return (motion.x + 1.9 * max(time - 1.0, 0.0), motion.y, motion.heading), motion[3:]


def turns_about(motion: Any, time: float) -> tuple[Any, Any]:
    return (motion.x, motion.y, motion.heading + (3.1 if time > 1.0 else 0.0)), motion[3:]


def turns_slowly(motion: Any, time: float) -> tuple[Any, Any]:
    """By less than it may from message to message."""
    heading = motion.heading + 12.0 * max(time - 1.0, 0.0)
    return (motion.x, motion.y, math.remainder(heading, math.tau)), motion[3:]


def freezes(motion: Any, time: float) -> tuple[Any, Any]:
    return ((-1.5, 0.0, 0.0), (0.5, 0.0)) if time > 1.0 else (motion[:3], motion[3:])


@pytest.mark.parametrize(
    ("feels", "reason", "farthest"),
    [
        (slides, "odometry jumped", 0.5),
        (turns_about, "odometry jumped", 0.2),
        (turns_slowly, "odometry jumped", 0.6),
        (freezes, "odometry stands still", 0.8),
    ],
)
def test_odometry_that_contradicts_the_wheels_gives_up_the_goal(
    feels: Feels, reason: str, farthest: float
) -> None:
    loop = Loop()
    loop.run(1.0, feels=feels)
    start = loop.robot.motion.x
    loop.run(4.0, feels=feels)
    assert loop.told.count(reason) == 1 and loop.told[-1] == reason
    assert loop.controller.pilot.goal is None
    assert loop.stands and loop.robot.motion.x - start < farthest


@pytest.mark.parametrize("speeds", [(-1e9, 0.0), (0.5, -40.0)])
def test_impossible_speeds_stop_it_while_they_last(
    speeds: tuple[float, float],
) -> None:
    loop = Loop()
    loop.run(1.0)
    loop.run(1.0, feels=lambda motion, _: (motion[:3], speeds))
    assert loop.stands and loop.told[-1] == "odometry too fast"
    loop.run(0.5)
    assert loop.told[-1] == "driving"


def failing(result: Any) -> Any:
    """A policy that drives at first, fails from the eighth decision on, and then recovers."""
    asked: Iterator[int] = iter(range(100))

    def network(seen: Any) -> Any:
        if next(asked) != 7:
            return ahead(seen)
        if isinstance(result, Exception):
            raise result
        return result

    return network


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (MemoryError("of the runtime"), "failed: MemoryError('of the runtime')"),
        (None, "policy must give actions of shape (1, 2) for observations of shape"),
        (np.ones((0, 2), np.float32), "policy must give actions of shape (1, 2)"),
        (np.ones((1, 3), np.float32), "policy must give actions of shape (1, 2)"),
        (
            np.full((1, 2), math.nan, np.float32),
            "the network's action must be finite, got [nan nan]",
        ),
        (
            np.full((1, 2), math.inf, np.float32),
            "the network's action must be finite, got [inf inf]",
        ),
    ],
    ids=["raises", "nothing", "empty", "three", "nan", "inf"],
)
def test_a_failing_policy_stops_it_and_is_reported_once(result: Any, reason: str) -> None:
    loop = Loop(failing(result))
    orders: list[Order] = []
    tick = loop.controller.tick

    def noting(now: float) -> Order | None:
        order = tick(now)
        orders.extend([] if order is None else [order])
        return order

    loop.controller.tick = noting
    loop.run(5.0)
    assert loop.stands and loop.controller.pilot.goal is None
    assert [order.reason.startswith(reason) for order in orders].count(True) == 1
    assert orders[-1][:2] == (0.0, 0.0) and orders[-1].reason.startswith(reason)
    assert {order.reason for order in orders[:-1]} == {"driving"}


def degrees(scan: Scan, _: float) -> Scan:
    return scan._replace(angle_min=-180.0, angle_increment=1.0)


def three_turns(scan: Scan, _: float) -> Scan:
    return scan._replace(ranges=np.tile(np.asarray(scan.ranges), 3))


def millimeters(scan: Scan, _: float) -> Scan:
    return scan._replace(ranges=1000.0 * np.asarray(scan.ranges))


@pytest.mark.parametrize(
    ("sees", "reason"),
    [
        (degrees, "the rays of a scan must go round once"),
        (three_turns, "the rays of a scan must go round once"),
        (millimeters, "ranges and range_max must be in meters"),
    ],
)
def test_a_scan_in_another_unit_stops_it(sees: Sees, reason: str) -> None:
    loop = Loop()
    order = loop.run(0.5, sees)
    assert order is not None and order.reason.startswith(reason)
    assert loop.stands


def without_numbers(scan: Scan, _: float) -> Scan:
    return scan._replace(ranges=[None] * len(np.asarray(scan.ranges)))


def masked(scan: Scan, _: float) -> Scan:
    return scan._replace(ranges=np.ma.masked_less(np.asarray(scan.ranges), 3.5))


def ragged(scan: Scan, _: float) -> Scan:
    return scan._replace(ranges=[*np.asarray(scan.ranges)[1:], [1.0]])


@pytest.mark.parametrize("sees", [without_numbers, masked, ragged])
def test_a_scan_that_is_no_numbers_stops_it_while_it_lasts(sees: Sees) -> None:
    loop = Loop()
    loop.run(0.5)
    order = loop.run(0.5, sees)
    assert order is not None and order.reason.startswith("ranges must be real numbers, got ")
    assert loop.stands
    assert loop.run(0.2).reason == "driving"


@pytest.mark.parametrize("stamp", [None, "0.5", 1j, True])
def test_a_stamp_that_is_no_number_stops_it_while_it_lasts(stamp: Any) -> None:
    loop = Loop()
    loop.run(0.5)
    now = loop.robot.time
    loop.controller.see(loop.robot.scan(), stamp)
    order = loop.controller.tick(now)
    assert order is not None
    assert order == (0.0, 0.0, f"time must be a real number, got {stamp!r}")
    assert loop.run(0.2).reason == "driving"


def still_wheels(slowest: float = 0.0) -> Any:
    """A TurtleBot2 whose wheels can stand, or turn backwards."""
    return replace(ROBOTS["turtlebot2"], min_wheel_speed=slowest)


@pytest.mark.parametrize("tells", [None, math.nan])
def test_a_robot_that_reverses_stops_for_what_is_behind(tells: float | None) -> None:
    loop = Loop(lambda seen: -ahead(seen), start=(-13.0, 0.0, 0.0), learned=still_wheels(-0.5))
    loop.run(5.0, blind(0.3, tells))
    assert loop.stands and loop.told[-1] == "obstacle" and loop.robot.motion.x < -14.0


def test_a_robot_that_reverses_leaves_what_is_in_front() -> None:
    loop = Loop(lambda seen: -ahead(seen), start=(14.79, 0.0, 0.0), goal=(0.0, 0.0),
                learned=still_wheels(-0.5))  # fmt: skip
    loop.run(2.0)
    assert set(loop.told) == {"driving"} and loop.robot.motion.x < 14.0
