"""A test bench without the package's simulator: a circle on a raster plan that obeys late."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import ROBOTS, export_policy, load_policy
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.robots.drives import Orders
from mpfa_envs.ros.controller import Controller

KOBUKI = ROBOTS["kobuki"]
SIDE, TICK, TURN = 0.25, 0.01, math.tau / 720
SUMS = np.array([[0.5, -0.5], [0.5, 0.5]])
"""From the wheels' speeds to their mean and half of their difference; twice its transpose: back."""
PLAN = """
################################
#..............#...............#
#..............#...............#
#....###.......#......####.....#
#....###.......................#
#..............................#
#..............#...............#
#..............#......##.......#
######..########......##.......#
#..............#...............#
#..............######..#########
#..............#...............#
#...####.......#...............#
#..............#......###......#
#.....................###......#
#..............................#
#..............#...............#
################################
"""
FULL = np.argwhere(np.array([list(row) for row in PLAN.split("\n")[1:-1]])[::-1] == "#")
LOW = SIDE * FULL[:, ::-1]
"""Corners (x, y) of the occupied squares [m]."""
TASKS = [((1.0, 1.0), (7.0, 3.6)), ((7.0, 3.6), (1.0, 3.6)), ((6.7, 0.6), (0.7, 3.8)),
         ((0.7, 0.6), (7.2, 0.7)), ((4.5, 3.9), (4.4, 0.6)), ((2.0, 2.9), (7.0, 1.2))]  # fmt: skip


def rim(x: float, y: float) -> float:
    """Clearance of the rim [m]."""
    away = np.maximum(np.maximum(LOW - (x, y), (x, y) - LOW - SIDE), 0.0)
    return float(np.hypot(*away.T).min()) - KOBUKI.radius


def scan(x: float, y: float, heading: float) -> Scan:
    """Exact ranges every half degree."""
    angles = heading - math.pi + TURN * np.arange(720)
    ways = np.stack((np.cos(angles), np.sin(angles)), axis=1)[:, None] + 1e-12
    near, far = (LOW - (x, y)) / ways, (LOW + SIDE - (x, y)) / ways
    enters, leaves = np.minimum(near, far).max(axis=2), np.maximum(near, far).min(axis=2)
    met = np.where((enters <= leaves) & (leaves > 0.0), enters, 10.0)
    return Scan(-math.pi, TURN, np.maximum(met.min(axis=1), 0.0), 0.0, 10.0)


def drive(
    driver: Pilot | Controller, start: tuple[float, float], goal: tuple[float, float],
    *, late: float, strength: float = 1.0, turning: float = 0.0,
) -> str:  # fmt: skip
    """Drive to a goal with orders that arrive late [s], and say how it ended.

    With ``turning`` [rad/s²] a controller limits forward speed and turn, each by itself.
    """
    pilot = driver if isinstance(driver, Pilot) else driver.pilot
    (x, y), heading, wheels = start, 0.5, np.zeros(2)
    pilot.begin(goal, map_center=(4.0, 2.25))
    orders, wanted, change = [], np.zeros(2), strength * 0.8 * TICK
    for tick in range(9000):
        linear, angular = wheels.mean(), (wheels[1] - wheels[0]) / KOBUKI.wheel_base
        if tick % 5 == 0:
            pose, speeds = (x, y, math.remainder(heading, math.tau)), (linear, angular)
            if math.dist((x, y), goal) <= 0.5:
                return "arrived"
            if tick % 20 == 0 and isinstance(driver, Pilot):
                told = driver.decide(scan(*pose), pose, speeds)[2:]
            elif isinstance(driver, Controller):
                driver.feel(pose, speeds, TICK * tick)
                if tick == 0:
                    driver.aim(goal)
                if tick % 10 == 0:
                    driver.see(scan(*pose), TICK * tick)
                order = driver.tick(TICK * tick)
                if order is None:
                    return "gave up"
                told = order[:2]
            turn = 0.5 * KOBUKI.wheel_base * told[1]
            orders.append((tick + round(late / TICK), np.array((told[0] - turn, told[0] + turn))))
        while orders and orders[0][0] <= tick:
            wanted = orders.pop(0)[1]
        if turning:
            most = np.array((change, 0.5 * KOBUKI.wheel_base * turning * TICK))
            apart = (wheels @ SUMS, wanted @ SUMS)
            wheels = np.clip(apart[1], apart[0] - most, apart[0] + most) @ SUMS.T * 2.0
        else:
            wheels = np.clip(wanted, wheels - change, wheels + change)
        heading += 0.5 * TICK * angular
        x, y = x + TICK * linear * math.cos(heading), y + TICK * linear * math.sin(heading)
        heading += 0.5 * TICK * angular
        if rim(x, y) <= 0.0:
            return "touched"
    return "timeout"


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("policy") / "policy.onnx"
    return export_policy(load_policy("td3-rooms"), file)


