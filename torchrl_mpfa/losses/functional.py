r"""The mathematics of the losses as pure functions, of the eager and of the compiled update alike.

In the shapes ``B`` is a batch (of one or more dimensions), ``C`` the number of critics and ``A``
the size of an action.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives.utils import distance_loss

from torchrl_mpfa.checks import as_mask

PAL = "pal"
DISTANCES = ("l1", "l2", "smooth_l1", PAL)
"""Names of the loss functions, of which all but the last are TorchRL's too."""

LEAST_NOISE = 0.05
"""Standard deviation below which a target counts as certain, in units of the reward: without noise
the errors of a network would otherwise be infinitely informative."""
POLICY_WEIGHT = "policy_weight"
BEHAVIOR_WEIGHT = "behavior_weight"
BEHAVIOR_MEAN = "behavior_mean"
BEHAVIOR_SIGMA = "behavior_sigma"
BEHAVIOR = (BEHAVIOR_MEAN, BEHAVIOR_SIGMA)


def bootstrap_target(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    *,
    gamma: float,
    steps: Tensor | None = None,
) -> Tensor:
    r"""Target :math:`y_i = r_i + \gamma^{n_i} Q'(s_{i+n_i}, \mu'(s_{i+n_i}))`, Eq. (5) for n = 1.

    The paper leaves out that nothing follows an end, and prints the current critic's parameters
    where the target critic's are meant.

    Args:
        reward: :math:`r_i`, discounted and summed over the steps, shape ``[B]``.
        next_value: Q of the target networks at the next state, shape ``[B]``.
        terminated: True, or 1, at the end of an episode; a time limit is no end, shape ``[B]``.
        gamma: Discount.
        steps: Steps :math:`n_i` to the next state, shape ``[B]``; None: one.

    Returns:
        Targets, shape ``[B]``.

    Examples:
        >>> end = torch.tensor([False, True])
        >>> bootstrap_target(torch.ones(2), torch.ones(2), end, gamma=0.5).tolist()
        [1.5, 1.0]
        >>> three = torch.tensor([3, 3])
        >>> bootstrap_target(torch.ones(2), torch.ones(2), end, gamma=0.5, steps=three).tolist()
        [1.125, 1.0]
    """
    discount = gamma if steps is None else gamma**steps
    # Of integers ~ would turn over the bits.
    return reward + discount * next_value * ~as_mask("'terminated' of the next step", terminated)


def target_of(
    batch: TensorDictBase, next_value: Tensor, *, gamma: float, reward_scale: float = 1.0
) -> Tensor:
    """Compute the targets of a batch (Eq. 5), ``[B]``; of several steps if it has their number."""
    after, steps = batch["next"], batch.get("steps_to_next_obs", None)
    return bootstrap_target(
        (after["reward"] * reward_scale).reshape(next_value.shape),
        next_value,
        after["terminated"].reshape(next_value.shape),
        gamma=gamma,
        steps=None if steps is None else steps.reshape(next_value.shape),
    )


def smoothing_noise(action: Tensor, *, deviation: float, limit: float) -> Tensor:
    r"""Sample TD3's noise for actions ``[B, A]``, :math:`\mathrm{clip}(N(0, \sigma), -c, c)`."""
    return torch.randn_like(action).mul_(deviation).clamp_(-limit, limit)


def smoothed_action(action: Tensor, noise: Tensor, *, low: Tensor, high: Tensor) -> Tensor:
    """Add noise to TD3's target action, within the bounds, shape ``[B, A]``."""
    return torch.clamp(action + noise, low, high)


def least_value(values: Tensor) -> Tensor:
    r"""Value in TD3's clipped double-Q target, :math:`\min_k Q_k`, from ``[C, B]`` to ``[B]``."""
    return values.amin(0)


def soft_value(values: Tensor, log_density: Tensor, *, alpha: float | Tensor) -> Tensor:
    r"""Value in SAC's target and actor's loss, :math:`\min_k Q_k(s, a) - \alpha \ln \pi(a | s)`."""
    return least_value(values) - alpha * log_density


def critic_loss(
    value: Tensor,
    target: Tensor,
    loss_function: str,
    *,
    unit: float,
    pal_alpha: float,
) -> Tensor:
    """Compute each transition's loss (Eq. 4), summed over critics, from ``[C, B]`` to ``[B]``."""
    target = target.expand_as(value)
    return distance(value, target, loss_function, unit=unit, pal_alpha=pal_alpha).sum(0)


def distance(
    value: Tensor,
    target: Tensor,
    loss_function: str,
    *,
    unit: float = 1.0,
    pal_alpha: float = 0.4,
) -> Tensor:
    """Distance of value and target, ``[C, B]`` or ``[B]``, one of :data:`DISTANCES`.

    ``"l2"`` is Eq. (4), ``"smooth_l1"`` the Huber loss of LAP. This and PAL bend at an error of
    ``unit``: the factor of the rewards in a loss that scales them, so that they bend at an error
    of one in units of the environment's reward.
    """
    if loss_function not in DISTANCES:
        raise ValueError(f"loss_function must be one of {DISTANCES}, got {loss_function!r}")
    if loss_function == PAL:
        return pal_distance((target - value) / unit, alpha=pal_alpha) * unit**2
    if loss_function == "smooth_l1":
        error = (target - value) / unit
        bent = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
        return bent * unit**2
    found: Tensor = distance_loss(value, target, loss_function)
    return found


