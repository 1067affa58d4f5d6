"""Drive a policy in ir-sim, a simulator of others, by its lidar and among its walkers.

    pip install 'torchrl-mpfa[irsim]'
    python examples/ir_sim.py                              td3-rooms, twenty tasks in rooms
    python examples/ir_sim.py --latency 0.3                orders act late, as the pilot knows
    python examples/ir_sim.py --walkers 4 --behavior rvo --picture drives.png

Each task is one of this package's validation worlds, written as a world of ir-sim, whose robot,
lidar, walkers and collisions are its own. A Pilot drives as on a robot: scan, pose and speeds in,
speeds out. Walkers move by a behavior of ir-sim from place to place: by ``rvo`` they evade, by
``dash`` they do not.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from mpfa_envs import World, WorldTask, export_policy, load_policy, world_tasks
from mpfa_envs.deploy import Pilot, Scan, ScanError
from mpfa_envs.robots.model import RobotModel

STEP = 0.05
"""Time step of the simulator [s]."""
RAYS = 360
"""Rays of its lidar, all round."""
LONGEST = 120.0
"""Time limit of a drive [s]."""


class Drive(NamedTuple):
    """How a drive ended."""

    outcome: str
    """``success``, ``collision`` or ``timeout``."""
    time: float
    """Time of the drive [s]."""
    speed: float
    """Speed of the robot at the end [m/s]."""
    trail: list[tuple[float, float]]
    """Positions of the robot [m]."""


def irsim_world(
    each: WorldTask, robot: RobotModel, *, walkers: int = 0, behavior: str = "rvo", seed: int = 0
) -> dict[str, Any]:
    """Describe a task as a world of ir-sim.

    Args:
        each: The world, of boxes, cylinders and polygons, with start and goal.
        robot: The robot.
        walkers: Number of walkers, of 0.25 m and 0.3 m/s.
        behavior: Theirs, ``"rvo"`` or ``"dash"``.
        seed: Seed of their places.

    Returns:
        What a YAML file of ir-sim holds.
    """
    world, task = each.world, each.task
    width, depth = world.size
    thick = 0.2
    walls = [
        _rectangle(0.0, side * (depth + thick) / 2, width + 2 * thick, thick) for side in (-1, 1)
    ] + [_rectangle(side * (width + thick) / 2, 0.0, thick, depth) for side in (-1, 1)]
    boxes = [
        _rectangle(
            (box.x_min + box.x_max) / 2,
            (box.y_min + box.y_max) / 2,
            box.x_max - box.x_min,
            box.y_max - box.y_min,
        )
        for box in world.boxes
    ]
    cylinders = [
        {"shape": {"name": "circle", "radius": one.radius}, "state": [one.x, one.y, 0.0]}
        for one in world.cylinders
    ]
    polygons = [
        {
            "shape": {"name": "polygon", "vertices": [list(point) for point in one.vertices]},
            "state": [0.0, 0.0, 0.0],
        }
        for one in world.polygons
    ]
    lidar = {
        "type": "lidar2d",
        "range_min": 0.0,
        "range_max": robot.lidar_range,
        "angle_range": math.tau,
        "number": RAYS,
    }
    fastest = robot.max_wheel_speed
    body = {
        "kinematics": {"name": "diff"},
        "shape": {"name": "circle", "radius": robot.radius},
        "state": list(task.start),
        "goal": [*task.goal, 0.0],
        "vel_min": [-fastest, -2 * fastest / robot.wheel_base],
        "vel_max": [fastest, 2 * fastest / robot.wheel_base],
        "sensors": [lidar],
    }
    return {
        "world": {
            "width": width + 1.0,
            "height": depth + 1.0,
            "offset": [-(width + 1.0) / 2, -(depth + 1.0) / 2],
            "step_time": STEP,
            "sample_time": STEP,
            "collision_mode": "stop",
        },
        "robot": [body],
        "obstacle": [
            *(walls + boxes + cylinders + polygons),
            *_walkers(world, task.start[:2], walkers, behavior, seed),
        ],
    }


def _rectangle(x: float, y: float, length: float, width: float) -> dict[str, Any]:
    """An obstacle around a place [m]."""
    shape = {"name": "rectangle", "length": length, "width": width}
    return {"shape": shape, "state": [x, y, 0.0]}


def _walkers(
    world: World, start: Sequence[float], count: int, behavior: str, seed: int
) -> list[dict[str, Any]]:
    """Walkers at free places, 1.5 m from the robot and apart, that go from place to place."""
    rng = np.random.default_rng(seed)
    half = np.array(world.size) / 2
    places: list[tuple[float, float]] = []
    for _ in range(10_000):
        if len(places) == 2 * count:
            break
        x, y = rng.uniform(-half, half).tolist()
        apart = all(math.dist(other, (x, y)) > 0.8 for other in places)
        if world.clearance(x, y) > 0.3 and math.dist((x, y), start) > 1.5 and apart:
            places.append((x, y))
    reach = (half - 0.5).tolist()
    return [
        {
            "kinematics": {"name": "omni"},
            "shape": {"name": "circle", "radius": 0.25},
            "state": [*places[number], 0.0],
            "goal": [*places[count + number], 0.0],
            "vel_min": [-0.3, -0.3],
            "vel_max": [0.3, 0.3],
            "behavior": {
                "name": behavior,
                "wander": True,
                "range_low": [-reach[0], -reach[1], -math.pi],
                "range_high": [*reach, math.pi],
            },
        }
        for number in range(len(places) // 2)
    ]


def drive(pilot: Pilot, world: dict[str, Any], goal: tuple[float, float], seed: int) -> Drive:
    """Drive one task in ir-sim.

    Args:
        pilot: The pilot, of the robot in the world. Orders act as late as its latency says.
        world: What :func:`irsim_world` gave.
        goal: The goal (x, y) [m].
        seed: Seed of the simulator.

    Returns:
        How it ended.
    """
    # Imported here as it opens a backend of pictures, which is not needed to describe a world.
    import irsim

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.yaml"
        path.write_text(yaml.safe_dump(world), encoding="utf-8")
        env = irsim.make(str(path), display=False, log_level="ERROR", seed=seed)
    robot, order, due = env.robot, (0.0, 0.0), 0.0
    wanted = order
    under_way: deque[tuple[float, tuple[float, float]]] = deque()
    pilot.begin(goal, map_center=(0.0, 0.0))
    trail: list[tuple[float, float]] = []
    outcome, time = "timeout", 0.0
    while time < LONGEST:
        x, y, heading = robot.state[:3, 0].tolist()
        trail.append((x, y))
        pose = (x, y, math.remainder(heading, math.tau))
        if robot.collision:
            outcome = "collision"
            break
        if pilot.arrived(pose):
            outcome = "success"
            break
        if time >= due - 1e-9:
            due = time + pilot.period
            seen = env.get_lidar_scan()
            scan = Scan(
                seen["angle_min"], seen["angle_increment"], seen["ranges"], 0.0, seen["range_max"]
            )
            try:
                command = pilot.decide(scan, pose, order, time=time)
                chosen = command.linear, command.angular
            except ScanError:
                chosen = 0.0, 0.0
            under_way.append((time + pilot.latency, chosen))
        while under_way and time >= under_way[0][0] - 1e-9:
            _, wanted = under_way.popleft()
        order = pilot.ramp(order, wanted, STEP)
        env.step(np.array(order).reshape(2, 1))
        time += STEP
    env.end(ending_time=0.0)
    return Drive(outcome, time, abs(order[0]), trail)


def table(drives: Sequence[Drive]) -> str:
    """Return what the drives come to: how many arrived and touched, how fast, in what time."""
    touched = [end.speed for end in drives if end.outcome == "collision"]
    times = [end.time for end in drives if end.outcome == "success"]
    cells = {
        "tasks": str(len(drives)),
        "arrived": str(len(times)),
        "touched": str(len(touched)),
        "touch speed [m/s]": f"{max(touched):.2f}" if touched else "-",
        "mean time [s]": f"{np.mean(times):.1f}" if times else "-",
    }
    values = "  ".join(value.rjust(len(name)) for name, value in cells.items())
    return f"{'  '.join(cells)}\n{values}"


def draw(tasks: Sequence[WorldTask], drives: Sequence[Drive], path: Path) -> None:
    """Write the paths of the drives in the first world."""
    from PIL import Image

    from mpfa_envs.render import render_trajectories

    shown = [n for n, each in enumerate(tasks) if each.world.name == tasks[0].world.name]
    picture = render_trajectories(
        tasks[0].world,
        [drives[n].trail for n in shown],
        [tasks[n].task.goal for n in shown],
        [drives[n].outcome for n in shown],  # type: ignore[misc]
        title=f"{tasks[0].world.name} in ir-sim",
    )
    Image.fromarray(picture).save(path)


def main(arguments: Sequence[str] | None = None) -> list[Drive]:
    """Drive the tasks and print how they ended.

    Args:
        arguments: The command line.

    Returns:
        One drive for each task.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", nargs="?", default="td3-rooms", help="(default: td3-rooms)")
    parser.add_argument("--worlds", default="rooms:validation", help="(default: rooms:validation)")
    parser.add_argument("--episodes", type=int, default=20, help="tasks (default: 20)")
    parser.add_argument(
        "--latency",
        type=float,
        default=0.0,
        help="of orders, which the pilot knows [s] (default: 0)",
    )
    parser.add_argument("--walkers", type=int, default=0, help="in each world (default: none)")
    parser.add_argument(
        "--behavior", choices=["rvo", "dash"], default="rvo", help="of walkers (default: rvo)"
    )
    parser.add_argument("--clearance", type=float, default=0.02, help="[m] (default: 0.02)")
    parser.add_argument(
        "--approach",
        type=float,
        default=0.0,
        help="speed of walkers before which the robot stands [m/s] (default: 0)",
    )
    parser.add_argument("--picture", type=Path, help="file for the paths in the first world")
    options = parser.parse_args(arguments)
    drives = []
    with tempfile.TemporaryDirectory() as folder:
        policy = export_policy(load_policy(options.policy), Path(folder) / "policy.onnx")
        pilot = Pilot.load(
            policy,
            clearance=options.clearance,
            approach=options.approach,
            latency=options.latency,
        )
    tasks = world_tasks(options.worlds, episodes=options.episodes, robot=pilot.robot)
    for number, each in enumerate(tasks):
        crowd = {"walkers": options.walkers, "behavior": options.behavior, "seed": number}
        world = irsim_world(each, pilot.robot, **crowd)
        drives.append(drive(pilot, world, each.task.goal, number))
        end = drives[-1]
        print(f"{each.world.name}: {end.outcome} after {end.time:.1f} s at {end.speed:.2f} m/s")
    print(table(drives))
    if options.picture is not None:
        draw(tasks, drives, options.picture)
        print(f"written: {options.picture}")
    return drives


if __name__ == "__main__":
    main()
