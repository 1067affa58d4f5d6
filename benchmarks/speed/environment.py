"""Steps per second of the navigation task, and how hard its worlds are.

    python -m benchmarks.speed.environment                     # speed
    python -m benchmarks.speed.environment --worlds            # table of the worlds
    python -m benchmarks.speed.environment --picture FILE.png  # picture of the worlds

All times are CPU time of one thread (``time.process_time``), because wall-clock time on a shared
machine measures its other users too. Every figure is the median of several short runs.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.speed.bullet_world import BulletWorld
from mpfa_envs import PAPER_TASK, WORLDS, Lidar, NavigationEnv, World
from mpfa_envs.paths.lengths import grid_for, is_reachable, shortest_length
from mpfa_envs.planners import astar_path
from mpfa_envs.render import render_trajectories, tiled
from mpfa_envs.tasks.sampling import evaluation_pairs

ROUNDS = 5
PAIRS = 200
GRID = np.arange(-4.95, 5.0, 0.1)
_CORNER_REACHED = 0.2
"""Distance from a corner of its path at which a robot turns to the next [m]."""


def _entry(
    name: str, value: float, unit: str, *, ratio: float | None = None, baseline: str | None = None
) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "ratio": ratio, "baseline": baseline}


def _rate(run: Callable[[int], None], seconds: float) -> float:
    """Calls per CPU second of ``run(count)``, the median over the rounds."""
    run(10)
    count, spent = 10, 0.0
    while spent < seconds / ROUNDS / 4:
        count *= 2
        start = time.process_time()
        run(count)
        spent = time.process_time() - start
    count = max(1, round(count * seconds / ROUNDS / spent))
    rates = []
    for _ in range(ROUNDS):
        start = time.process_time()
        run(count)
        rates.append(count / max(time.process_time() - start, 1e-9))
    return statistics.median(rates)


class _Clock:
    """Wraps a method and adds up the CPU time that it takes [s]."""

    def __init__(self, method: Callable[..., Any]) -> None:
        self.method = method
        self.spent = 0.0

    def __call__(self, *args: Any) -> Any:
        start = time.process_time()
        result = self.method(*args)
        self.spent += time.process_time() - start
        return result


def _stepper(env: NavigationEnv) -> Callable[[int], None]:
    """Random driving with resets, as training does it."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (4096, 2)).astype(np.float32)
    actions[:, 0] = actions[:, 0] * 0.3 + 0.6
    actions[:, 1] = actions[:, 1] * 0.3 + 0.6

    def run(count: int) -> None:
        for i in range(count):
            _, _, terminated, truncated, _ = env.step(actions[i % 4096])
            if terminated or truncated:
                env.reset()

    return run


def _physics_share(env: NavigationEnv, steps: int) -> float:
    """Part of the CPU time of driving that moving the robot takes, resets included in the whole."""
    run = _stepper(env)
    drives = env.robots._batch.drives
    clock = _Clock(drives.move)
    drives.move = clock  # type: ignore[method-assign, assignment]
    start = time.process_time()
    run(steps)
    return clock.spent / (time.process_time() - start)


def measure(*, seconds: float = 2.0) -> list[dict[str, Any]]:
    """Measure the environment in world D.

    Args:
        seconds: CPU time for each figure [s].

    Returns:
        Entries with the keys ``name``, ``value``, ``unit``, ``ratio`` and ``baseline``; a ratio is
        the value over that of the entry that ``baseline`` names.
    """
    # Imported here: the rest of the file needs no torch.
    import torch

    from mpfa_envs import make_navigation_env

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        entries, rates = [], {}
        for physics in ("wheels", "kinematic"):
            env = NavigationEnv(world="D", physics=physics, action_repeat=1)
            rates[physics] = _rate(_stepper(env), seconds)
            share = _physics_share(env, max(20, round(rates[physics] * seconds / ROUNDS)))
            env.close()
            entries += [
                _entry(
                    f"env_{physics}",
                    rates[physics],
                    "steps/s",
                    ratio=rates[physics] / rates["wheels"],
                    baseline="env_wheels",
                ),
                _entry(f"env_{physics}_physics_share", share, "fraction"),
            ]
        for name, num_envs, keys in (
            ("torchrl_env", None, None),
            ("torchrl_env_without_info", None, ()),
            ("torchrl_env_batch_of_8", 8, None),
        ):
            batch = make_navigation_env(
                "D",
                physics="kinematic",
                action_repeat=1,
                num_envs=num_envs,
                info_keys=keys,
                seed=0,
            )

            def run(count: int, env: Any = batch) -> None:
                env.rollout(count, break_when_any_done=False)

            rate = _rate(run, seconds) * (num_envs or 1)
            batch.close()
            entries.append(
                _entry(
                    name,
                    rate,
                    "steps/s",
                    ratio=rate / rates["kinematic"],
                    baseline="env_kinematic",
                )
            )
        return entries + _measure_lidar(seconds)
    finally:
        torch.set_num_threads(threads)


def _measure_lidar(seconds: float) -> list[dict[str, Any]]:
    """Compare the lidar with PyBullet's ray test."""
    lidar = Lidar(WORLDS["D"])
    bullet = BulletWorld(WORLDS["D"])

    def ours(count: int) -> None:
        for _ in range(count):
            lidar.cast(0.1, 0.2, 0.3)

    def engine(count: int) -> None:
        for _ in range(count):
            bullet.cast_rays(0.1, 0.2, lidar.angles + 0.3, reach=10.0)

    rates = _rate(engine, seconds), _rate(ours, seconds)
    bullet.close()
    return [
        _entry("lidar_pybullet", rates[0], "scans/s"),
        _entry("lidar", rates[1], "scans/s", ratio=rates[1] / rates[0], baseline="lidar_pybullet"),
    ]


