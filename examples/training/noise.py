"""Noise on the rewards that a learner sees, in a third of the states: for experiments about it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mpfa_envs.sensing.observation import DISTANCE_SCALE

RING = 1.0
"""Width of a ring around the goal [m]; the second of every three is noisy."""


def noisy_states(goal_distance: Tensor) -> Tensor:
    """Which states are noisy: those 1 to 2 m, 4 to 5 m, ... from the goal.

    Neither the policy nor a mirror changes that, and a critic can learn it.

    Args:
        goal_distance: The part of observations of this name, shape ``[B]``.

    Returns:
        Booleans, shape ``[B]``.

    Examples:
        >>> noisy_states(torch.tensor([0.05, 0.15, 0.25, 0.45])).tolist()
        [False, True, False, True]
    """
    ring = (goal_distance * (DISTANCE_SCALE / RING)).floor().long()
    return ring % 3 == 1


def noisy_rewards(
    reward: Tensor, goal_distance: Tensor, *, deviation: float, seed: tuple[int, ...]
) -> Tensor:
    """Rewards with normal noise in the noisy states, the same for the same seed.

    Args:
        reward: Rewards, shape ``[B, 1]``.
        goal_distance: Part of the observations before them, shape ``[B]``.
        deviation: Standard deviation of the noise.
        seed: Numbers of which its seed is made.

    Returns:
        New rewards, shape ``[B, 1]``.

    Examples:
        >>> distance = torch.tensor([0.05, 0.15])
        >>> noisy = noisy_rewards(torch.zeros(2, 1), distance, deviation=2.0, seed=(0, 0))
        >>> (noisy != 0).flatten().tolist()
        [False, True]
    """
    (number,) = np.random.SeedSequence(seed).generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(number >> 1))
    noise = torch.randn(reward.shape, generator=generator, dtype=reward.dtype)
    return reward + deviation * noise * noisy_states(goal_distance).unsqueeze(-1)
