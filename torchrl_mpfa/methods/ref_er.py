r"""ReF-ER: remember and forget. Actions that the policy would no longer take teach nothing.

Novati and Koumoutsakos (2019), "Remember and forget for experience replay",
https://arxiv.org/abs/1807.05827. Of transitions whose importance ratio

.. math::

    \rho_i = \frac{\pi(a_i | s_i)}{\mu_i(a_i)}

is outside of :math:`(1 / c, c)` neither critic nor actor learn, and the actor is held near the
behavior :math:`\mu` by a divergence whose weight, nearly all of it at first, falls for as long as
few are. A deterministic
policy counts as a Gaussian around its action, as wide as the behavior was.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import RandomSampler, TensorDictReplayBuffer
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mpfa.checks import COUNT_OR_ZERO, POSITIVE, SHARE, check
from torchrl_mpfa.losses import BEHAVIOR_MEAN, BEHAVIOR_SIGMA, BEHAVIOR_WEIGHT, POLICY_WEIGHT
from torchrl_mpfa.samplers.states import SavedSampler
from torchrl_mpfa.selection import SampledBatch

LEAST_SIGMA = 0.2
"""Lower bound of the noise, as in the authors' code: without noise there is no ratio."""
_CUTOFF_DECAY = 5e-7
_RATE = 0.1
_FIRST_WEIGHT = 1e-4


def actions_of(
    policy: TensorDictModule, batch: TensorDictBase, *, action_key: NestedKey = "action"
) -> Tensor:
    """Compute actions ``[B, A]`` of a policy without exploration, on the device of the batch."""
    read = batch.select(*policy.in_keys)
    parameter = next(policy.parameters(), None)
    if parameter is not None:
        read = read.to(parameter.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action: Tensor = policy(read)[action_key]
    stored: Tensor = batch[action_key]
    if stored.shape != action.shape:
        raise ValueError(
            f"{action_key!r} must have the shape of the policy's actions, {[*action.shape]}, got "
            f"{[*stored.shape]}"
        )
    return action.to(stored.device)


def importance_ratio(action: Tensor, now: Tensor, then: Tensor, sigma: Tensor) -> Tensor:
    r"""Compute the ratio of an action's densities, current policy over behavior, :math:`\rho`.

    Args:
        action: Stored actions, shape ``[B, A]``.
        now: Actions of the current policy, shape ``[B, A]``.
        then: Mean of the behavior, shape ``[B, A]``.
        sigma: Standard deviation of both, shape ``[B, 1]``.

    Returns:
        Ratios, shape ``[B]``.

    Examples:
        >>> zero, one = torch.zeros(1, 1), torch.ones(1, 1)
        >>> round(importance_ratio(zero, zero, one, one).item(), 4)  # e to the half
        1.6487
    """
    exponent = (action - then).square() - (action - now).square()
    return (exponent / (2 * sigma.square())).sum(-1).exp()


def next_weight(weight: float, *, far: float, allowed: float, rate: float) -> float:
    r"""Weight :math:`\beta` of the policy's gradient after a batch of which a share is far.

    With :math:`\eta' = \min(\eta, \beta)` it is :math:`(1 - \eta') \beta` where more are far than
    allowed, else :math:`(1 - \eta') \beta + \min(\eta, 1 - \beta)`.
    """
    lowered = (1.0 - min(rate, weight)) * weight
    return lowered if far > allowed else lowered + min(rate, 1.0 - weight)


class ReFERSampler(SavedSampler, RandomSampler):
    r"""Uniform sampling, with the weight that ReF-ER adapts as a saved state.

    Examples:
        >>> ReFERSampler().policy_weight
        0.0001
    """

    KIND = "ref_er"
    SAVED = ("policy_weight", "batches")

    def __init__(self) -> None:
        super().__init__()
        self.policy_weight = _FIRST_WEIGHT
        self.batches = 0

    def _empty(self) -> None:
        super()._empty()
        # The count of batches is the training's, and stays.
        self.policy_weight = _FIRST_WEIGHT

    def _restore(self, state: dict[str, Any]) -> None:
        super()._restore(state)
        check(SHARE, policy_weight=self.policy_weight)
        check(COUNT_OR_ZERO, batches=self.batches)


class ReFERSelection:
    r"""Selection of ReF-ER: a uniform batch whose far transitions have no weight.

    Args:
        policy: The current policy; writes ``"action"``.
        far_share: Share :math:`D` of far transitions up to which the policy is set free.
        cutoff: :math:`C` of :math:`c = 1 + C / (1 + 5 \cdot 10^{-7} t)`, after ``t`` batches.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor
        >>> ReFERSelection(make_actor(24, 2)).limit(0)
        5.0
    """

    def __init__(
        self, policy: TensorDictModule, *, far_share: float = 0.1, cutoff: float = 4.0
    ) -> None:
        self.policy = policy
        self.far_share: float = check(SHARE, far_share=far_share)
        self.cutoff: float = check(POSITIVE, cutoff=cutoff)

    def limit(self, batches: int) -> float:
        """Compute the ratio :math:`c` above which a transition is far after these batches."""
        return 1.0 + self.cutoff / (1.0 + _CUTOFF_DECAY * batches)

    @torch.no_grad()
    def __call__(self, buffer: TensorDictReplayBuffer) -> Iterator[SampledBatch]:
        """Sample a batch, and set the weights of its transitions.

        Args:
            buffer: The buffer, with a :class:`ReFERSampler`.

        Yields:
            One batch.

        Raises:
            TypeError: If the buffer has another sampler.
            KeyError: If the transitions lack mean or standard deviation of the behavior.
        """
        sampler = buffer.sampler
        if not isinstance(sampler, ReFERSampler):
            raise TypeError(f"buffer must have a ReFERSampler, got {type(sampler).__name__}")
        batch = buffer.sample()
        now = actions_of(self.policy, batch)
        sigma = batch[BEHAVIOR_SIGMA].clamp_min(LEAST_SIGMA)
        if batch[BEHAVIOR_MEAN].shape != now.shape or sigma.shape != (len(batch), 1):
            raise ValueError(
                f"{BEHAVIOR_MEAN!r} must have the shape {[*now.shape]} and {BEHAVIOR_SIGMA!r} "
                f"{[len(batch), 1]}, got {[*batch[BEHAVIOR_MEAN].shape]} and {[*sigma.shape]}"
            )
        ratio = importance_ratio(batch["action"], now, batch[BEHAVIOR_MEAN], sigma)
        limit = self.limit(sampler.batches)
        near = ((ratio > 1.0 / limit) & (ratio < limit)).to(sigma.dtype)
        weight = sampler.policy_weight
        batch[BEHAVIOR_SIGMA] = sigma
        batch["priority_weight"] = near
        batch[POLICY_WEIGHT] = weight * near
        batch[BEHAVIOR_WEIGHT] = torch.full_like(near, 1.0 - weight)
        sampler.policy_weight = next_weight(
            weight,
            far=1.0 - float(near.mean()),
            allowed=self.far_share,
            # By the slots and not what is in them, as in the authors' code: few transitions at the
            # start do not make it faster.
            rate=min(_RATE * len(batch) / buffer.storage.max_size, 1.0),
        )
        sampler.batches += 1
        yield SampledBatch(batch)