def drive_straight(env: NavigationEnv, options: dict[str, Any]) -> tuple[str, list[Any]]:
    """Turn to the goal and drive at it, blind to obstacles.

    Args:
        env: The environment.
        options: The task.

    Returns:
        How the episode ended and the path of the robot.
    """
    return _follow(env, options, [options["goal"]])


def drive_shortest_path(env: NavigationEnv, options: dict[str, Any]) -> tuple[str, list[Any]]:
    """Follow the shortest path, at the paper's collision distance where there is one.

    Args:
        env: The environment.
        options: The task.

    Returns:
        How the episode ended and the path of the robot.
    """
    start, goal = options["start"][:2], options["goal"]
    for radius in (PAPER_TASK["collision_distance"], env.config.robot.radius):
        path = astar_path(grid_for(env.world, radius), start, goal)
        if path is not None:
            return _follow(env, options, path[1:])
    raise ValueError(f"there is no path from {start} to {goal}")


def _follow(
    env: NavigationEnv, options: dict[str, Any], corners: list[tuple[float, float]]
) -> tuple[str, list[Any]]:
    """Drive at one corner after the other; the last one is the goal."""
    _, info = env.reset(options=options)
    number = 0
    while True:
        while number < len(corners) - 1 and _distance(info, corners[number]) < _CORNER_REACHED:
            number += 1
        x, y = corners[number]
        bearing = math.remainder(
            math.atan2(y - info["y"], x - info["x"]) - info["heading"], math.tau
        )
        turn = min(max(2.0 * bearing, -1.0), 1.0)
        action = np.array([1.0 - 2.0 * max(turn, 0.0), 1.0 + 2.0 * min(turn, 0.0)])
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            outcomes = ("success", "collision", "timeout")
            return next(name for name in outcomes if info[name]), env.trail


def _distance(info: dict[str, Any], point: tuple[float, float]) -> float:
    return math.dist((info["x"], info["y"]), point)


def describe_world(world: World) -> dict[str, float]:
    """Measure how dense a world is and how far a robot gets in it without seeing.

    Args:
        world: The world.

    Returns:
        Figures by name; shares are of 200 tasks of seed 0.
    """
    pairs = evaluation_pairs(world, PAIRS, seed=0)
    clearances = [world.clearance(x, y) for x in GRID for y in GRID]
    lengths = [shortest_length(world, 0.18, pair.start[:2], pair.goal) for pair in pairs]
    direct = [math.dist(pair.start[:2], pair.goal) for pair in pairs]
    row = {
        "obstacles": float(world.obstacle_count),
        "covered area [m²]": world.covered_area,
        "mean clearance [m]": statistics.mean(c for c in clearances if c > 0),
        "path / straight line": statistics.mean(
            a / b for a, b in zip(lengths, direct, strict=True)
        ),
        "path at 0.35 m": sum(is_reachable(world, 0.35, p.start[:2], p.goal) for p in pairs)
        / PAIRS,
    }
    for name, rule, drive in (
        ("straight fails, 0.35 m", 0.35, drive_straight),
        ("straight fails, contact", "contact", drive_straight),
        ("A* fails, contact", "contact", drive_shortest_path),
    ):
        task = {**PAPER_TASK, "collision_distance": rule}
        env = NavigationEnv(world=world, physics="kinematic", **task)
        fails = [drive(env, pair._asdict())[0] != "success" for pair in pairs]
        row[name] = sum(fails) / PAIRS
    return row


def render_worlds(*, size: int = 224) -> np.ndarray[Any, Any]:
    """Render the built-in worlds, three in a row.

    Args:
        size: Side of each [px].

    Returns:
        Picture of shape ``[height, width, 3]``.
    """
    pictures = [
        render_trajectories(world, [], [], [], title=name, size=size)
        for name, world in WORLDS.items()
    ]
    return tiled(pictures, columns=3)


def main() -> None:
    """Print what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0, help="CPU time per figure [s]")
    parser.add_argument("--worlds", action="store_true", help="describe the worlds instead")
    parser.add_argument("--picture", help="render the worlds into this file instead")
    arguments = parser.parse_args()
    if arguments.picture:
        from PIL import Image

        Image.fromarray(render_worlds()).save(arguments.picture)
    elif arguments.worlds:
        for number, (name, world) in enumerate(WORLDS.items()):
            row = describe_world(world)
            if number == 0:
                print("| world | " + " | ".join(row) + " |\n|---" + "|---" * len(row) + "|")
            cells = (
                f"{value:.0%}" if "fails" in k or "at 0" in k else f"{value:.4g}"
                for k, value in row.items()
            )
            print(f"| {name} | " + " | ".join(cells) + " |")
    else:
        for entry in measure(seconds=arguments.seconds):
            ratio = f"{entry['ratio']:8.2f} x {entry['baseline']}" if entry["baseline"] else ""
            print(f"{entry['name']:30} {entry['value']:12.4g} {entry['unit']:9} {ratio}")


if __name__ == "__main__":
    main()