def ends(driver: Pilot | Controller, **how: float) -> list[str]:
    return [drive(driver, *task, **how) for task in TASKS]


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.0, 0.1, 0.3])
def test_a_pilot_that_knows_its_latency_arrives(policy: Path, late: float) -> None:
    pilot = Pilot.load(policy, clearance=0.03, latency=late)
    assert ends(pilot, late=late) == ["arrived"] * len(TASKS)
    controller = Controller(pilot, stop_distance=0.05)
    assert ends(controller, late=late) == ["arrived"] * len(TASKS)


@pytest.mark.slow
def test_a_pilot_that_does_not_know_its_latency_touches(policy: Path) -> None:
    assert "touched" in ends(Pilot.load(policy, clearance=0.03, latency=0.0), late=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("told", "strength"), [(0.15, 1.0), (0.25, 1.0), (0.2, 0.8), (0.15, 0.8)])
def test_numbers_that_are_a_little_off_touch_nothing(
    policy: Path, told: float, strength: float
) -> None:
    pilot = Pilot.load(policy, clearance=0.03, latency=told)
    assert "touched" not in ends(pilot, late=0.2, strength=strength)


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.0, 0.2])
@pytest.mark.parametrize("turning", [3.0, 6.0])
@pytest.mark.parametrize("apart", [True, False])
def test_a_robot_whose_file_limits_its_turn_arrives_by_whole_orders(
    policy: Path, late: float, turning: float, apart: bool
) -> None:
    robot = replace(KOBUKI, name="own", turn_acceleration=turning)
    pilot = Pilot.load(policy, robot=robot, clearance=0.03, latency=late)
    reached = ends(pilot, late=late, turning=turning if apart else 0.0)
    assert reached == ["arrived"] * len(TASKS)


DOCS = Path(__file__).parents[2] / "docs"
Sums = dict[tuple[str, ...], dict[str, list[int]]]


def kept(*names: str, exact: bool) -> Sums:
    """Arrived, tasks and touched of the bench's rows by latency, of pilots that know all or not."""
    sums: Sums = {}
    with (DOCS / "results/late.csv").open() as file:
        for drives in csv.DictReader(file):
            known = drives["told"] == drives["latency"] and drives["strength"] == "1.0"
            off = f"{float(drives['told']) - float(drives['latency']):+.2f}"
            drives["off"] = off.replace("+0.00", "0")
            if known == exact:
                row = sums.setdefault(tuple(drives[name] for name in names), {})
                cell = row.setdefault(drives["latency"], [0, 0, 0])
                for place, name in enumerate(("arrived", "tasks", "touched")):
                    cell[place] += int(drives[name])
    return sums


@pytest.mark.parametrize(
    ("before", "names", "latencies", "exact"),
    [
        ("Late orders, measured:", ("driver", "policy"), ("0.0", "0.1", "0.2", "0.3"), True),
        ("less than the file says:", ("off", "strength"), ("0.1", "0.2"), False),
    ],
)
def test_the_page_has_the_sums_of_the_rows(
    before: str, names: tuple[str, ...], latencies: tuple[str, ...], exact: bool
) -> None:
    rows = kept(*names, exact=exact)
    text = (DOCS / "results/late.md").read_text(encoding="utf-8").partition(before)[2]
    table = text.strip().partition("\n\n")[0].splitlines()[2:]
    read = []
    for line in table:
        first, seconds, *cells, touched = (cell.strip() for cell in line.strip("|").split("|"))
        for second in seconds.split(", "):
            name = first.strip("`").lower(), second.strip("`")
            row = rows[name]
            shown = [f"{row[at][0]} of {row[at][1]}" if at in row else "-" for at in latencies]
            assert cells == shown and int(touched) == sum(sums[2] for sums in row.values())
            read.append(name)
    assert sorted(read) == sorted(rows) and len(read) > 2


def test_orders_act_in_their_turn_as_fast_as_the_wheels_change() -> None:
    orders = Orders(KOBUKI)
    orders.give(0.0, 0.4, 0.0)
    orders.give(0.2, 0.0, 1.0)
    orders.give(0.4, 0.7, 0.0)
    rest = np.zeros(5)
    still = orders.ahead(rest, since=0.0, until=0.3, latency=0.3)
    assert still.tolist() == [0.0] * 5
    # From 0.3 to 0.5 s it speeds up by 0.8 m/s2, then it stops and turns.
    first = orders.ahead(rest, since=0.0, until=0.5, latency=0.3)
    assert first[3] == pytest.approx(0.16) and first[0] == pytest.approx(0.016, abs=2e-3)
    limits = KOBUKI.wheel_limits._replace(acceleration=0.5 * 0.8)
    slower = orders.ahead(rest, since=0.0, until=0.5, latency=0.3, limits=limits)
    assert slower[3] == pytest.approx(0.08)
    # The right wheel comes to 0.115 m/s, the left one to a stand on its way to -0.115 m/s.
    after = orders.ahead(first, since=0.5, until=0.7, latency=0.3)
    assert after[3:] == pytest.approx([0.0575, 0.5], abs=1e-9)
    orders.give(0.2, 0.0, 0.0)  # In place of what came later, too.
    assert orders.ahead(first, since=0.5, until=1.0, latency=0.3)[3:].tolist() == [0.0, 0.0]
