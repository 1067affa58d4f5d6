"""Scans of any kind as sectors: as a plain loop reads them, or rejected."""

from __future__ import annotations

import math
from array import array
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="exported policies are of the extra onnx")

from mpfa_envs import ROBOTS, Box, Lidar, RobotModel, World
from mpfa_envs.deploy import Scan, ScanError, Sectors
from mpfa_envs.env.config import lidar_arguments
from mpfa_envs.ros.simulated_robot import SimulatedRobot
from tests.envs.exported import card


def plain(scan: Scan, reduction: str, mount: tuple[float, float, float]) -> list[float]:
    """The sectors by a loop over rays, each of which has some."""
    rays: list[list[tuple[float, float]]] = [[] for _ in range(18)]
    for number, measured in enumerate(np.asarray(scan.ranges).tolist()):
        angle = scan.angle_min + number * scan.angle_increment + mount[2]
        far = measured >= scan.range_max
        if measured == -math.inf or 0.0 < measured < scan.range_min:
            measured = scan.range_min  # Something, nearer than the lidar can measure.
        if not far and not measured >= max(scan.range_min, 0.0):
            continue
        distance = 10.0
        if not far:
            x, y = mount[0] + measured * math.cos(angle), mount[1] + measured * math.sin(angle)
            angle, distance = math.atan2(y, x), min(math.hypot(x, y), 10.0)
        degrees = math.degrees(math.remainder(angle, math.tau))
        if abs(degrees) < 90.0:
            sector = int((90.0 - degrees) // 10.0)
            off = abs(degrees - (85.0 - 10.0 * sector))
            rays[sector].append((distance, off))
    if reduction == "single":
        return [min(each, key=lambda ray: ray[1])[0] for each in rays]
    reduce = {"min": min, "median": np.median}[reduction]
    return [float(reduce([ray[0] for ray in each])) for each in rays]


@pytest.mark.parametrize("reduction", ["min", "median", "single"])
@pytest.mark.parametrize("mount", [(-0.04, 0.02, -1.0)])
@pytest.mark.parametrize(
    ("start", "step", "count"),
    [(-math.pi, math.tau / 360, 360), (0.001, math.tau / 719, 719), (3.1, -math.tau / 640, 640)],
)
def test_sectors_are_those_of_a_plain_loop(
    reduction: str, mount: tuple[float, float, float], start: float, step: float, count: int
) -> None:
    rng = np.random.default_rng(count)
    ranges = rng.uniform(0.1, 6.0, count)
    odd = rng.choice([math.inf, math.nan, 0.0, -math.inf, 0.05], count)
    ranges = np.where(rng.random(count) < 0.2, odd, ranges)
    scan = Scan(start + 3e-3, step, ranges, range_min=0.12, range_max=5.5)
    found, points = Sectors(card(reduction=reduction), mount=mount).read(scan)
    np.testing.assert_allclose(found, plain(scan, reduction, mount), atol=1e-12)
    assert len(points.angles) == len(points.ranges) and points.ranges.max() <= 10.0


def test_a_sector_between_two_rays_has_the_nearer_one() -> None:
    # A ray every 15 degrees, from -90 to 90: 1 m, 2 m and so on from the right.
    scan = Scan(-math.pi / 2, math.pi / 12, np.arange(1.0, 14.0), 0.0, 100.0)
    found, _ = Sectors(card(max_range=100.0)).read(scan)
    # From the left: the rays at 90 and 75 degrees, then twice that at 60, between two sectors.
    assert found[:4].tolist() == [13.0, 12.0, 11.0, 11.0]
    assert set(found.tolist()) == set(np.arange(1.0, 14.0).tolist())


def test_sectors_out_of_view_need_a_given_range() -> None:
    scan = Scan(-math.pi / 3, math.pi / 180, np.full(121, 1.0))
    with pytest.raises(ScanError, match="sector at 85 degrees, its rays are from -60 to 60"):
        Sectors(card()).read(scan)
    found, _ = Sectors(card(), unseen=4.0).read(scan)
    assert found[[0, 1, 16, 17]].tolist() == [4.0] * 4 and found[3:15].tolist() == [1.0] * 12


def test_sectors_without_a_valid_ray_are_rejected_or_free() -> None:
    ranges = np.full(360, 2.0)
    ranges[180:190] = 0.0  # From 0 to 9 degrees, to the left.
    scan = Scan(-math.pi, math.pi / 180, ranges, range_min=0.1)
    with pytest.raises(ScanError, match="no ray of the sector at 5 degrees is valid"):
        Sectors(card()).read(scan)
    found, _ = Sectors(card(), silent="far").read(scan)
    assert found[8] == 10.0 and np.delete(found, 8).tolist() == [2.0] * 17


@pytest.mark.parametrize("silent", ["reject", "far"])
@pytest.mark.parametrize("near", [0.05, 0.119, -math.inf])
def test_returns_too_near_to_measure_have_the_least_range(near: float, silent: str) -> None:
    ranges = np.full(360, 2.0)
    ranges[181:188] = near  # From 1 to 7 degrees, to the left; at 8 and 9 there is a wall.
    scan = Scan(-math.pi, math.pi / 180, ranges, range_min=0.12, range_max=3.5)
    found, points = Sectors(card(), silent=silent).read(scan)
    assert found[8] == 0.12 and np.delete(found, 8).tolist() == [2.0] * 17
    assert (points.ranges == 0.12).sum() == 7


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (-0.1, 0.05, math.pi / 2)])
def test_around_the_robot_too_near_is_zero_and_silence_nan(
    mount: tuple[float, float, float],
) -> None:
    ranges = np.array([1.0, 0.45, 0.3, -math.inf, 0.0, math.nan, -1.0, math.inf, 20.0])
    scan = Scan(0.0, 0.5, ranges, range_min=0.45, range_max=8.0)
    found = Sectors(card(), mount=mount).around(scan)
    near, silent = found.ranges == 0.0, np.isnan(found.ranges)
    assert (near.sum(), silent.sum(), (found.ranges == 10.0).sum()) == (3, 3, 2)
    # At 0.5, 1 and 1.5 rad is what is too near, seen from the center of the robot.
    angles = mount[2] + np.array([0.5, 1.0, 1.5])
    x, y = mount[0] + 0.45 * np.cos(angles), mount[1] + 0.45 * np.sin(angles)
    assert found.angles[near] == pytest.approx(np.arctan2(y, x))
    (met,) = found.ranges[(found.ranges > 0.0) & (found.ranges < 10.0)]
    assert met == pytest.approx(
        math.hypot(mount[0] + math.cos(mount[2]), mount[1] + math.sin(mount[2]))
    )


