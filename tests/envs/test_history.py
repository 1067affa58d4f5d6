"""The last scans of the lidar in the observation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpfa_envs import Mirror, NavigationEnv
from mpfa_envs.sensing.observation import observation_slices

NAMES = ["B", "D"]
PARTS = observation_slices(history=3)


def actions_of(step: int, robots: int) -> np.ndarray:
    return np.random.default_rng(step).uniform(-0.3, 1.0, (robots, 2)).astype(np.float32)


@pytest.mark.parametrize("memory", ["none", "map"])
def test_the_earlier_scans_come_newest_first(memory: str) -> None:
    plain, long = (
        NavigationEnv(world="D", physics="kinematic", memory=memory, history=history)
        for history in (0, 3)
    )
    parts = observation_slices(memory=memory, history=3)
    for seed in (0, 1):
        seen, _ = plain.reset(seed=seed)
        observation, _ = long.reset(seed=seed)
        scans = [seen[:18]] * 3
        for step in range(30):
            np.testing.assert_array_equal(observation[: len(seen)], seen)
            np.testing.assert_array_equal(observation[parts["lidar_history"]], np.ravel(scans))
            assert long.observation_space.contains(observation)
            scans = [seen[:18], *scans[:2]]
            action = actions_of(step, 1)[0] - 0.5
            (seen, _, ended, _, _), (observation, *_) = plain.step(action), long.step(action)
            if ended:
                break
        assert step > 3


@pytest.mark.parametrize("sectors", [8, 18])
def test_the_mirror_turns_each_scan_around(sectors: int) -> None:
    mirror, now = Mirror(sectors=sectors, history=3), sectors + 6
    observation = torch.arange(now + 3.0 * sectors)
    image = mirror.observation(observation)
    for first in (0, *range(now, now + 3 * sectors, sectors)):
        assert image[first : first + sectors].equal(observation[first : first + sectors].flip(0))
    plain = Mirror(sectors=sectors).observation(observation[:now])
    assert image[sectors:now].equal(plain[sectors:])
    assert mirror.observation(image).equal(observation) and not image.equal(observation)
