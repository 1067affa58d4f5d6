r"""Priorities of single transitions: the signals of Eqs. (12)-(14), and PER's Eqs. (8)-(10).

Pure functions, tensors in and tensors out, one equation each. Equation numbers are those of
Cheng et al. (2023), "Prioritized experience replay in path planning via multi-dimensional
transition priority fusion", https://doi.org/10.3389/fnbot.2023.1281166; the notation of the
whole paper is tabled in :mod:`torchrl_mpfa.fusion`.

Shapes: ``N`` transitions in the buffer, ``B`` in a batch, ``A`` action dimensions.
"""

from __future__ import annotations

import torch
from torch import Tensor


def reward_priority(reward: Tensor) -> Tensor:
    r"""Priority by immediate reward, :math:`p_i^r = |r_i|` (Eq. 12).

    Args:
        reward: Rewards :math:`r_i`, shape ``[B]``.

    Returns:
        Non-negative priorities, shape ``[B]``.

    Examples:
        >>> reward_priority(torch.tensor([10.0, -5.0])).tolist()
        [10.0, 5.0]
    """
    return reward.abs()


def td_error_priority(td_error: Tensor) -> Tensor:
    r"""Priority by temporal-difference error, :math:`p_i^{TD} = |\delta_i|` (Eq. 13).

    Args:
        td_error: Differences :math:`\delta_i = y_i - Q(s_i, a_i)`, shape ``[B]``. TorchRL's own
            ``"td_error"`` entry is this *squared*: take its root first.

    Returns:
        Non-negative priorities, shape ``[B]``.

    Examples:
        >>> td_error_priority(torch.tensor([-0.5, 2.0])).tolist()
        [0.5, 2.0]
    """
    return td_error.abs()


def action_gradient_priority(action_gradient: Tensor, *, order: float = 2.0) -> Tensor:
    r"""Priority by the critic's slope, :math:`p_i^{loss} = |\nabla_a Q(s_i, a_i)|` (Eq. 14).

    The paper writes bars around a vector without naming a norm; the Euclidean one is our reading.

    Args:
        action_gradient: Gradients of Q by the action, shape ``[B, A]``.
        order: Order of the vector norm; 1 and ``inf`` are common alternatives.

    Returns:
        Non-negative priorities, shape ``[B]``.

    Raises:
        ValueError: If ``order`` is not positive.

    Examples:
        >>> action_gradient_priority(torch.tensor([[3.0, 4.0]])).tolist()
        [5.0]
    """
    if not order > 0:
        raise ValueError(f"order must be positive, got {order}")
    return torch.linalg.vector_norm(action_gradient, ord=order, dim=-1)


def information_gain_priority(
    td_error: Tensor, quantiles: Tensor, *, least_noise: float = 0.0
) -> Tensor:
    r"""Priority of UPER, :math:`p_i = \frac12 \ln(1 + E_i / A_i)`.

    How much a Gaussian estimate with the variance :math:`E_i` learns from one observation with
    noise of the variance :math:`A_i`. The mean square of the critics' errors is
    :math:`E_i = \bar\delta_i^2 + \mathrm{Var}_k\,\delta_{ik}`, the distance from the target and the
    disagreement of the critics; :math:`A_i` is the variance of the quantiles.

    Carrasco-Davis et al. (2025), https://arxiv.org/abs/2506.09270

    Args:
        td_error: Errors of each critic, shape ``[C, B]``.
        quantiles: Quantiles of the target, shape ``[B, K]``.
        least_noise: Least standard deviation that noise is taken to have, in the units of both.

    Returns:
        Non-negative priorities without a unit, shape ``[B]``.

    Examples:
        >>> quantiles = torch.tensor([[-1.0, 1.0], [-3.0, 3.0]])
        >>> gain = information_gain_priority(torch.tensor([[1.0, 3.0], [1.0, 3.0]]), quantiles)
        >>> [round(n, 3) for n in gain.tolist()]  # ln(1 + 1 / 1) / 2 and ln(1 + 9 / 9) / 2
        [0.347, 0.347]
    """
    epistemic = td_error.square().mean(0)
    aleatoric = quantiles.var(-1, correction=0).clamp_min(least_noise**2)
    return 0.5 * torch.log1p(epistemic / aleatoric)


def proportional_priority(td_error: Tensor, *, eps: float) -> Tensor:
    r"""Priority of plain PER, :math:`p_i = |\delta_i| + \epsilon` (Eq. 9).

    Args:
        td_error: Temporal-difference errors :math:`\delta_i`, shape ``[B]``.
        eps: The constant :math:`\epsilon` that gives every transition a chance to be sampled.

    Returns:
        Priorities, shape ``[B]``.

    Examples:
        >>> proportional_priority(torch.tensor([-1.0]), eps=0.5).tolist()
        [1.5]
    """
    return td_error_priority(td_error) + eps


def sampling_probabilities(priority: Tensor, *, alpha: float) -> Tensor:
    r"""Probability of each transition, :math:`P(i) = p_i^\alpha / \sum_k p_k^\alpha` (Eq. 8).

    The sampler samples by these with a segment tree; this is the same written out, for tests and
    figures.

    Args:
        priority: Priorities of the whole buffer, shape ``[N]``.
        alpha: Exponent :math:`\alpha`; 0 samples uniformly.

    Returns:
        Probabilities that sum to one, shape ``[N]``.

    Examples:
        >>> sampling_probabilities(torch.tensor([1.0, 3.0]), alpha=1.0).tolist()
        [0.25, 0.75]
    """
    scaled = priority.pow(alpha)
    return scaled / scaled.sum()


def importance_weights(
    probability: Tensor, *, beta: float, lowest: Tensor | float | None = None
) -> Tensor:
    r"""Importance weights, :math:`w_i = (N^{-1} P(i)^{-1})^\beta` over their maximum (Eq. 10).

    Read with ``N`` the buffer size, as in the PER paper: with the batch size in its place the
    weights of a full buffer would scale the loss by several hundred. Dividing by the largest
    weight of the buffer cancels ``N``, which leaves :math:`(P(i) / \min_k P(k))^{-\beta}`.

    Args:
        probability: :math:`P(i)` of the sampled transitions, up to a common factor, shape ``[B]``.
        beta: Exponent :math:`\beta`; 0 leaves the bias, 1 corrects it fully.
        lowest: Lowest :math:`P` in the buffer, up to the same factor; by default that of
            ``probability``.

    Returns:
        Weights in (0, 1], shape ``[B]``.

    Examples:
        >>> importance_weights(torch.tensor([0.25, 0.5]), beta=1.0).tolist()
        [1.0, 0.5]
    """
    if lowest is None:
        lowest = probability.min()
    return (probability / lowest).pow(-beta)
