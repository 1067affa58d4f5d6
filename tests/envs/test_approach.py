"""A robot stands before it can be touched by what comes no faster than its filter allows for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from benchmarks.people import Discs, cast, drive_among_walkers
from mpfa_envs import ROBOTS, SafetyFilter, TaskConfig
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.deploy.adaptation import nearest_admissible
from mpfa_envs.robots.motion_loops import changed
from mpfa_envs.safety.loops import room_for_points, see
from tests.envs.exported import card
from tests.envs.test_safety import ahead_is, observed, task

CONFIG = TaskConfig(**task(), contact=True)
AHEAD = np.ones(2, np.float32)


@pytest.mark.parametrize("speed", [0.3, 0.5, 1.5])
def test_walkers_that_aim_at_a_robot_touch_it_only_where_it_stands(speed: float) -> None:
    found = drive_among_walkers(6_400, approach=speed, speed=speed, seed=1)
    assert found.driving == 0
    assert found.standing > 50 and found.length > 50.0


@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_walkers_behind_walls_that_a_robot_knows_touch_it_only_where_it_stands(
    speed: float,
) -> None:
    found = drive_among_walkers(6_400, approach=speed, speed=speed, known=True, seed=1)
    assert found.driving == 0
    assert found.standing > 50 and found.length > 50.0


def test_walkers_that_are_faster_than_the_filter_allows_for_touch_a_driving_robot() -> None:
    assert drive_among_walkers(3_200, approach=0.5, speed=0.7, seed=1).driving > 20


def fastest_towards(wall: float, approach: float, *, latency: float = 0.0) -> float:
    """The greatest speed [m/s] at which a robot may drive on to a wall at a distance [m]."""
    keep = TaskConfig(**task(), contact=True, latency=latency).make_filter(approach=approach)
    fast = [
        speed
        for speed in np.linspace(0.0, 0.7, 71)
        if (keep(observed(CONFIG, ahead_is(CONFIG, wall), speed, speed), command(speed)) ==
            command(speed)).all()
    ]  # fmt: skip
    return float(max(fast))


def command(speed: float) -> np.ndarray:
    """The action that keeps a speed [m/s]."""
    return np.full(2, speed / ROBOTS["kobuki"].max_wheel_speed, np.float32)


@pytest.mark.parametrize("latency", [0.0, 0.3])
@pytest.mark.parametrize("approach", [0.0, 0.5, 1.0])
def test_the_speed_towards_a_wall_leaves_time_to_stand_before_it_comes(
    approach: float, latency: float
) -> None:
    wall, robot = 0.9, ROBOTS["kobuki"]
    speed = fastest_towards(wall, approach, latency=latency)
    assert stands_after(speed, latency, approach) <= wall - robot.radius
    assert (
        speed > 0.65 or stands_after(speed + 0.02, latency, approach) > wall - robot.radius - 0.04
    )


def stands_after(speed: float, latency: float, approach: float) -> float:
    """Distance that a robot and what comes have covered together once it stands [m]."""
    # A decision holds for two time steps of 0.1 s, and in each of them wheels lose 0.08 m/s.
    braking = speed - 0.08 * np.arange(1, 12)
    braking = braking[braking > 1e-6]
    return 0.1 * (2.0 * speed + braking.sum()) + approach * (latency + 0.2 + 0.1 * len(braking))


def test_the_latest_order_counts_where_latencies_differ() -> None:
    late = TaskConfig(**task(), contact=True, latency=(0.1, 0.3))
    assert late.make_filter(approach=0.5).body.age == 0.3


def test_turning_on_the_spot_and_standing_are_always_allowed() -> None:
    keep = CONFIG.make_filter(approach=2.0)
    close = observed(CONFIG, 0.2)
    for action in ((0.0, 0.0), (-0.3, 0.3), (0.5, -0.5)):
        wanted = np.array(action, np.float32)
        assert keep(close, wanted).tolist() == wanted.tolist()
    # A command may ask for more than the wheels do until the next decision: they only turn.
    wheels, wanted = (0.0, 0.0), ROBOTS["kobuki"].wheel_speeds(keep(close, AHEAD))
    for _ in range(2):
        wheels = changed(wheels, wanted, keep.body.limits, 1.0, 0.1)
        assert abs(sum(wheels)) < 1e-6


def test_what_a_near_obstacle_hides_may_come_out_on_both_sides_of_it() -> None:
    keep, lidar = CONFIG.make_filter(approach=1.0), CONFIG.make_lidar()
    ranges, post = np.full(lidar.sectors, 10.0), 7
    ranges[post] = 0.5
    seen = keep.seen(observed(CONFIG, ranges)[None])
    points = np.empty((1, room_for_points(lidar.angles.size, 1.0), 4))
    counts = np.empty(1, np.int64)
    see(seen, keep.body, 0.0, points, counts)
    found = points[0, : counts[0]]
    hits, hidden = found[found[:, 2] > 0.0], found[found[:, 2] == 0.0]
    rays = lidar.angles.reshape(lidar.sectors, -1)
    assert len(hits) == rays.shape[1] and (found[:, 3] == 1.0).all()
    sides = sorted((rays[post - 1, -1], rays[post + 1, 0]))
    angles = np.arctan2(hidden[:, 1], hidden[:, 0])
    for side in sides:
        away = np.sort(np.hypot(*hidden[np.abs(angles - side) < 1e-6, :2].T))
        assert len(away) >= 3 and away[0] < 0.6 and np.diff(away).max() < 0.1
    assert all(min(abs(angle - side) for side in sides) < 1e-6 for angle in angles)
    # Nothing may come out of a wall that is seen as a whole, and nothing where all stands still.
    see(keep.seen(observed(CONFIG, 0.5)[None]), keep.body, 0.0, points, counts)
    assert (points[0, : counts[0], 2] > 0.0).all()
    still = CONFIG.make_filter()
    see(still.seen(observed(CONFIG, ranges)[None]), still.body, 0.0, points, counts)
    assert counts[0] == rays.shape[1] and (points[0, : counts[0], 3] == 0.0).all()


def test_a_wall_that_stays_hides_what_may_come_out_beside_it_from_its_edge_on() -> None:
    keep, lidar = CONFIG.make_filter(approach=1.0), CONFIG.make_lidar()
    ranges, post = np.full(lidar.sectors, 10.0), 7
    ranges[post] = 0.5
    known = np.zeros((1, lidar.angles.size), np.bool_)
    known[0, post * 3 : post * 3 + 3] = True
    seen = (*keep.seen(observed(CONFIG, ranges)[None])[:4], known)
    points = np.empty((1, room_for_points(lidar.angles.size, 1.0), 4))
    counts = np.empty(1, np.int64)
    see(seen, keep.body, 0.0, points, counts)
    found = points[0, : counts[0]]
    hits, hidden = found[found[:, 2] > 0.0], found[found[:, 2] == 0.0]
    assert len(hits) == 3 and (hits[:, 3] == 0.0).all() and (hidden[:, 3] == 1.0).all()
    away = np.sort(np.hypot(*hidden[:, :2].T))
    assert away[:2] == pytest.approx(0.5) and away[2] > 0.54


def test_a_known_wall_in_full_view_slows_a_robot_no_more_than_one_where_nothing_moves() -> None:
    keep, still = CONFIG.make_filter(approach=1.0), CONFIG.make_filter()
    wall, fast = observed(CONFIG, ahead_is(CONFIG, 0.5), 0.3, 0.3), command(0.3)
    known = np.ones(CONFIG.make_lidar().sectors, np.bool_)
    assert (still(wall, fast) == fast).all() and (keep(wall, fast) != fast).any()
    everywhere = observed(CONFIG, 0.5, 0.3, 0.3)
    assert (keep(everywhere, fast, still=known) == fast).all()
    with pytest.raises(ValueError, match="still must have shape"):
        keep(wall, fast, still=known[1:])


def test_a_known_wall_that_is_hidden_counts_as_what_comes() -> None:
    keep = CONFIG.make_filter(approach=1.0)
    sectors = CONFIG.make_lidar().sectors
    states, known = observed(CONFIG, 0.5, 0.3, 0.3)[None], np.ones((1, sectors), np.bool_)
    seen, hidden = np.zeros(sectors, np.bool_), np.ones(sectors, np.bool_)
    robot = CONFIG.robot

    def ordered(still: Any, out_of_view: Any) -> tuple[float, float]:
        return nearest_admissible(keep, robot, (states, still, out_of_view), (0.3, 0.3), 0.0)

    assert ordered(known, seen) == pytest.approx((0.3, 0.3))
    assert ordered(known, hidden) == ordered(None, seen) != pytest.approx((0.3, 0.3))


def test_directions_out_of_view_hold_nothing_that_comes() -> None:
    half = TaskConfig(**task(), contact=True, lidar={"field_of_view": 180.0})
    keep = half.make_filter(approach=1.0)
    assert keep(observed(half, 10.0, 0.3, 0.3), AHEAD).tolist() == [1.0, 1.0]


def test_a_touch_of_the_bench_is_that_of_circles_and_its_rays_are_exact() -> None:
    discs = Discs(np.array([[[2.0, 0.0], [0.0, -3.0]]]), np.array([0.5, 1.0]))
    angles = np.array([0.0, -math.pi / 2, math.pi, math.asin(0.25) - 1e-9, math.asin(0.25) + 1e-6])
    found = cast(np.zeros((1, 3)), angles, discs, 10.0)[0]
    assert found[:3].tolist() == [1.5, 2.0, 10.0]
    assert found[3] == pytest.approx(math.sqrt(4.0 - 0.25), abs=1e-3) and found[4] == 10.0


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (CONFIG.make_filter, {"approach": -0.5}, "approach must not be negative, got -0.5"),
        (
            TaskConfig(physics="kinematic").make_filter,
            {"approach": 0.5},
            "approach must be 0 for turtlebot2, which cannot stop before what comes, got 0.5",
        ),
        (CONFIG.make_filter, {"approach": 9.0}, "max_range must be at least"),
        (Pilot, {"approach": 0.5}, r"approach must be 0 without a filter \(clearance=None\)"),
    ],
)
def test_what_cannot_be_kept_off_is_rejected(
    make: Any, arguments: dict[str, Any], message: str
) -> None:
    words = (card(robot=ROBOTS["kobuki"]), lambda seen: seen) if make is Pilot else ()
    with pytest.raises(ValueError, match=message):
        make(*words, **arguments)


def test_a_pilot_allows_for_its_latency_the_age_of_the_scan_and_its_pace(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[float | None] = []
    among = SafetyFilter.among

    def note(keep: SafetyFilter, *words: Any, age: float | None = None, **others: Any) -> Any:
        asked.append(age)
        return among(keep, *words, age=age, **others)

    monkeypatch.setattr(SafetyFilter, "among", note)
    facts = card(robot=ROBOTS["kobuki"], field_of_view=360.0, sectors=36)
    ahead = lambda seen: np.ones((1, 2), np.float32)  # noqa: E731
    pilot = Pilot(facts, ahead, clearance=0.03, approach=0.5, latency=0.2, pace=0.5)
    assert pilot._keep is not None and pilot._keep.body.approach == pytest.approx(1.0)
    pilot.begin((3.0, 0.0))
    hall = Scan(-math.pi, math.pi / 180, np.full(360, 6.0))
    pilot.decide(hall, (0.0, 0.0, 0.0), (0.0, 0.0), scan_age=0.1)
    assert asked == [pytest.approx(0.5 * (0.1 + 0.2 + 0.05) + pilot._keep.body.time_step)]
