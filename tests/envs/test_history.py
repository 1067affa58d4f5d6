"""The last scans of the lidar in the observation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpfa_envs import Mirror, NavigationEnv, VectorNavigationEnv
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


def test_the_earlier_scans_stay_while_waiting() -> None:
    env = VectorNavigationEnv(2, world=["B", "D"], physics="kinematic", history=3)
    env.reset(seed=0)
    for step in range(10):
        env.step(actions_of(step, 2))
    before = env.observations
    env.step(actions_of(10, 2), only=np.array([True, False]))
    np.testing.assert_array_equal(env.observations[1], before[1])


def test_the_mirror_turns_each_scan_around() -> None:
    observation = torch.arange(PARTS["lidar_history"].stop, dtype=torch.float32)
    image = Mirror(history=3).observation(observation)
    for first in (0, *range(24, 24 + 3 * 18, 18)):
        assert image[first : first + 18].equal(observation[first : first + 18].flip(0))
    assert image[18:24].equal(Mirror().observation(observation[:24])[18:24])
    assert Mirror(history=3).observation(image).equal(observation)
