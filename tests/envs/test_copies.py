"""Copies of an environment: independent, or rejected."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import numpy as np
import pytest

from mpfa_envs import NavigationEnv, VectorNavigationEnv

COPIES = [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]
MAKERS = [NavigationEnv, lambda **arguments: VectorNavigationEnv(2, **arguments)]


@pytest.mark.parametrize("duplicate", COPIES, ids=["copy", "pickle"])
@pytest.mark.parametrize("make", MAKERS, ids=["one", "many"])
def test_a_kinematic_copy_drives_the_same_episode_independently(
    make: Callable, duplicate: Callable
) -> None:
    env = make(world="A", physics="kinematic")
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.5)
    env.step(action)
    other = duplicate(env)
    theirs = [other.step(action)[0] for _ in range(3)]
    for expected in theirs:
        np.testing.assert_array_equal(env.step(action)[0], expected)
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])


@pytest.mark.parametrize("duplicate", COPIES, ids=["copy", "pickle"])
def test_a_copy_on_wheels_is_rejected(duplicate: Callable) -> None:
    for make in MAKERS:
        env = make(world="A", physics="wheels")
        with pytest.raises(TypeError, match=r"'wheels' cannot be copied .* state_dict\(\)"):
            duplicate(env)
        env.close()
