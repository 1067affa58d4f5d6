"""What a batch can say of how far an actor may go from the behavior that made it (ReF-ER)."""

from __future__ import annotations

from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

POLICY_WEIGHT = "policy_weight"
BEHAVIOR_WEIGHT = "behavior_weight"
BEHAVIOR_MEAN = "behavior_mean"
BEHAVIOR_SIGMA = "behavior_sigma"
BEHAVIOR = (BEHAVIOR_MEAN, BEHAVIOR_SIGMA)


class Trust(NamedTuple):
    """How the actor's loss of each transition is weighed, and what it is held near."""

    policy: Tensor
    """Weight of the loss, shape ``[B]``."""
    behavior: Tensor
    """Weight of the divergence from the behavior, shape ``[B]``."""
    mean: Tensor
    """Mean of the behavior's actions, shape ``[B, A]``."""
    sigma: Tensor
    """Their standard deviation, shape ``[B, 1]``."""


def read_trust(batch: TensorDictBase) -> Trust | None:
    """What a batch says; None if it says nothing, and the actor is free."""
    if batch.get(POLICY_WEIGHT, None) is None:
        return None
    policy, behavior = batch[POLICY_WEIGHT].reshape(-1), batch[BEHAVIOR_WEIGHT].reshape(-1)
    return Trust(policy, behavior, batch[BEHAVIOR_MEAN], batch[BEHAVIOR_SIGMA])


def trusted_loss(loss: Tensor, action: Tensor, trust: Trust | None) -> Tensor:
    r"""Loss of the actor with the divergence from the behavior.

    .. math::

        w_i L_i + v_i \sum_a \frac{(a_i - \mu_i)^2}{2 \sigma_i^2}

    The second term is the divergence of two Gaussians of one width, around the actor's action and
    around the behavior's mean.

    Args:
        loss: Loss of each transition :math:`L_i`, shape ``[B]``.
        action: The actor's actions, shape ``[B, A]``.
        trust: Weights and behavior; None leaves the loss as it is.

    Returns:
        Losses, shape ``[B]``.

    Examples:
        >>> import torch
        >>> one = torch.ones(1)
        >>> trust = Trust(0.5 * one, one, torch.zeros(1, 2), 0.5 * torch.ones(1, 1))
        >>> trusted_loss(torch.tensor([4.0]), torch.ones(1, 2), trust).tolist()
        [6.0]
    """
    if trust is None:
        return loss
    distance = ((action - trust.mean) / trust.sigma).square().sum(-1) / 2
    found: Tensor = trust.policy * loss + trust.behavior * distance
    return found
