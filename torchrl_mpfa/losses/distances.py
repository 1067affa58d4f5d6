r"""Distances between a value and its target that a critic's loss can have.

``"l2"`` is Eq. (4) of the paper, ``"smooth_l1"`` the Huber loss of LAP, ``"pal"`` that of
Fujimoto et al. (2020), "An equivalence between loss functions and non-uniform sampling in
experience replay", https://arxiv.org/abs/2007.06049.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.objectives.utils import distance_loss

PAL = "pal"
DISTANCES = ("l1", "l2", "smooth_l1", PAL)


def pal_distance(error: Tensor, *, alpha: float = 0.4) -> Tensor:
    r"""Loss of which uniform sampling expects the gradient that LAP has.

    .. math::

        \frac{1}{\lambda} \begin{cases} \tfrac12 \delta^2 & |\delta| \le 1 \\
        \frac{|\delta|^{1 + \alpha}}{1 + \alpha} & \text{else} \end{cases} \qquad
        \lambda = \frac1B \sum_j \max(|\delta_j|, 1)^\alpha

    Args:
        error: TD errors, shape ``[..., B]``; of several critics the largest one is in
            :math:`\lambda`.
        alpha: Priority exponent :math:`\alpha` of the sampling that it stands for.

    Returns:
        Loss of each transition, shape ``[..., B]``.

    Examples:
        >>> pal_distance(torch.tensor([0.5, -0.5])).tolist()
        [0.125, 0.125]
    """
    size = error.abs()
    # A power with a fractional exponent has no finite slope at zero, where it is not wanted.
    far = size.clamp_min(1.0).pow(1.0 + alpha) / (1.0 + alpha)
    loss = torch.where(size <= 1.0, 0.5 * size.square(), far)
    largest = size.detach().reshape(-1, size.shape[-1]).amax(0)
    return loss / largest.clamp_min(1.0).pow(alpha).mean()


def distance(value: Tensor, target: Tensor, loss_function: str, *, unit: float = 1.0) -> Tensor:
    """Loss of each transition by the name of its distance.

    Args:
        value: Q, shape ``[..., B]``.
        target: Targets, of the same shape.
        loss_function: ``"l1"``, ``"l2"``, ``"smooth_l1"`` or ``"pal"``.
        unit: Error at which the last two bend. A loss whose rewards are scaled gives its factor
            here, so that they bend at an error of one in units of the environment's reward.

    Returns:
        Loss, shape ``[..., B]``.

    Raises:
        ValueError: If the name is unknown.
    """
    if loss_function not in DISTANCES:
        raise ValueError(f"loss_function must be one of {DISTANCES}, got {loss_function!r}")
    if loss_function == PAL:
        return pal_distance((target - value) / unit) * unit**2
    if loss_function == "smooth_l1":
        return torch.nn.functional.huber_loss(value, target, reduction="none", delta=unit)
    found: Tensor = distance_loss(value, target, loss_function)
    return found
