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
from functools import partial
from itertools import cycle
from typing import Any

import numpy as np

from benchmarks.speed.bullet_world import BulletWorld
from benchmarks.speed.timing import Call, Entry, entry, seconds_per_call, take_turns
from mpfa_envs import PAPER_TASK, WORLDS, Lidar, NavigationEnv, Task, World
from mpfa_envs.paths.distance import is_reachable, shortest_length
from mpfa_envs.render import render_trajectories, tiled
from mpfa_envs.tasks.sampling import evaluation_pairs

ROUNDS = 5
PAIRS = 200
_ROLLOUT = 20
"""Steps of a rollout."""
_BASELINES = {
    "env": ("env_wheels", "steps/s"),
    "torchrl_env": ("env_kinematic", "steps/s"),
    "lidar": ("lidar_pybullet", "scans/s"),
}
"""Baseline and unit of each kind of figure."""
GRID = np.arange(-4.95, 5.0, 0.1)


def _stepper(env: NavigationEnv) -> Call:
    """Return a function that makes one step of random driving, resets included."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (4096, 2)).astype(np.float32)
    numbers = cycle(0.3 * actions + 0.6)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(numbers))
        if terminated or truncated:
            env.reset()

    return step


def _physics_share(env: NavigationEnv, steps: int) -> float:
    """Return the part of the CPU time of driving, resets included, that moving the robot takes."""
    step, drives, spent = _stepper(env), env.robots._batch.drives, 0.0
    move = drives.move

    def timed(*arguments: Any) -> Any:
        nonlocal spent
        start = time.process_time()
        found = move(*arguments)
        spent += time.process_time() - start
        return found

    drives.move = timed  # type: ignore[method-assign, assignment]
    whole = steps * seconds_per_call(step, steps)
    return spent / whole


def measure(*, seconds: float = 2.0) -> list[Entry]:
    """Measure environment and lidar in world D, each for some CPU time [s]; return rates [1/s]."""
    # Imported here: the rest of the file needs no TorchRL.
    from mpfa_envs import make_navigation_env

    task: dict[str, Any] = {"action_repeat": 1}
    envs = {p: NavigationEnv(world="D", physics=p, **task) for p in ("wheels", "kinematic")}
    calls: dict[str, Call] = {f"env_{name}": _stepper(env) for name, env in envs.items()}
    steps: dict[str, int] = {}
    for name, num_envs, keys in (
        ("torchrl_env", None, None),
        ("torchrl_env_without_info", None, ()),
        ("torchrl_env_batch_of_8", 8, None),
    ):
        how = {"num_envs": num_envs, "info_keys": keys, "seed": 0, **task}
        batch = make_navigation_env("D", physics="kinematic", **how)
        calls[name] = partial(batch.rollout, _ROLLOUT, break_when_any_done=False)
        steps[name] = _ROLLOUT * (num_envs or 1)
    lidar, bullet = Lidar(WORLDS["D"]), BulletWorld(WORLDS["D"])
    calls["lidar_pybullet"] = lambda: bullet.cast_rays(0.1, 0.2, lidar.angles + 0.3, reach=10.0)
    calls["lidar"] = lambda: lidar.cast(0.1, 0.2, 0.3)
    timings = take_turns(calls, rounds=ROUNDS, seconds=seconds / ROUNDS)
    rates = {name: steps.get(name, 1) / timing.median for name, timing in timings.items()}
    entries = []
    for name, rate in rates.items():
        kind = next(kind for kind in _BASELINES if name.startswith(kind))
        baseline, unit = _BASELINES[kind]
        ratio = None if name == "lidar_pybullet" else rate / rates[baseline]
        of = None if ratio is None else baseline
        entries.append(entry(name, rate, unit, ratio=ratio, baseline=of))
    for name, env in envs.items():
        count = max(20, round(rates[f"env_{name}"] * seconds / ROUNDS))
        share = _physics_share(env, count)
        entries.append(entry(f"env_{name}_physics_share", share, "fraction"))
        env.close()
    bullet.close()
    return entries


def drive_straight(env: NavigationEnv, task: Task) -> str:
    """Turn to the goal and drive at it, blind to obstacles; return the outcome."""
    _, info = env.reset(options=task._asdict())
    x, y = task.goal
    while True:
        bearing = math.remainder(
            math.atan2(y - info["y"], x - info["x"]) - info["heading"], math.tau
        )
        turn = min(max(2.0 * bearing, -1.0), 1.0)
        action = np.array([1.0 - 2.0 * max(turn, 0.0), 1.0 + 2.0 * min(turn, 0.0)])
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            outcomes = ("success", "collision", "timeout")
            return next(name for name in outcomes if info[name])


def describe_world(world: World) -> dict[str, float]:
    """Measure density and blind success of a world; shares are of 200 tasks of seed 0."""
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
    for name, contact in (("straight fails, 0.35 m", False), ("straight fails, contact", True)):
        env = NavigationEnv(world=world, physics="kinematic", contact=contact, **PAPER_TASK)
        row[name] = sum(drive_straight(env, pair) != "success" for pair in pairs) / PAIRS
    return row


def render_worlds(*, size: int = 224) -> np.ndarray[Any, Any]:
    """Render the built-in worlds, three in a row, each with this side [px]."""
    pictures = [
        render_trajectories(world, [], [], [], title=name, size=size)
        for name, world in WORLDS.items()
    ]
    return tiled(pictures, columns=3)


def main() -> None:
    """Print what the arguments ask for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
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
        for found in measure(seconds=arguments.seconds):
            ratio = f"{found['ratio']:8.2f} x {found['baseline']}" if found["baseline"] else ""
            print(f"{found['name']:30} {found['value']:12.4g} {found['unit']:9} {ratio}")


if __name__ == "__main__":
    main()
