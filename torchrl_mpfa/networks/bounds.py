"""Bounds of actions, from the action spec of an environment to the last layer of a policy."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec

from torchrl_mpfa.checks import POSITIVE, check


def action_bounds(action_spec: TensorSpec, action_size: int | None = None) -> tuple[Tensor, Tensor]:
    """Return the bounds of a spec, or of the one bounded entry in a composite, each ``[A]``.

    Examples:
        >>> low, high = action_bounds(Bounded(low=-2.0, high=2.0, shape=(1,)), 1)
        >>> low.tolist(), high.tolist()
        ([-2.0], [2.0])
    """
    if isinstance(action_spec, Composite):
        leaves = list(action_spec.values(include_nested=True, leaves_only=True))
        if len(leaves) != 1:
            raise ValueError(f"action_spec must have one entry, got {len(leaves)}: {action_spec}")
        (action_spec,) = leaves
    if not isinstance(action_spec, Bounded):
        raise ValueError(f"action_spec must be Bounded, got {type(action_spec).__name__}")
    low, high = action_spec.space.low, action_spec.space.high
    if not low.is_floating_point():
        raise ValueError(f"action_spec must be of real numbers, got {action_spec.dtype}")
    if low.ndim == 0 or low.shape[-1] != (action_size or low.shape[-1]):
        raise ValueError(
            f"action_spec must have action_size = {action_size} entries in its last dimension, "
            f"got shape {tuple(action_spec.shape)}"
        )
    rows = [bound.reshape(-1, low.shape[-1]) for bound in (low, high)]
    if not all(bool((row == row[:1]).all()) for row in rows):
        raise ValueError("action_spec must have the same bounds for all environments of a batch")
    low, high = (row[0].float().clone() for row in rows)
    return _checked("action_spec must have finite bounds", low, high)


def given_bounds(bounds: Any) -> tuple[Tensor, Tensor]:
    """Return the least and greatest action of a bounded spec, or of a pair of both."""
    if isinstance(bounds, TensorSpec):
        return action_bounds(bounds)
    if bounds is None:
        raise ValueError("bounds must be an action spec, or least and greatest action, got None")
    return _checked("bounds must be finite", *map(torch.as_tensor, bounds))


def _checked(wanted: str, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return bounds that are finite and in order."""
    if not bool((low.isfinite() & high.isfinite() & (low < high)).all()):
        raise ValueError(f"{wanted}, low < high, got {low.tolist()} and {high.tolist()}")
    return low, high


class ActionScale(nn.Module):
    r"""Map from [-1, 1] to the bounds of actions ``[A]``, :math:`a = c + h \tanh u`.

    With a saturation limit :math:`l` actions reach their bounds at :math:`|u| = l`, not in
    infinity: :math:`a = \mathrm{clip}(c + h \tanh u / \tanh l)`.

    Examples:
        >>> scale = ActionScale(torch.tensor([0.0]), torch.tensor([10.0]))
        >>> scale(torch.tensor([[-1.0], [0.0], [1.0]])).flatten().tolist()
        [0.0, 5.0, 10.0]
        >>> reached = ActionScale(-torch.ones(1), torch.ones(1), saturation_limit=1.5)
        >>> reached(torch.tensor([1.0, 1.5, 2.0]).tanh()).tolist()[1:]
        [1.0, 1.0]
    """

    center: Tensor
    half_width: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor, *, saturation_limit: float | None = None) -> None:
        super().__init__()
        self.clips = saturation_limit is not None
        reached = 1.0
        if saturation_limit is not None:
            reached = math.tanh(check(POSITIVE, saturation_limit=saturation_limit))
            self.register_buffer("low", low)
            self.register_buffer("high", high)
        self.register_buffer("center", (high + low) / 2)
        self.register_buffer("half_width", (high - low) / (2 * reached))

    def forward(self, action: Tensor) -> Tensor:
        """Map [-1, 1] to the bounds, each of shape ``[..., A]``."""
        scaled = torch.addcmul(self.center, self.half_width, action)
        return scaled.clamp(self.low, self.high) if self.clips else scaled


def action_scale(
    action_spec: TensorSpec | None, action_size: int, *, saturation_limit: float | None = None
) -> ActionScale | None:
    """Make the layer after a policy's tanh; None if actions are the tanh itself."""
    one = torch.ones(action_size)
    low, high = (-one, one) if action_spec is None else action_bounds(action_spec, action_size)
    if saturation_limit is None and bool((low == -1.0).all() and (high == 1.0).all()):
        return None
    return ActionScale(low, high, saturation_limit=saturation_limit)
