"""Walkers that are put somewhere else: what was known of where they were must not count."""

from __future__ import annotations

import numpy as np
import pytest

from mpfa_envs import Lidar, Walker, World
from mpfa_envs.walkers.batch import WalkerBatch, WalkerStarts, start_walkers
from mpfa_envs.worlds.batch import WorldBatch

HALL = World(name="hall", size=(40.0, 40.0), walkers=(Walker(speed=1.0),))


def starts(*states: list[float]) -> WalkerStarts:
    """Walkers that are somewhere (x, y) and go somewhere."""
    return np.array(states), np.zeros(len(states), dtype=np.int64)


@pytest.mark.parametrize("room", ["same", "other"])
def test_a_walker_that_is_moved_looks_around_again(room: str) -> None:
    batch = WalkerBatch(WorldBatch([HALL]), radius=0.18, time_step=0.1)
    batch.begin(0, starts([0.0, 0.0, 1.0, 0.0]))
    everyone, nobody = np.ones(1, dtype=np.bool_), np.zeros((1, 5))
    for _ in range(5):  # Now it knows that nothing is near.
        batch.move(everyone, nobody)
    if room == "same":
        batch.begin(0, starts([19.5, 0.0, 1.0, 0.0]))
    else:
        batch._worlds[0] = World(name="cell", size=(2.0, 2.0), walkers=HALL.walkers)
        batch.begin(0, start_walkers(batch._worlds[0], (0.5, 0.5), np.random.default_rng(0)))
    world = batch._worlds[0]
    for _ in range(30):
        batch.move(everyone, nobody)
        assert world.clearances(batch.of(0)[:, :2])[0] >= 0.25 - 1e-9


def test_a_map_is_shown_no_walker_by_a_noisy_lidar_either() -> None:
    world = World(name="two", walkers=(Walker(radius=0.4), Walker(radius=0.4)))
    batch = WalkerBatch(WorldBatch([world]), radius=0.18, time_step=0.1)
    batch.begin(0, starts([2.0, 0.5, 0.3, 0.0], [1.5, -1.0, 0.3, 0.0]))
    lidar, rng, seen, met = Lidar(world, noise=0.1), np.random.default_rng(0), 0, 0
    pose, motions, circles = (0.0, 0.0, 0.0), np.zeros((1, 5)), batch.of(0)[:, [0, 1, 4]]
    hits = lidar.cast(*pose, moving=circles) < lidar.cast(*pose)
    for _ in range(50):
        ranges = lidar.measure(*pose, rng=rng, moving=circles)[None]
        left = batch.without(motions, lidar, ranges)
        seen += int((left[0, hits] < lidar.max_range).sum())
        met += int(hits.sum())
    assert met > 300
    assert seen < 0.02 * met  # A thousandth is beyond three deviations.