@pytest.mark.parametrize("gone", [0.0, math.nan])
def test_a_near_return_stays_while_the_lidar_is_silent_there(gone: float) -> None:
    sectors = Sectors(card(), silent="far")

    def read(measured: float) -> float:
        ranges = np.full(360, 2.0)
        ranges[180:190] = measured
        return float(sectors.read(Scan(-math.pi, math.pi / 180, ranges, 0.12, 3.5))[0][8])

    assert [read(each) for each in (0.21, gone)] == [0.21, 10.0]  # Not as near as that.
    assert [read(each) for each in (0.15, gone, gone, gone)] == [0.15] * 4
    assert [read(each) for each in (1.0, gone)] == [1.0, 10.0]
    assert [read(each) for each in (0.15, gone, math.inf, gone)] == [0.15, 0.15, 10.0, 10.0]


LIMITS = [(0.1, 0.0), (0.1, -1.0), (5.0, 1.0), (-0.1, 8.0), (math.nan, 8.0), (0.1, math.nan)]


def hall(*ranges: float) -> Scan:
    """A scan all around by a lidar that sees 3.5 m and reports 0 where it meets nothing."""
    values = np.zeros(360)
    values[: len(ranges)] = ranges
    return Scan(-math.pi, math.pi / 180, values, 0.12, 3.5)


