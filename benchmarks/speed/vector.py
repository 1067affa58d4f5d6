"""Steps per second of many robots at once.

A step is one time step of one robot: it moves, its lidar casts 54 rays, and its reward is paid. The
robots drive in small circles, so that an episode lasts for hundreds of steps, as in training; what
its end costs, a task and the shortest path of the next one, is in the figures.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.speed.timing import Call, Entry, entry, take_turns
from mpfa_envs import Box, Cylinder, TaskConfig, VectorNavigationEnv, Walker, World

ROBOTS = 64
_CIRCLE = (-1.0, 1.0)
"""Slowest left and fastest right wheel: a circle of 0.3 m."""
_WALKERS = (Walker(radius=0.25, speed=0.2),) * 6
_BESIDE_KINEMATIC = ("vector_map", "vector_walkers", "vector_cylinders", "vector_filter")
"""Entries with a ratio to ``vector_kinematic``."""


def cluttered(name: str, seed: int, *, boxes: int = 0, cylinders: int = 0, size: float) -> World:
    """A square room full of small obstacles that stand where they may."""
    rng = random.Random(seed)
    half = size / 2
    placed_boxes, placed_cylinders = [], []
    for _ in range(boxes):
        width, depth = rng.uniform(0.2, 0.8), rng.uniform(0.2, 0.8)
        x, y = rng.uniform(-half, half - width), rng.uniform(-half, half - depth)
        placed_boxes.append(Box(x, y, x + width, y + depth))
    for _ in range(cylinders):
        radius = rng.uniform(0.05, 0.1)
        x, y = (rng.uniform(radius - half, half - radius) for _ in range(2))
        placed_cylinders.append(Cylinder(x, y, radius))
    return World(
        name=name,
        size=(size, size),
        boxes=tuple(placed_boxes),
        cylinders=tuple(placed_cylinders),
    )


def _stepper(
    world: World, *, physics: Any = "kinematic", memory: Any = "none", robots: int = ROBOTS
) -> Call:
    """A call that makes one time step of all robots."""
    env = VectorNavigationEnv(
        robots,
        world=world,
        physics=physics,
        memory=memory,
        action_repeat=1,
        detour_chance=0.0,
    )
    env.reset(seed=0)
    actions = np.tile(np.array(_CIRCLE, dtype=np.float32), (robots, 1))
    return lambda: env.step(actions)


def _filter(world: World) -> Call:
    """A call of the filter alone, of robots that want to do anything anywhere in a world."""
    arguments: dict[str, Any] = {"robot": "kobuki", "physics": "kinematic"}
    env = VectorNavigationEnv(ROBOTS, world=world, detour_chance=0.0, **arguments)
    rng = np.random.default_rng(0)
    observations, _ = env.reset(seed=0)
    for _ in range(50):
        actions = rng.uniform(-0.5, 1.0, (ROBOTS, 2)).astype(np.float32)
        observations, *_ = env.step(actions)
    env.close()
    actions = rng.uniform(-1.0, 1.0, (ROBOTS, 2)).astype(np.float32)
    keep = TaskConfig(**arguments).make_filter()
    return lambda: keep(observations, actions)


def _torchrl_stepper(world: World) -> Call:
    """The same through TorchRL: a step, and the reset of the robots whose episode has ended."""
    import torch

    from mpfa_envs import make_navigation_env

    env = make_navigation_env(
        world,
        num_envs=ROBOTS,
        physics="kinematic",
        action_repeat=1,
        detour_chance=0.0,
        info_keys=("success", "collision", "timeout"),
        seed=0,
    )
    actions = torch.tensor(_CIRCLE).expand(ROBOTS, 2)
    state = env.reset()

    def step() -> None:
        nonlocal state
        _, state = env.step_and_maybe_reset(state.set("action", actions))

    return step


def measure(*, quick: bool) -> list[Entry]:
    """Measure kinematic robots among 30 obstacles, walkers, or 300 cylinders, map, filter, wheels.

    There are 64 of them, and sixteen on wheels and in ``vector_sixteen``.

    The ratios of ``vector_map``, ``vector_walkers``, ``vector_cylinders`` and ``vector_filter`` are
    their times over that of ``vector_kinematic``.
    """
    sparse = cluttered("thirty", 1, boxes=20, cylinders=10, size=14.0)
    dense = cluttered("three hundred", 2, cylinders=300, size=20.0)
    calls: dict[str, Callable[[], object]] = {
        "vector_kinematic": _stepper(sparse),
        "vector_map": _stepper(sparse, memory="map"),
        "vector_walkers": _stepper(replace(sparse, walkers=_WALKERS)),
        "vector_cylinders": _stepper(dense),
        "vector_filter": _filter(dense),
        "vector_sixteen": _stepper(sparse, robots=16),
        "vector_wheels": _stepper(sparse, physics="wheels", robots=16),
    }
    calls["torchrl_vector"] = _torchrl_stepper(sparse)
    timings = take_turns(calls, rounds=3 if quick else 9, seconds=0.1 if quick else 1.0)
    robots = {"vector_sixteen": 16, "vector_wheels": 16}
    rates = {name: robots.get(name, ROBOTS) / timing.median for name, timing in timings.items()}
    return [
        entry(
            name,
            rate,
            "steps/s",
            ratio=timings[name].ratio(timings["vector_kinematic"]),
            baseline="vector_kinematic",
        )
        if name in _BESIDE_KINEMATIC
        else entry(name, rate, "steps/s")
        for name, rate in rates.items()
    ]
