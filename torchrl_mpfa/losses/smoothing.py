"""TD3's target smoothing: noise on the target action, which no sharp peak of Q survives.

Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477, section 5.3.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.checks import NOT_NEGATIVE, check
from torchrl_mpfa.losses.functional import smoothed_action, smoothing_noise
from torchrl_mpfa.networks import action_bounds


class TargetSmoothing:
    """Noise within bounds for the target actions of a loss."""

    policy_noise: float
    noise_clip: float
    min_action: Tensor
    max_action: Tensor

    def target_noise(self, action: Tensor) -> Tensor:
        """Noise that smooths the target, as many numbers as actions, ``[B, A]``."""
        return smoothing_noise(action, deviation=self.policy_noise, limit=self.noise_clip)

    def _smoothed(self, action: Tensor) -> Tensor:
        noise = self.target_noise(action)
        return smoothed_action(action, noise, low=self.min_action, high=self.max_action)


def bounds_of(action_spec: Any, bounds: Any) -> tuple[Tensor, Tensor]:
    """Least and greatest action, of a spec or as they are given.

    Raises:
        ValueError: If both or none is given, or they are no bounds.
    """
    if (action_spec is None) == (bounds is None):
        raise ValueError(
            "one of action_spec and bounds must be given, got "
            f"action_spec={action_spec} and bounds={bounds}"
        )
    if action_spec is not None:
        bounds = action_bounds(action_spec)
    low, high = map(torch.as_tensor, bounds)
    if not bool((low.isfinite() & high.isfinite() & (low < high)).all()):
        raise ValueError(f"bounds must be finite, low < high, got {bounds}")
    return low, high


def check_noise(policy_noise: float, noise_clip: float) -> None:
    """Refuse a deviation or a limit of the noise that is negative or not finite."""
    check(NOT_NEGATIVE, policy_noise=policy_noise, noise_clip=noise_clip)