@pytest.mark.parametrize("dead", [0.0, math.nan, -math.inf, 0.05])
def test_a_lidar_that_falls_silent_at_once_is_dead(dead: float) -> None:
    sectors = Sectors(card(), silent="far")
    sectors.read(hall(1.0))
    for _ in range(2):
        with pytest.raises(ScanError, match="rays is valid, and the one before met something near"):
            sectors.read(hall(*[dead] * 360))
    assert (sectors.read(hall(3.4))[0] == 10.0).all()
    if dead == 0.0:
        assert (sectors.read(hall())[0] == 10.0).all()


@pytest.mark.parametrize(("yaw", "roll"), [(0.0, 3.1), (-1.0, -math.pi)])
def test_a_lidar_upside_down_is_read_from_right_to_left(yaw: float, roll: float) -> None:
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0.5, 6.0, 360)
    upright = Scan(-math.pi + 0.01, math.tau / 360, ranges)
    hanging = Scan(math.pi - 0.01, -math.tau / 360, ranges)
    found = Sectors(card(), mount=(-0.04, 0.02, yaw, roll)).read(hanging)[0]
    np.testing.assert_allclose(found, Sectors(card(), mount=(-0.04, 0.02, yaw)).read(upright)[0])
    flat = Sectors(card(), mount=(-0.04, 0.02, yaw, 0.0)).read(upright)[0]
    assert flat.tolist() == found.tolist()


@pytest.mark.parametrize(("count", "off"), [(360, 0), (359, 0), (361, 0), (330, 29), (375, -16)])
def test_a_scan_has_as_many_ranges_as_its_angles_say(count: int, off: int) -> None:
    step = math.pi / 180
    scan = Scan(-math.pi, step, np.ones(count), angle_max=-math.pi + 359 * step)
    if not off:
        Sectors(card()).read(scan)
        return
    with pytest.raises(ScanError, match=f"the {count} ranges of a scan must reach from"):
        Sectors(card()).read(scan)


@pytest.mark.parametrize("silent", ["reject", "far"])
@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (Scan(0.0, 0.1, []), r"ranges must have shape \[R\], got \(0,\)"),
        (Scan(0.0, 0.1, [[1.0]]), r"ranges must have shape \[R\], got \(1, 1\)"),
        (Scan(math.nan, 0.1, [1.0]), "a scan needs a first angle and a step, got nan and 0.1"),
        (Scan(0.0, 0.0, [1.0]), "a scan needs a first angle and a step, got 0.0 and 0.0"),
        (Scan(0.0, -1.0, [1.0] * 9), "must go round once at most, got 9 in steps of -1.0 rad"),
        *(
            (
                Scan(-math.pi, math.pi / 180, np.full(360, broken), range_min=0.1),
                "none of the scan's 360 rays is valid",
            )
            for broken in (-math.inf, 0.05)
        ),
        *(
            (
                Scan(-math.pi, math.pi / 180, np.full(360, 0.2), *limits),
                "range_min must be .* range_max, got {} and {}".format(*limits),
            )
            for limits in LIMITS
        ),
    ],
)
def test_a_scan_that_says_nothing_is_rejected(scan: Scan, message: str, silent: str) -> None:
    with pytest.raises(ScanError, match=message):
        Sectors(card(), silent=silent).read(scan)


ALL_AROUND = Scan(-math.pi, math.pi / 180, [1.0] * 360, 0.1, 8.0)
NO_NUMBERS: list[Any] = [
    None,
    "1.0",
    b"11",
    {1.0: 2.0},
    object(),
    *([1.0] * 359 + [bad] for bad in ("1.0", None, True, 1j, [1.0], [], np.datetime64("2026"))),
    [1.0] * 359 + [np.ma.masked],
    [10**400] * 360,
    ["far"] * 360,
    np.array(["1.0"] * 360),
    np.ones(360, dtype=np.bool_),
    np.array([1.0] * 359 + [True], dtype=object),
    np.ones(360, dtype=np.complex128),
    np.ma.array(np.ones(360), mask=[False] * 359 + [True]),
    np.zeros(360, dtype=[("range", float)]),
    iter([1.0] * 360),
]


