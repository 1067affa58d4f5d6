"""Where walkers start: the first of many places that will do, by a plain loop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mpfa_envs import Walker, World, generate_world
from mpfa_envs.walkers.batch import start_walkers

FULL = replace(
    generate_world("rooms", 3), walkers=tuple(Walker(radius=0.5 + 0.01 * n) for n in range(26))
)


def plain_starts(world: World, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Places of straight walkers: the first free one that keeps its distance, or the farthest."""
    taken = [(0.5, -0.5, 1.0)]
    for walker in world.walkers:
        half = np.array(world.size) / 2 - walker.radius
        places = rng.uniform(-half, half, (256, 2)).tolist()
        rng.uniform(-math.pi, math.pi, 256)
        best, most = (math.nan, math.nan), -math.inf
        for x, y in places:
            if world.clearance(x, y) < walker.radius + 0.02:
                continue
            gap = min(math.hypot(x - at_x, y - at_y) - reach for at_x, at_y, reach in taken)
            if gap >= walker.radius:
                best = (x, y)
                break
            if gap > most:
                best, most = (x, y), gap
        taken.append((*best, walker.radius))
    return [(x, y) for x, y, _ in taken[1:]]


@pytest.mark.parametrize("seed", range(4))
def test_walkers_start_at_the_first_suitable_or_farthest_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    states, _ = start_walkers(FULL, (0.5, -0.5), rng)
    other = np.random.default_rng(seed)
    expected = plain_starts(FULL, other)
    np.testing.assert_allclose(states[:, :2], expected, atol=1e-12)
    assert rng.bit_generator.state == other.bit_generator.state
    # Some found no place that kept its distance.
    gaps = [
        math.dist(a, b) - one.radius - two.radius
        for number, (a, one) in enumerate(zip(expected, FULL.walkers, strict=True))
        for b, two in zip(expected[:number], FULL.walkers, strict=False)
    ]
    assert min(gaps) < 0.0
