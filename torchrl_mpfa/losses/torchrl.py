"""Signals of a batch from TorchRL's own losses."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import (
    DDPGLoss,
    DiscreteSACLoss,
    DQNLoss,
    LossModule,
    SACLoss,
    TD3Loss,
    TQCLoss,
)

from torchrl_mpfa.losses.functional import action_gradient
from torchrl_mpfa.priorities import action_gradient_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

_SQUARED = (DDPGLoss, TD3Loss, DQNLoss)
"""Losses that write the square of the TD error."""
_CONTINUOUS = (DDPGLoss, TD3Loss, SACLoss)
"""Losses whose critic has a gradient by the action."""
SUPPORTED = (*_CONTINUOUS, DQNLoss, DiscreteSACLoss)


def write_signals(batch: TensorDictBase, loss: LossModule, *, order: float = 2.0) -> None:
    r"""Write the signals of Eqs. (13)-(14) in a batch that one of TorchRL's losses was called with.

    The TD error is the largest of the critics, as TorchRL writes it, and the slope that of the
    first critic. The slope takes a forward and a backward pass of its own: call this before the
    step of the optimizer, by which the critic would be another one.

    Args:
        batch: Transitions, batch size ``[B]``, that ``loss(batch)`` was called with; gets
            ``("signals", "td_error")`` and ``("signals", "action_gradient")``, each ``[B]``.
        loss: ``DDPGLoss``, ``TD3Loss`` or ``SACLoss``; or ``DQNLoss`` or ``DiscreteSACLoss``, which
            have a TD error alone.
        order: Order of the norm in Eq. (14).

    Raises:
        KeyError: If the loss was not called with the batch.
        TypeError: If the loss is another one.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> loss = DDPGLoss(make_actor(24, 2), make_critic(24, 2))
        >>> targets = SoftUpdate(loss, tau=0.01)
        >>> end = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.rand(8, 24), "reward": torch.rand(8, 1)}
        >>> after |= {"done": end, "terminated": end}
        >>> rows = {"observation": torch.rand(8, 24), "action": torch.rand(8, 2), "next": after}
        >>> batch = TensorDict(rows, [8])
        >>> _ = loss(batch)
        >>> write_signals(batch, loss)
        >>> sorted(batch["signals"].keys())
        ['action_gradient', 'td_error']
    """
    # The values of TQC are quantiles.
    if not isinstance(loss, SUPPORTED) or isinstance(loss, TQCLoss):
        raise TypeError(
            "loss must be TorchRL's DDPGLoss, TD3Loss, SACLoss, DQNLoss or DiscreteSACLoss, got "
            f"{type(loss).__name__}: write batch['signals', 'td_error'] yourself"
        )
    key = loss.tensor_keys.priority
    error = batch.get(key, None)
    if error is None:
        raise KeyError(f"{key!r} is missing in the batch: call loss(batch) first")
    error = error.detach().reshape(-1)
    # SAC with a network of state values writes the square, too.
    squared = isinstance(loss, _SQUARED) or (
        isinstance(loss, SACLoss) and "loss_value" in loss.out_keys
    )
    batch.set(TD_ERROR.key, error.sqrt() if squared else error.abs())
    if isinstance(loss, _CONTINUOUS):
        slope = action_gradient(*_value_of_action(batch, loss))
        batch.set(ACTION_GRADIENT.key, action_gradient_priority(slope, order=order))


def _value_of_action(batch: TensorDictBase, loss: Any) -> tuple[Tensor, Tensor]:
    """Return Q of the stored actions by the first critic, ``[B]``, and the actions ``[B, A]``."""
    name = "value_network" if isinstance(loss, DDPGLoss) else "qvalue_network"
    critic, weights = getattr(loss, name), getattr(loss, f"{name}_params")
    if name == "qvalue_network":
        weights = weights[0]
    keys = loss.tensor_keys
    # TorchRL's DDPG has no name for the action but that of the specification.
    key = getattr(keys, "action", "action")
    inputs = batch.select(*critic.in_keys).detach()
    action = inputs[key].clone().requires_grad_()
    with torch.enable_grad(), weights.detach().to_module(critic):
        value: Tensor = critic(inputs.set(key, action))[keys.state_action_value]
    return value.reshape(-1), action
