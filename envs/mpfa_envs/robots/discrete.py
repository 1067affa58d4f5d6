"""A few pairs of wheel speeds in place of all: for learners that value each action apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor
from torchrl.data import Composite, OneHot
from torchrl.envs import Transform

if TYPE_CHECKING:
    from tensordict import TensorDictBase

WheelPairs = Sequence[tuple[float, float]]

WHEEL_PAIRS: Final[tuple[tuple[float, float], ...]] = (
    (1.0, 1.0),
    (0.5, 1.0),
    (1.0, 0.5),
    (-0.25, 1.0),
    (1.0, -0.25),
    (-1.0, 1.0),
    (1.0, -1.0),
)
"""Speeds of the left and the right wheel, as actions in [-1, 1]: straight on at full speed, then
left and right in arcs that get tighter. A TurtleBot turns by 0, 0.49, 1.22 and 1.96 rad/s, at 0.5,
0.44, 0.36 and 0.28 m/s. The mirror image of each is among them."""


def check_pairs(pairs: WheelPairs) -> Tensor:
    """The pairs as a tensor, shape ``[K, 2]``."""
    found = torch.as_tensor(pairs, dtype=torch.float32)
    if found.ndim != 2 or found.shape[1] != 2 or len(found) < 2:
        raise ValueError(f"pairs must be two or more pairs of numbers, got {pairs!r}")
    if not bool((found.abs() <= 1.0).all()):
        raise ValueError(f"pairs must be in [-1, 1], got {pairs!r}")
    if len(found.unique(dim=0)) < len(found):
        raise ValueError(f"pairs must be different, got {pairs!r}")
    return found


def mirrored_places(pairs: WheelPairs) -> Tensor:
    """Index of each pair's mirror image, in which the wheels have changed places, ``[K]``."""
    speeds = check_pairs(pairs)
    same = (speeds.flip(1).unsqueeze(1) == speeds.unsqueeze(0)).all(-1)
    alone = (~same.any(1)).nonzero().flatten().tolist()
    if alone:
        raise ValueError(f"pairs must hold the mirror image of each, got none of {pairs[alone[0]]}")
    return same.long().argmax(1)


def read_choices(action: Tensor, count: int) -> Tensor:
    """Numbers of choices among ``K``, ``[...]``, of one-hot ones, ``[..., K]``, or ``[..., 1]``."""
    if action.shape[-1:] == (count,):
        # One number is not zero, and it is one.
        if bool((action.count_nonzero(-1) == 1).all() & (action.sum(-1) == 1).all()):
            return action.float().argmax(-1)
    elif action.shape[-1:] == (1,) and action.dtype is not torch.bool:
        number = action.squeeze(-1)
        if bool(((number >= 0) & (number < count) & (number == number.long())).all()):
            return number.long()
    raise ValueError(
        f"action must be one-hot, shape [..., {count}], or the number of one of {count} pairs, "
        f"shape [..., 1], got {action.dtype} of shape {[*action.shape]}: {action.tolist()}"
    )


class DiscreteWheels(Transform):
    """Makes the action of a navigation environment a choice among pairs of wheel speeds.

    The action of the transformed environment is one-hot, shape ``[..., K]``, which TorchRL's
    ``DQNLoss`` takes as it is. Its number does as well, shape ``[..., 1]`` or that of the batch;
    anything else is rejected.

    Args:
        pairs: The pairs, as actions of the environment, in [-1, 1].

    Raises:
        ValueError: If there are fewer than two, two are the same, or one is out of its range.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from mpfa_envs import DiscreteWheels, make_navigation_env
        >>> env = TransformedEnv(make_navigation_env("A", physics="kinematic"), DiscreteWheels())
        >>> rows = env.rollout(3, break_when_any_done=False)
        >>> env.action_spec.shape, rows["action"].sum(-1).tolist()
        (torch.Size([7]), [1, 1, 1])
        >>> env.close()
    """

    pairs: Tensor

    def __init__(self, pairs: WheelPairs = WHEEL_PAIRS) -> None:
        super().__init__(in_keys=[], out_keys=[], in_keys_inv=["action"], out_keys_inv=["action"])
        self.register_buffer("pairs", check_pairs(pairs), persistent=False)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        if action.ndim == tensordict.ndim:
            action = action.unsqueeze(-1)
        return tensordict.set("action", self._inv_apply_transform(action))

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        """From choices, shape ``[..., K]`` or ``[..., 1]``, to wheel speeds, ``[..., 2]``."""
        return self.pairs.to(action.device)[read_choices(action, len(self.pairs))]

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Put the choice in the place of the wheel speeds.

        Args:
            input_spec: Specs of the environment.

        Returns:
            Specs with the choice.
        """
        action = input_spec["full_action_spec", "action"]
        shape = (*action.shape[:-1], len(self.pairs))
        input_spec["full_action_spec", "action"] = OneHot(
            len(self.pairs), shape=shape, device=action.device, dtype=torch.long
        )
        return input_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave what was sampled from a buffer as it is: what is stored is the choice."""
        return tensordict