@pytest.mark.parametrize("ranges", NO_NUMBERS, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("method", ["read", "around", "blind"])
def test_ranges_that_are_no_numbers_are_rejected_by_name(ranges: Any, method: str) -> None:
    with pytest.raises(ScanError, match=r"^ranges must be real numbers, got "):
        getattr(Sectors(card()), method)(ALL_AROUND._replace(ranges=ranges))


@pytest.mark.parametrize("name", [name for name in Scan._fields if name != "ranges"])
@pytest.mark.parametrize(
    "value", ["0.1", None, True, 1j, np.complex64(0), [0.1], np.ma.masked, 10**400, object()]
)
def test_a_fact_of_a_scan_that_is_no_number_is_rejected_by_name(name: str, value: Any) -> None:
    if (name, value) == ("angle_max", None):
        return
    with pytest.raises(ScanError, match=f"^{name} must be a real number, got "):
        Sectors(card()).read(ALL_AROUND._replace(**{name: value}))


@pytest.mark.parametrize("scan", [None, (0.0, 0.1, [1.0]), {"ranges": [1.0]}, 3])
def test_what_is_no_scan_is_rejected(scan: Any) -> None:
    with pytest.raises(ScanError, match=r"^scan must have angle_min, .*got "):
        Sectors(card()).read(scan)


@pytest.mark.parametrize(
    "ranges",
    [
        array("f", [1.0] * 360),
        tuple([1] * 360),
        np.ones(360, dtype=np.float16),
        np.ma.array(np.ones(360)),
        [np.float32(1.0)] * 360,
        np.array([1] * 360, dtype=object),
        [10**30, *[1.0] * 359],
    ],
    ids=lambda value: type(value).__name__,
)
def test_ranges_may_be_numbers_of_any_type(ranges: Any) -> None:
    start, step = np.float32(-math.pi), np.array(math.pi / 180)
    scan = ALL_AROUND._replace(angle_min=start, angle_increment=step, ranges=ranges)
    assert Sectors(card()).read(scan)[0].tolist() == [1.0] * 18


RANGES = np.linspace(0.3, 7.9, 360)
"""Ranges of a room [m]."""


@pytest.mark.parametrize("scale", [1000.0, 100.0])
@pytest.mark.parametrize("limits", [(0.1, 8.0), (0.1, math.inf)])
@pytest.mark.parametrize("scales", [(1.0, 0.0), (0.0, 1.0)])
def test_a_scan_in_another_unit_is_rejected(
    scale: float, limits: tuple[float, float], scales: tuple[float, float]
) -> None:
    ranges, end = scale ** scales[0] * RANGES, scale ** scales[1] * limits[1]
    scan = Scan(-math.pi, math.pi / 180, ranges, limits[0], end)
    if scales[0] == 0.0 and math.isinf(end):
        Sectors(card()).read(scan)  # Nothing of it is in another unit.
        return
    with pytest.raises(ScanError, match="ranges and range_max must be in meters"):
        Sectors(card()).read(scan)


ROOM = World(name="room", size=(5.0, 3.5), boxes=(Box(0.6, -0.5, 0.9, 0.3),))


def seen_by(robot: RobotModel, pose: tuple[float, float, float]) -> Scan:
    """An exact scan of a robot's lidar in the room, four rays a degree."""
    half = math.radians(robot.field_of_view / 2)
    count = round(4 * robot.field_of_view)
    step = 2 * half / count
    simulated = SimulatedRobot(
        ROOM, robot=robot, physics="kinematic", rays=count, field=(step / 2 - half, half - step / 2)
    )
    simulated.place(pose)
    return simulated.scan()


@pytest.mark.parametrize("view", [180.0, 360.0])
@pytest.mark.parametrize("mount", [(-0.1, 0.04, 0.0), (0.12, 0.0, 0.0, math.pi)])
@pytest.mark.parametrize("pose", [(-2.2, 0.3, 2.0), (0.1, 0.0, 1.2)])
def test_a_pilot_reads_what_the_training_senses_wherever_the_lidar_is(
    pose: tuple[float, float, float], mount: tuple[float, ...], view: float
) -> None:
    robot = replace(ROBOTS["kobuki"], field_of_view=view, lidar_mount=mount)
    lidar = Lidar(ROOM, **lidar_arguments(view), rays_per_sector=40, mount=mount[:2])
    facts = card(robot=robot, sectors=lidar.sectors, field_of_view=view)
    sectors = Sectors(facts, mount=mount)
    ranges, points = sectors.read(seen_by(robot, pose))
    np.testing.assert_allclose(ranges, lidar.scan(*pose), atol=0.02)
    # Points are around the center, on a wall or the box.
    x = pose[0] + points.ranges * np.cos(points.angles + pose[2])
    y = pose[1] + points.ranges * np.sin(points.angles + pose[2])
    assert np.abs(ROOM.clearances(np.stack((x, y), axis=1))).max() < 1e-6


@pytest.mark.parametrize(
    ("view", "x", "silent"), [(180, 0.1, "reject"), (240, -0.1, "far"), (270, 0.0, "reject")]
)
def test_what_lies_beyond_the_last_ray_is_not_seen(x: float, view: int, silent: str) -> None:
    robot = replace(ROBOTS["kobuki"], field_of_view=float(view), lidar_mount=(x, 0.0, 0.0))
    facts = card(robot=ROBOTS["kobuki"], sectors=36, field_of_view=360.0)
    scan = seen_by(robot, (0.0, -1.3, 0.4))
    sectors = Sectors(facts, mount=robot.lidar_mount, unseen=0.3, silent=silent)
    ranges, _ = sectors.read(scan)
    _, hidden = sectors.blind(scan)
    rear = ranges[[0, 1, 2, -3, -2, -1]]
    assert rear.tolist() == [0.3] * 6
    assert hidden[[0, 1, 2, -3, -2, -1]].all()
    assert ranges.max() < 6.0
    with pytest.raises(ScanError, match="does not reach the sector at 175 degrees"):
        Sectors(facts, mount=robot.lidar_mount, silent=silent).read(scan)


@pytest.mark.parametrize("x", [0.1, -0.1])
def test_what_a_lidar_that_turns_right_does_not_see_is_what_one_that_turns_left_does_not(
    x: float,
) -> None:
    robot = replace(ROBOTS["kobuki"], field_of_view=230.0, lidar_mount=(x, 0.0, 0.0))
    facts = card(robot=ROBOTS["kobuki"], sectors=36, field_of_view=360.0)
    leftward = seen_by(robot, (0.6, -1.4, 0.4))
    last = leftward.angle_min + leftward.angle_increment * (len(leftward.ranges) - 1)
    rightward = leftward._replace(
        angle_min=last, angle_increment=-leftward.angle_increment, ranges=leftward.ranges[::-1]
    )
    found = []
    for scan in (leftward, rightward):
        sectors = Sectors(facts, mount=robot.lidar_mount, unseen=0.3)
        ranges, _ = sectors.read(scan)
        blind, hidden = sectors.blind(scan)
        found.append((ranges, np.sort(blind), hidden))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    ends = [sectors._measured(scan)[0].ends for scan in (leftward, rightward)]
    # The walls beside it are at different distances, and so the two ends move by different angles.
    assert ends[0] == pytest.approx(ends[1]) and abs(sum(ends[0])) > 0.05
