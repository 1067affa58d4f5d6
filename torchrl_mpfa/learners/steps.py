r"""One step of an optimizer as arithmetic on vectors, for Adam and RAdam alike.

With the mean :math:`m` and the mean square :math:`v` of the gradients both take the step

.. math:: \theta \leftarrow \theta - m \left( \frac{a}{\sqrt v + \epsilon} + c \right)

with numbers :math:`a, \epsilon, c` that depend on the count of steps alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Step(NamedTuple):
    """Numbers of a step, each a number or a tensor of shape ``[]``."""

    near: Any
    r""":math:`a`, of the part that is divided by the root of the mean square."""
    eps: Any
    flat: Any
    r""":math:`c`, of the part that is not divided."""
    decay: Any
    """L2 decay, added to the gradient."""
    share: Any
    """Share of the new gradient in the mean, one less the first beta."""
    kept: Any
    """The second beta."""


def adam_step(group: Mapping[str, Any], count: int) -> Step:
    """Numbers of a step of Adam (Kingma and Ba 2015).

    Args:
        group: Settings of the optimizer for these parameters.
        count: Which step it is, counted from 1.

    Returns:
        The numbers.
    """
    beta, kept = group["betas"]
    root = math.sqrt(1.0 - kept**count)
    near = group["lr"] * root / (1.0 - beta**count)
    return Step(near, group["eps"] * root, 0.0, group["weight_decay"], 1.0 - beta, kept)


def radam_step(group: Mapping[str, Any], count: int) -> Step:
    """Numbers of a step of RAdam (Liu et al. 2020): flat until the variance can be rectified.

    Args:
        group: Settings of the optimizer for these parameters.
        count: Which step it is, counted from 1.

    Returns:
        The numbers.
    """
    beta, kept = group["betas"]
    size = group["lr"] / (1.0 - beta**count)
    longest = 2.0 / (1.0 - kept) - 1.0
    length = longest - 2.0 * count * kept**count / (1.0 - kept**count)
    rest = group["weight_decay"], 1.0 - beta, kept
    if length <= 5.0:
        return Step(0.0, group["eps"], size, *rest)
    rectified = (length - 4.0) * (length - 2.0) * longest
    rectified /= (longest - 4.0) * (longest - 2.0) * length
    near = size * math.sqrt(rectified) * math.sqrt(1.0 - kept**count)
    return Step(near, group["eps"], 0.0, *rest)


STEPS = {torch.optim.Adam: adam_step, torch.optim.RAdam: radam_step}
"""The numbers of a step by the kind of the optimizer."""


class Moved(NamedTuple):
    """Parameters after a step, and the moments of their gradients, each of shape ``[P]``."""

    weights: Tensor
    mean: Tensor
    square: Tensor


def move(weights: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, step: Step) -> Moved:
    """Take a step.

    Args:
        weights: Parameters, shape ``[P]``.
        gradient: Their gradients, shape ``[P]``.
        mean: Mean of the gradients before, shape ``[P]``.
        square: Mean square of the gradients before, shape ``[P]``.
        step: The numbers of this step.

    Returns:
        What all three are after it.

    Examples:
        >>> step = Step(near=1.0, eps=0.0, flat=0.0, decay=0.0, share=0.1, kept=0.99)
        >>> zero = torch.zeros(1)
        >>> move(zero, torch.ones(1), zero, zero, step).weights
        tensor([-1.])
    """
    gradient = gradient + step.decay * weights
    mean = mean + step.share * (gradient - mean)
    square = step.kept * square + (1.0 - step.kept) * gradient.square()
    slope = step.near / (square.sqrt() + step.eps) + step.flat
    return Moved(weights - mean * slope, mean, square)
