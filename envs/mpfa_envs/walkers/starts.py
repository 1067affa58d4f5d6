"""Starts of walkers at the beginning of an episode."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.shapes import Point
    from mpfa_envs.worlds.walker import Walker
    from mpfa_envs.worlds.world import World

WalkerStarts: TypeAlias = "tuple[NDArray[np.float64], NDArray[np.int64]]"
"""(x, y) and both speeds [m, m/s], ``[K, 4]``; the index of the next waypoint, ``[K]``."""
_START: Final = 1.0
"""Distance of a walker's rim from the robot's center at the start, where that is possible [m]."""
_SLACK: Final = 0.02
"""Distance of a walker's rim from obstacles at the start [m]."""
_SAMPLES: Final = 256
"""Places that are sampled at once."""
_FEW: Final = 16
"""Those of them that are checked first."""
_ROUNDS: Final = 20


def start_walkers(world: World, start: Point, rng: np.random.Generator) -> WalkerStarts:
    """Sample the starts of a world's walkers."""
    states = np.zeros((len(world.walkers), 4))
    targets = np.zeros(len(world.walkers), dtype=np.int64)
    taken = [(*start, _START)]
    for number, walker in enumerate(world.walkers):
        sample = _sample_room if walker.behavior == "straight" else _sample_round
        for _ in range(_ROUNDS):
            places, nexts, headings = sample(world, walker, rng)
            chosen = _choose(world, walker, places, taken)
            if chosen is not None:
                break
        else:
            raise ValueError(f"world {world.name!r} has no place for {walker}")
        x, y = places[chosen].tolist()
        heading = float(headings[chosen])
        states[number] = x, y, walker.speed * math.cos(heading), walker.speed * math.sin(heading)
        targets[number] = nexts[chosen]
        taken.append((x, y, walker.radius))
    return states, targets


def _choose(
    world: World,
    walker: Walker,
    places: NDArray[np.float64],
    taken: list[tuple[float, float, float]],
) -> int | None:
    """Number of the first free place that is far enough from what is taken, or of the farthest."""
    # One of the first nearly always does; checking all takes ten times as long.
    for few in (places[:_FEW], places):
        gaps = np.min([np.hypot(few[:, 0] - x, few[:, 1] - y) - reach for x, y, reach in taken], 0)
        free = np.ones(len(few), dtype=np.bool_)
        if walker.behavior == "straight":  # A round is free, which the world has checked.
            free = world.clearances(few) >= walker.radius + _SLACK
        enough = free & (gaps >= walker.radius)
        if enough.any():
            return int(np.argmax(enough))
    return int(np.argmax(np.where(free, gaps, -np.inf))) if free.any() else None


def _sample_room(
    world: World, walker: Walker, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Places anywhere in the room with a direction each: (x, y), 0 and heading."""
    half = np.array(world.size) / 2 - walker.radius
    places = rng.uniform(-half, half, (_SAMPLES, 2))
    headings = rng.uniform(-math.pi, math.pi, _SAMPLES)
    return places, np.zeros(_SAMPLES, dtype=np.int64), headings


def _sample_round(
    world: World, walker: Walker, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Places anywhere on a walker's round: (x, y), the next waypoint and the heading to it."""
    points = np.array(walker.waypoints)
    steps = np.roll(points, -1, axis=0) - points
    ends = np.cumsum(np.hypot(*steps.T))
    along = rng.uniform(0.0, ends[-1], _SAMPLES)
    legs = np.minimum(np.searchsorted(ends, along, side="right"), len(points) - 1)
    shares = 1.0 - (ends[legs] - along) / np.hypot(*steps[legs].T)
    places = points[legs] + shares[:, None] * steps[legs]
    return places, (legs + 1) % len(points), np.arctan2(steps[legs, 1], steps[legs, 0])