def pal_distance(error: Tensor, *, alpha: float = 0.4) -> Tensor:
    r"""Loss whose expected gradient under uniform sampling equals that of LAP.

    .. math::

        \frac{1}{\lambda} \begin{cases} \tfrac12 \delta^2 & |\delta| \le 1 \\
        \frac{|\delta|^{1 + \alpha}}{1 + \alpha} & \text{else} \end{cases} \qquad
        \lambda = \frac1B \sum_j \max(|\delta_j|, 1)^\alpha

    with the largest error of several critics in :math:`\lambda`. Fujimoto et al. (2020),
    https://arxiv.org/abs/2007.06049.
    """
    size = error.abs()
    # A power with a fractional exponent has no finite slope at zero, where it is not wanted.
    far = size.clamp_min(1.0).pow(1.0 + alpha) / (1.0 + alpha)
    loss = torch.where(size <= 1.0, 0.5 * size.square(), far)
    largest = size.detach() if error.ndim == 1 else size.detach().amax(0)
    return loss / largest.clamp_min(1.0).pow(alpha).mean()


def quantile_loss(quantiles: Tensor, target: Tensor) -> Tensor:
    r"""Loss of quantile regression, :math:`\frac1N \sum_k u_k (\tau_k - 1[u_k < 0])`.

    With :math:`u_k = y - \theta_k` and :math:`\tau_k = (k - \frac12) / N`, Dabney et al. (2018),
    https://arxiv.org/abs/1710.10044; from ``[B, N]`` and ``[B]`` to ``[B]``.
    """
    count = quantiles.shape[-1]
    middle = (torch.arange(count, device=quantiles.device) + 0.5) / count
    error = target.unsqueeze(-1) - quantiles
    return torch.maximum(middle * error, (middle - 1.0) * error).mean(-1)


def saturation(preactivation: Tensor, *, limit: float) -> Tensor:
    r"""Depth of actions in the flat ends of the tanh, the mean of :math:`\max(0, |u| - l)^2`."""
    return (preactivation.abs() - limit).clamp_min(0).square().mean()


def action_gradient(value: Tensor, action: Tensor) -> Tensor:
    r"""Gradient of each transition's Q by its own action, :math:`\nabla_a Q(s_i, a_i)` (Eq. 14).

    The gradient of the sum has them all at once, as no transition enters another one's value;
    layers that mix a batch (batch normalization) would break that.
    """
    (gradient,) = torch.autograd.grad(
        value, action, grad_outputs=torch.ones_like(value), retain_graph=True
    )
    return gradient.detach()


def read_choices(action: Tensor, count: int, batch: TensorDictBase) -> Tensor:
    """Read the numbers of actions among ``K``, shape ``[B]``, given one-hot or as numbers.

    Args:
        action: One-hot, ``[B, K]``, or numbers, ``[B]`` or ``[B, 1]``.
        count: ``K``.
        batch: The batch that has them.

    Returns:
        The numbers.

    Raises:
        ValueError: If the actions have neither form.

    Examples:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({}, [2])
        >>> read_choices(torch.eye(3)[[2, 0]], 3, batch).tolist()
        [2, 0]
        >>> read_choices(torch.tensor([[2], [0]]), 3, batch).tolist()
        [2, 0]
    """
    form = tuple(action.shape[batch.ndim :])
    if form == (count,):
        # One number is not zero, and it is one.
        if bool((action.count_nonzero(-1) == 1).all() & (action.sum(-1) == 1).all()):
            return action.float().argmax(-1)
    elif form in ((), (1,)) and action.dtype is not torch.bool:
        number = action.reshape(batch.shape)
        if bool(((number >= 0) & (number < count) & (number == number.long())).all()):
            return number.long()
    raise ValueError(
        f"action must be one-hot among {count}, shape {[*batch.shape, count]}, or the number of "
        f"one, shape {[*batch.shape, 1]}, got {action.dtype} of shape {[*action.shape]}"
        + (
            ""
            if form not in ((count,), (), (1,))
            else f": {action.reshape(-1)[: 2 * count].tolist()}"
        )
    )


class Trust(NamedTuple):
    """Weights of ReF-ER, which hold the actor near the behavior policy."""

    policy: Tensor
    """Weight of the actor's loss, shape ``[B]``."""
    behavior: Tensor
    """Weight of the divergence from the behavior, shape ``[B]``."""
    mean: Tensor
    """Mean of the behavior's actions, shape ``[B, A]``."""
    sigma: Tensor
    """Their standard deviation, shape ``[B, 1]``."""


def read_trust(batch: TensorDictBase) -> Trust | None:
    """Read the weights of ReF-ER; None if a batch has none, and the actor is free."""
    if batch.get(POLICY_WEIGHT, None) is None:
        return None
    policy, behavior = batch[POLICY_WEIGHT].reshape(-1), batch[BEHAVIOR_WEIGHT].reshape(-1)
    return Trust(policy, behavior, batch[BEHAVIOR_MEAN], batch[BEHAVIOR_SIGMA])


def trusted_loss(loss: Tensor, action: Tensor, trust: Trust | None) -> Tensor:
    r"""Loss of the actor with the divergence from the behavior, shape ``[B]``.

    .. math::

        w_i L_i + v_i \sum_a \frac{(a_i - \mu_i)^2}{2 \sigma_i^2}

    The second term is the divergence of two Gaussians of one width, around the actor's action and
    around the behavior's mean.
    """
    if trust is None:
        return loss
    distance = ((action - trust.mean) / trust.sigma).square().sum(-1) / 2
    found: Tensor = trust.policy * loss + trust.behavior * distance
    return found
