"""What the policy's node decides: when it drives, and all that it stops for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="exported policies are of the extra onnx")

from mpfa_envs import ROBOTS
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.ros import messages
from mpfa_envs.ros.controller import Controller, Order
from tests.envs.exported import card

STILL = (0.0, 0.0)


def scan(*ranges: float, free: float = 3.0) -> Scan:
    """A scan all around, a ray a degree from behind; the given ranges begin ahead."""
    values = np.full(360, free)
    values[180 : 180 + len(ranges)] = ranges
    return Scan(-math.pi, math.pi / 180, values, 0.1, 8.0)


def make(
    robot: str = "turtlebot2", *, field_of_view: float = 180.0, **options: Any
) -> tuple[Controller, list[np.ndarray]]:
    """A controller that wants to drive straight ahead, and what its network is asked."""
    asked: list[np.ndarray] = []

    def ahead(seen: np.ndarray) -> np.ndarray:
        asked.append(seen[0])
        return np.ones((1, 2), np.float32)

    seeing = card(field_of_view=field_of_view)
    return Controller(Pilot(seeing, ahead, robot=robot), **options), asked


def ready(
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0), **options: Any
) -> tuple[Controller, list[np.ndarray]]:
    """One that has all that it needs at time 10."""
    controller, asked = make(**options)
    controller.aim((4.0, 0.0))
    controller.see(scan(), 10.0)
    controller.feel(pose, STILL, 10.0)
    return controller, asked


def reasons(controller: Controller, times: Sequence[float]) -> list[str | None]:
    orders = [controller.tick(time) for time in times]
    return [None if order is None else order.reason for order in orders]


def test_an_order_holds_until_the_next_decision_is_due() -> None:
    controller, asked = ready()
    times = [10.0, 10.05, 10.1, 10.15, 10.17, 10.2, 10.3, 10.35]
    assert reasons(controller, times) == ["driving"] * 8
    assert len(asked) == 3  # At 10, at 10.17, a little early, and at 10.35.


def test_a_clock_that_jumps_back_brings_a_new_decision() -> None:
    controller, asked = ready()
    controller.tick(10.0)
    controller.tick(9.9)
    assert len(asked) == 2


def test_it_stops_once_after_a_goal_and_then_is_silent() -> None:
    controller, asked = make()
    controller.see(scan(), 10.0)
    controller.feel((0.0, 0.0, 0.0), STILL, 10.0)
    assert reasons(controller, [10.0, 10.1]) == [None, None]
    controller.aim((4.0, 0.0))
    controller.tick(10.1)
    controller.aim(None)
    assert controller.tick(10.2) == Order(0.0, 0.0, "no goal")
    assert reasons(controller, [10.3, 10.4]) == [None, None]
    assert len(asked) == 1


def test_at_the_goal_it_stops_once_and_takes_the_next() -> None:
    controller, asked = ready((3.45, 0.2, 0.0))
    controller.tick(10.0)
    controller.feel((3.6, 0.2, 0.0), (0.5, 0.0), 10.1)
    assert controller.tick(10.1) == Order(0.0, 0.0, "arrived")
    assert reasons(controller, [10.2, 10.3]) == [None, None]
    controller.aim((0.0, 0.0))
    assert reasons(controller, [10.31]) == ["driving"]
    assert len(asked) == 2


def test_it_waits_for_the_first_scan_and_odometry() -> None:
    controller, _ = make()
    controller.aim((4.0, 0.0))
    assert controller.tick(10.0) == Order(0.0, 0.0, "no scan")
    controller.see(scan(), 10.0)
    assert controller.tick(10.0) == Order(0.0, 0.0, "no odometry")
    controller.feel((0.0, 0.0, 0.0), STILL, 10.0)
    assert reasons(controller, [10.0]) == ["driving"]


@pytest.mark.parametrize(
    ("sensor", "stamp", "now", "reason"),
    [
        ("scan", 12.0, 10.0, "stale scan: -2.0 s old"),
        ("scan", math.nan, 10.0, "stale scan: nan s old"),
        ("scan", 10.2, 10.0, "stale scan: -0.2 s old"),
        ("scan", 10.1, 10.0, "driving"),  # Clocks differ a little.
        ("odometry", 10.3, 10.0, "stale odometry: -0.3 s old"),
        ("odometry", 10.0, 10.6, "stale odometry: 0.6 s old"),
        ("odometry", 10.0, 10.5, "driving"),
    ],
)
def test_what_is_too_old_or_from_the_future_stops_it(
    sensor: str, stamp: float, now: float, reason: str
) -> None:
    controller, _ = ready(scan_timeout=9.0)
    if sensor == "scan":
        controller.see(scan(), stamp)
    else:
        controller.feel((0.0, 0.0, 0.0), STILL, stamp)
    assert reasons(controller, [now]) == [reason]


@pytest.mark.parametrize(
    ("robot", "nearest", "reason"),
    [
        ("turtlebot2", 0.281, "driving"),
        ("turtlebot2", 0.279, "obstacle: 0.10 m from the rim"),
        ("turtlebot2", 0.2, "obstacle: 0.02 m from the rim"),
        ("turtlebot2", 0.05, "obstacle: 0.00 m from the rim"),  # The lidar measures from 0.1 m.
        ("turtlebot2", -math.inf, "obstacle: 0.00 m from the rim"),
        ("burger", 0.21, "driving"),
        ("burger", 0.20, "obstacle: 0.10 m from the rim"),
    ],
)
def test_an_obstacle_inside_the_stop_distance_stops_it(
    robot: str, nearest: float, reason: str
) -> None:
    controller, _ = ready(robot=robot, stop_distance=0.1)
    controller.see(scan(2.0, nearest, 2.0), 10.0)
    order = controller.tick(10.0)
    assert order is not None and order.reason == reason
    assert order[:2] == (({"burger": 0.22}.get(robot, 0.5) if reason == "driving" else 0.0), 0.0)
    controller.see(scan(), 10.1)
    assert reasons(controller, [10.1]) == ["driving"]


@pytest.mark.parametrize(("clearance", "stops"), [(None, True), (0.03, False)])
def test_what_a_filter_allows_is_driven_and_without_one_an_obstacle_leaves_the_turn(
    clearance: float | None, stops: bool
) -> None:
    facts = card(robot=ROBOTS["kobuki"], sectors=36, field_of_view=360.0, observation_size=42)
    arc = np.array([[0.0, 0.5]], np.float32)
    controller = Controller(Pilot(facts, lambda _: arc, clearance=clearance), stop_distance=0.05)
    controller.aim((4.0, 0.0))
    beside = np.full(360, 3.0)
    beside[90:92] = 0.18 + 0.04  # To the right.
    controller.see(Scan(-math.pi, math.pi / 180, np.roll(beside, 5), 0.1, 8.0), 10.0)
    controller.feel((0.0, 0.0, 0.0), STILL, 10.0)
    orders = [controller.tick(10.0 + 0.05 * step) for step in range(3)]
    assert all(order is not None and order.angular > 0.0 for order in orders[1:])
    assert all(order is not None and (order.linear == 0.0) == stops for order in orders[1:])


@pytest.mark.parametrize(
    ("robot", "every", "delay"),
    [("turtlebot2", 10, 5), ("burger", 10, 10)],
)
def test_a_wall_is_not_touched_however_late_scans_are(robot: str, every: int, delay: int) -> None:
    pilot = Pilot(card(), lambda seen: np.ones((1, 2), np.float32), robot=robot)
    controller = Controller(pilot, stop_distance=0.05, check_period=0.02)
    controller.aim((40.0, 0.0))
    x, speed, scans, wall = 0.0, 0.0, [], 1.0 + pilot.robot.radius
    for step in range(600):
        now = 0.02 * step
        controller.feel((x, 0.0, 0.0), (speed, 0.0), now)
        if step % every == 0:
            scans.append((now, scan(wall - x)))
        if step >= delay and (step - delay) % every == 0:
            controller.see(scans[(step - delay) // every][1], scans[(step - delay) // every][0])
        order = controller.tick(now)
        assert order is not None
        speed = order.linear
        x += 0.02 * speed
        assert wall - x - pilot.robot.radius > 0.04
    assert order is not None and order.reason.startswith("obstacle")
    assert wall - x - pilot.robot.radius < 0.1


def test_an_aging_scan_stops_it_before_the_obstacle() -> None:
    controller, _ = ready(stop_distance=0.05, scan_timeout=5.0, odometry_timeout=5.0)
    controller.see(scan(0.18 + 0.3), 10.0)
    # At 0.5 m/s 0.05 m remain after 0.5 s; the next check would come 0.05 s later.
    assert reasons(controller, [10.0, 10.4, 10.46]) == [
        "driving", "driving", "obstacle: 0.30 m from the rim",
    ]  # fmt: skip
    controller.feel((0.2, 0.0, 0.0), (0.5, 0.0), 10.48)
    controller.feel((0.2, 0.0, 0.0), STILL, 10.5)
    assert reasons(controller, [10.5]) == ["obstacle: 0.30 m from the rim"]  # It drove since.
    controller.see(scan(0.18 + 0.06), 10.52)
    assert reasons(controller, [10.52]) == ["driving"]  # It stands, and saw it standing.


@pytest.mark.parametrize("late", [0.0, 0.05, 0.15, 0.2])
def test_a_late_scan_enters_the_map_where_it_was_taken(late: float) -> None:
    pytest.importorskip("numba", reason="maps need Numba")
    pilot = Pilot(
        card(memory="map", observation_size=27), lambda seen: np.zeros((1, 2), np.float32)
    )
    entered = []
    assert pilot._ground.map is not None
    sense = pilot._ground.map.sense

    def noting(pose: Any, taken: Any, goal: Any, points: Any) -> np.ndarray:
        angles = points.angles + taken[2]
        nearest = int(points.ranges.argmin())
        x = taken[0] + points.ranges[nearest] * math.cos(angles[nearest])
        entered.append((x, taken[1] + points.ranges[nearest] * math.sin(angles[nearest])))
        return sense(pose, taken, goal, points)

    pilot._ground.map.sense = noting
    controller = Controller(pilot)
    controller.aim((9.0, 0.0))
    # It turns to the left at 2 rad/s, over the direction in which headings begin again.
    for step in range(4):
        time = 10.0 + 0.1 * step
        heading = math.remainder(3.0 + 2.0 * (time - 10.0), math.tau)
        controller.feel((0.1 * step, 0.0, heading), (1.0, 2.0), time)
    taken = 10.3 - late
    controller.see(scan(2.0, free=9.0), taken)
    controller.tick(10.3)
    heading, x = 3.0 + 2.0 * (taken - 10.0), taken - 10.0
    want = x + 2.0 * math.cos(heading), 2.0 * math.sin(heading)
    assert entered == [pytest.approx(want, abs=1e-6)]


def test_what_is_held_stands_still_until_it_is_let_go() -> None:
    controller, asked = ready()
    controller.tick(10.0)
    controller.hold("stale transform: 3.0 s old")
    assert controller.tick(10.05) == Order(0.0, 0.0, "stale transform: 3.0 s old")
    controller.hold("")
    assert reasons(controller, [10.1]) == ["driving"] and len(asked) == 2
    controller.hold("stale transform: 3.0 s old")
    controller.aim((3.0, 0.0))
    assert reasons(controller, [10.15]) == ["driving"]


@pytest.mark.parametrize(("place", "number"), [(1, math.nan), (2, math.inf), (4, math.nan)])
def test_odometry_that_is_not_finite_stops_it(place: int, number: float) -> None:
    controller, _ = ready()
    values = [0.0] * 5
    values[place] = number
    controller.feel((values[0], values[1], values[2]), (values[3], values[4]), 10.0)
    assert controller.tick(10.0) == Order(0.0, 0.0, "odometry is not finite")


@pytest.mark.parametrize(
    ("goal", "message", "corrected"),
    [
        ((math.nan, 0.0), "goal must be a finite number, got nan", False),
        ((1e300, 0.0), "goal must be within 1e+07 m of the origin, got (1e+300, 0.0)", True),
    ],
)
def test_a_goal_that_no_observation_holds_gives_up_the_goal(
    goal: tuple[float, float], message: str, corrected: bool
) -> None:
    controller, asked = ready()
    (controller.correct_goal if corrected else controller.aim)(goal)
    assert reasons(controller, [10.0, 10.1]) == [message, None]
    assert not asked
    controller.aim((1.0, 0.0))
    assert reasons(controller, [10.15]) == ["driving"]


def test_a_goal_can_be_corrected_only_if_there_is_one() -> None:
    controller, asked = ready()
    controller.correct_goal((0.0, 4.0))
    controller.tick(10.0)
    assert asked[0][18:20] == pytest.approx((0.0, 1.0), abs=1e-6)  # To the left.
    controller.aim(None)
    controller.correct_goal((1.0, 1.0))
    assert controller.pilot.goal is None


def names(**values: Any) -> SimpleNamespace:
    return SimpleNamespace(**values)


def test_messages_are_read_and_written_as_ros_means_them() -> None:
    pose = names(position=names(), orientation=names(x=0.0, y=0.0))
    messages.write_pose(pose, (1.0, -2.0, 2.5))
    assert messages.yaw(pose.orientation) == pytest.approx(2.5)
    assert math.isnan(messages.yaw(names(x=0.0, y=0.0, z=0.0, w=0.0)))
    twist = names(linear=names(x=0.3), angular=names(z=-0.4))
    odometry = names(pose=names(pose=pose), twist=names(twist=twist))
    place, speeds = messages.odometry_of(odometry)
    assert place == pytest.approx((1.0, -2.0, 2.5)) and speeds == (0.3, -0.4)
    assert messages.seconds(names(sec=3, nanosec=500_000_000)) == 3.5
    quarter = names(x=0.0, y=0.0, z=math.sin(math.pi / 4), w=math.cos(math.pi / 4))
    transform = names(rotation=quarter, translation=names(x=10.0, y=0.0))
    assert messages.transformed((2.0, 1.0, 0.5), transform)[:2] == pytest.approx((9.0, 2.0))


def wander(controller: Controller, times: range, reach: float) -> list[str | None]:
    """Reasons while the robot swings to and fro over a distance [m], in tenths of a second."""
    found = []
    for time in times:
        passed = time - times.start
        x, turned = 0.5 * reach * math.sin(0.02 * passed), math.sin(0.1 * passed)
        controller.see(scan(free=3.0 + 0.001 * (time % 7)), 0.1 * time)
        controller.feel((x, 0.0, turned), STILL, 0.1 * time)
        order = controller.tick(0.1 * time)
        found.append(order and order.reason)
    return found


def test_a_robot_that_comes_nowhere_new_gives_up_the_goal() -> None:
    controller, _ = ready()
    after, reach = 80, 0.2
    found = wander(controller, range(100, 100 + 15 * after), reach)
    driving = found.index("no progress: time for 40 m, and no new place")
    assert set(found[:driving]) == {"driving"} and found[driving + 1] is None
    assert after <= 0.1 * driving < 1.1 * after + 10.0 * math.pi
    controller.aim((4.0, 0.0))
    assert set(wander(controller, range(3000, 3000 + 9 * after), reach)) == {"driving"}


def test_a_robot_that_stands_before_an_obstacle_gives_up_the_goal_in_the_end() -> None:
    controller, _ = ready()
    found = []
    for time in range(100, 1000):
        controller.see(scan(0.2, free=3.0 + 0.001 * (time % 7)), 0.1 * time)
        controller.feel((0.0, 0.0, 0.0), STILL, 0.1 * time)
        found.append(controller.tick(0.1 * time))
    stopped = Order(0.0, 0.0, "obstacle: 0.02 m from the rim")
    given_up = Order(0.0, 0.0, "stands still: time for 40 m, and no new place")
    assert found[:800] == [stopped] * 800
    assert given_up in found and found[-1] is None and set(found) == {stopped, given_up, None}
