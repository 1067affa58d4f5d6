"""People who walk at a robot: is it touched while it drives, and what does that cost?

    python -m benchmarks.people                       a random policy, among walkers that aim at it
    python -m benchmarks.people --decisions 1000000   the rows of the page
    python -m benchmarks.people --places rooms hall   tasks there, by --approach 0.0 0.5 1.0
    python -m benchmarks.people --keep FILE           adds the rows to a table

The hall has pillars, and walkers that go straight at the robot wherever it is, each at the speed
that the filter allows for. The simulation is none of the package: circles, exact rays, and the
touches of ten moments of each time step.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import trange

from mpfa_envs import (
    Box,
    Cylinder,
    TaskConfig,
    Walker,
    World,
    load_policy,
    make_planner,
    run_tasks,
    world_tasks,
)
from mpfa_envs.driver import Filtered
from mpfa_envs.robots.drives import make_drives
from mpfa_envs.robots.motion_loops import scale_actions
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.sensing.standing import standing_hits, standing_sectors

Array = NDArray[np.float64]
COLUMNS = ("place", "driver", "approach", "latency", "plan", "count", "number", "value")
SPEEDS = (0.3, 0.5, 1.0, 1.5)
"""Speeds of walkers [m/s]."""
_ROBOTS = 64
_WALKERS, _PILLARS = 3, 4
_HALL = 4.0
"""Half of the side of the square in which pillars stand and walkers begin [m]."""
_FINE = 10
"""Moments of a time step at which touches are looked for."""


class Discs(NamedTuple):
    """Circles around many robots."""

    places: Array
    """Middles (x, y) [m], ``[N, K, 2]``."""
    radii: Array
    """[m], ``[K]``."""


def cast(poses: Array, angles: Array, discs: Discs, most: float) -> Array:
    """Ranges of rays from poses ``[N, 3]`` in directions ``[R]`` to circles [m], ``[N, R]``."""
    across = np.cos(angles + poses[:, 2:]), np.sin(angles + poses[:, 2:])
    off = discs.places - poses[:, None, :2]
    along = across[0][:, :, None] * off[:, None, :, 0] + across[1][:, :, None] * off[:, None, :, 1]
    beside = np.square(off).sum(axis=-1)[:, None] - np.square(along)
    inside = np.square(discs.radii) - beside
    reach = along - np.sqrt(np.maximum(inside, 0.0))
    hits = np.where((inside >= 0.0) & (along > 0.0), np.maximum(reach, 0.0), most)
    return np.minimum(hits.min(axis=-1), most)


class Touches(NamedTuple):
    """How often robots were touched."""

    driving: int
    """While they drove forward or back,"""
    standing: int
    """and while they stood or turned on the spot."""
    length: float
    """What they drove on the whole [m]."""


def drive_among_walkers(
    decisions: int,
    *,
    approach: float,
    speed: float,
    robot: str = "kobuki",
    known: bool = False,
    seed: int = 0,
) -> Touches:
    """Drive robots by a random policy behind the filter, and count what touched them.

    Args:
        decisions: Of all robots together.
        approach: What the filter allows for [m/s].
        speed: Of the walkers, which aim at the robot [m/s].
        robot: What drives.
        known: Whether it knows two thick pillars, around which the walkers go.
        seed: Of policy, pillars and walkers.
    """
    rng = np.random.default_rng(seed)
    near = resolve_robot(robot).radius
    arguments: dict[str, Any] = {"robot": robot, "physics": "kinematic", "contact": True}
    config = TaskConfig(**arguments, closeness_distance=near)
    keep, parts = config.make_filter(approach=approach), config.observation_slices
    lidar, body, step = config.make_lidar(), config.robot, config.time_step
    drives = make_drives("kinematic", body, _ROBOTS, time_step=step)
    motions, all_run = np.zeros((_ROBOTS, 5)), np.ones(_ROBOTS, dtype=np.bool_)
    pillars = np.full(2, 0.6) if known else np.full(_PILLARS, 0.15)
    radii = np.concatenate((np.full(_WALKERS, 0.25), pillars))
    # Around a pillar they take a path that is longer by less than the rest.
    speed *= 0.98 if known else 1.0
    places = np.stack([_begin(rng, known) for _ in range(_ROBOTS)])
    plans = [_plan(each) for each in places]
    view = math.radians(lidar.field_of_view)
    size = max(part.stop for part in parts.values())
    wanted = np.zeros((_ROBOTS, 2), np.float32)
    driving = standing = 0
    length = 0.0
    touched = np.zeros(_ROBOTS, dtype=np.bool_)
    for _ in trange(decisions // _ROBOTS, unit="round", disable=None):
        discs = Discs(places, radii)
        ranges = cast(motions[:, :3], lidar.angles, discs, lidar.max_range)
        still = None
        if known:
            still = np.zeros((_ROBOTS, lidar.sectors), dtype=np.bool_)
            for k, (pose, row) in enumerate(zip(motions[:, :3], ranges, strict=True)):
                scan, far = (pose, lidar.angles, row), lidar.max_range
                hits = standing_hits(plans[k], (0.0, 0.0, 0.0), *scan, far)
                still[k] = standing_sectors(hits, *scan, far, pose, view, lidar.sectors)
        ranges = ranges.reshape(_ROBOTS, lidar.sectors, -1).min(axis=2)
        seen = np.zeros((_ROBOTS, size), np.float32)
        seen[:, parts["lidar"]] = near / np.maximum(ranges, near)
        seen[:, parts["linear_speed"]] = motions[:, 3:4] / body.max_wheel_speed
        seen[:, parts["angular_speed"]] = motions[:, 4:5] / body.max_angular_speed
        again = rng.random(_ROBOTS) < 0.2
        wanted[again] = rng.uniform(-1.0, 1.0, (int(again.sum()), 2))
        fast = again & (rng.random(_ROBOTS) < 0.5)
        wanted[fast] = np.sign(wanted[fast])
        wheels = np.empty((_ROBOTS, 2))
        scale_actions(keep(seen, wanted, still=still).astype(float), body.wheel_limits, wheels)
        for _ in range(config.action_repeat):
            before, people = motions.copy(), places[:, :_WALKERS].copy()
            drives.move(motions, all_run, wheels)
            to_robot = before[:, None, :2] - people
            away = np.maximum(np.linalg.norm(to_robot, axis=-1, keepdims=True), 1e-9)
            walked = np.minimum(speed * step, away)
            places[:, :_WALKERS] += to_robot / away * walked
            if known:
                _go_around(places)
            length += float(np.abs(motions[:, 3]).sum()) * step
            moves = np.abs(motions[:, 3]) > 1e-6
            for part in np.linspace(0.0, 1.0, _FINE + 1)[1:]:
                at = _on_arc(before, motions, part, step)
                there = people + part * (places[:, :_WALKERS] - people)
                gaps = np.linalg.norm(there - at[:, None], axis=-1) - 0.25 - body.radius
                hit = (gaps < -1e-9).any(axis=1) & ~touched
                driving += int((hit & moves).sum())
                standing += int((hit & ~moves).sum())
                touched |= hit
        # Who has touched a robot begins again somewhere else, as does the robot.
        for index in np.flatnonzero(touched | (np.abs(motions[:, :2]) > 2 * _HALL).any(axis=1)):
            motions[index] = 0.0
            drives.place(int(index), 0.0, 0.0, 0.0)
            places[index] = _begin(rng, known)
            plans[index] = _plan(places[index])
            touched[index] = False
    return Touches(driving, standing, length)


def _begin(rng: np.random.Generator, known: bool) -> Array:
    """Places of walkers, then of pillars [m], ``[K, 2]``."""
    if not known:
        return _around(rng, _WALKERS + _PILLARS)
    # Thick pillars at both sides of the robot leave room for a walker between them.
    pillar, other = _around(rng, 1)[0], rng.uniform(1.2, _HALL)
    places = np.stack((*_around(rng, _WALKERS), pillar, -pillar / np.linalg.norm(pillar) * other))
    _go_around(places[None])
    return places


def _go_around(places: Array) -> None:
    """Move walkers out of thick pillars, ``[N, K, 2]``."""
    for pillar in range(_WALKERS, places.shape[1]):
        off = places[:, :_WALKERS] - places[:, None, pillar]
        away = np.linalg.norm(off, axis=-1, keepdims=True)
        places[:, :_WALKERS] += off * (np.maximum(away, 0.85) / np.maximum(away, 1e-9) - 1.0)


def _plan(places: Array) -> World:
    """A plan of thick pillars."""
    pillars = tuple(Cylinder(float(x), float(y), 0.6) for x, y in places[_WALKERS:])
    return World(name="pillars", size=(60.0, 60.0), cylinders=pillars)


def _around(rng: np.random.Generator, count: int) -> Array:
    """Places in the hall, off its middle [m], ``[count, 2]``."""
    turn, away = rng.uniform(0.0, math.tau, count), rng.uniform(1.2, _HALL, count)
    return np.stack((away * np.cos(turn), away * np.sin(turn)), axis=1)


def _on_arc(before: Array, after: Array, part: float, step: float) -> Array:
    """Where robots are at a part of a time step of constant speeds (x, y) [m], ``[N, 2]``."""
    speed, turn = after[:, 3], after[:, 4] * part * step
    along = speed * part * step * np.sinc(turn / math.tau)
    heading = before[:, 2] + 0.5 * turn
    return before[:, :2] + np.stack((along * np.cos(heading), along * np.sin(heading)), axis=1)


HALL = World(
    name="hall",
    size=(12.0, 8.0),
    boxes=(Box(-2.0, -1.0, -1.4, -0.4), Box(1.5, 0.8, 2.1, 1.4)),
    walkers=(Walker(radius=0.25, speed=0.45),) * 6,
)
"""Six people who walk straight on."""
CORRIDOR = World(
    name="corridor",
    size=(12.0, 6.0),
    boxes=(Box(-4.0, 0.55, 4.0, 3.0), Box(-4.0, -3.0, 4.0, -0.55)),
)
"""A corridor of 1.1 m between two halls."""
CROSSINGS = {
    f"crossing {speed:g}": World(
        name=f"crossing-{speed:g}",
        size=(10.0, 4.0),
        walkers=tuple(
            Walker(behavior="waypoints", waypoints=((x, -1.6), (x, 1.6)), speed=speed, radius=0.25)
            for x in (-1.5, 1.5)
        ),
    )
    for speed in (0.5, 1.0, 1.5)
}
"""Two people who cross a corridor, to and fro."""
PLACES: dict[str, str | World] = {"rooms": "rooms:validation", "hall": HALL, "corridor": CORRIDOR}
PLACES |= CROSSINGS
DRIVERS = ("td3-rooms", "mpc")
_TASKS = 20


def drive_tasks(
    driver: str,
    place: str,
    *,
    approach: float,
    latency: float = 0.0,
    plan: str = "unknown",
    tasks: int = _TASKS,
) -> dict[str, Any]:
    """Drive tasks of a place behind the filter; what became of them.

    Args:
        driver: ``mpc``, or a policy of the package.
        place: One of :data:`PLACES`.
        approach: What the filter allows for [m/s].
        latency: Time from a scan to the order that follows from it [s].
        plan: ``"known"`` if the robot knows the walls.
        tasks: Their number.

    Returns:
        Numbers of tasks that ended at the goal, by a touch of a driving robot or of a standing one,
        and by time, and the mean time of those at the goal [s].
    """
    made = make_planner("mpc", robot="kobuki") if driver == "mpc" else load_policy(driver)
    arguments = {**made.env_arguments, "physics": "kinematic", "latency": latency, "plan": plan}
    speeds: dict[int, float] = {}

    def note(env: Any, robot: int, number: int) -> None:
        speeds[number] = abs(float(env.motions[robot, 3]))

    chosen = world_tasks(PLACES[place], episodes=tasks, seed=7, robot="kobuki")
    keep = TaskConfig(**arguments).make_filter(approach=approach)
    results = run_tasks(Filtered(made, keep), chosen, on_end=note, **arguments)
    touched = {number: each.collision for number, each in enumerate(results)}
    times = [each.time_s for each in results if each.success]
    driving = sum(hit and speeds[number] > 1e-6 for number, hit in touched.items())
    return {
        "arrived": sum(each.success for each in results),
        "touched driving": driving,
        "touched standing": sum(touched.values()) - driving,
        "time up": sum(each.timeout for each in results),
        "time [s]": round(float(np.mean(times)), 1) if times else math.nan,
    }


def rows_of(options: argparse.Namespace) -> list[list[Any]]:
    """Rows of what was asked for, which are printed as they come."""
    rows: list[list[Any]] = []

    def add(*row: Any) -> None:
        rows.append(list(row))
        print(",".join(map(str, row)), flush=True)

    if not options.places:
        for speed in SPEEDS:
            for approach, plan in product((0.0, speed), options.plan):
                found = drive_among_walkers(
                    options.decisions,
                    approach=approach,
                    speed=speed,
                    known=plan == "known",
                    seed=options.seed,
                )
                place = f"aimed {speed:g}"
                for name, value in found._asdict().items():
                    add(
                        place,
                        "random",
                        approach,
                        0.0,
                        plan,
                        options.decisions,
                        name,
                        round(value, 1),
                    )
    for place in options.places:
        for driver in options.drivers:
            for plan, late, approach in product(options.plan, options.latency, options.approach):
                found_tasks = drive_tasks(driver, place, approach=approach, latency=late, plan=plan)
                for name, value in found_tasks.items():
                    add(place, driver, approach, late, plan, _TASKS, name, value)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive, and print a row of each number."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--decisions", type=int, default=64_000, help="of a random policy")
    parser.add_argument("--seed", type=int, default=0, help="of a random policy")
    parser.add_argument("--places", nargs="*", choices=PLACES, default=[], help="drive tasks there")
    parser.add_argument("--drivers", nargs="+", choices=DRIVERS, default=DRIVERS)
    parser.add_argument("--approach", type=float, nargs="+", default=[0.0, 0.5, 1.0])
    parser.add_argument("--latency", type=float, nargs="+", default=[0.0], help="of orders [s]")
    parser.add_argument("--plan", nargs="+", choices=["unknown", "known"], default=["unknown"])
    parser.add_argument("--keep", type=Path, help="table to which the rows are added")
    options = parser.parse_args(arguments)
    rows = rows_of(options)
    if options.keep:
        begins = not options.keep.exists()
        with options.keep.open("a", newline="") as file:
            written = csv.writer(file, lineterminator="\n")
            written.writerows([[*COLUMNS]] * begins + rows)


if __name__ == "__main__":
    main()
