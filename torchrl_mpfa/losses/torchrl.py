"""Signals of a batch from TorchRL's own losses."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import (
    CQLLoss,
    CrossQLoss,
    DDPGLoss,
    DiscreteCQLLoss,
    DiscreteIQLLoss,
    DiscreteSACLoss,
    DistributionalDQNLoss,
    DQNLoss,
    IQLLoss,
    LossModule,
    REDQLoss,
    SACLoss,
    TD3BCLoss,
    TD3Loss,
)

from torchrl_mpfa.losses.functional import action_gradient
from torchrl_mpfa.priorities import action_gradient_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR
from torchrl_mpfa.storages.schema import as_path

_SQUARED = (DDPGLoss, TD3Loss, TD3BCLoss, REDQLoss, IQLLoss, CQLLoss, DQNLoss, DiscreteCQLLoss)
"""Losses that write the square of the TD error."""
_ABSOLUTE = (SACLoss, CrossQLoss, DiscreteSACLoss, DistributionalDQNLoss)
"""Losses that write the absolute TD error; the distributional one a cross entropy in its place."""
SUPPORTED = (*_SQUARED, *_ABSOLUTE)


def write_signals(batch: TensorDictBase, loss: LossModule, *, order: float = 2.0) -> None:
    r"""Write the signals of Eqs. (13)-(14) in a batch that one of TorchRL's losses was called with.

    The TD error is the largest of the critics, as TorchRL writes it. The slope is that of the first
    critic in its evaluation mode, of quantiles that of their mean. The slope takes a forward and a
    backward pass of its own: call this before the step of the optimizer, by which the critic would
    be another one.

    Args:
        batch: Transitions, batch size ``[B]``, that ``loss(batch)`` was called with; gets
            ``("signals", "td_error")`` and ``("signals", "action_gradient")``, each ``[B]``; of
            ``N`` agents ``[B, N]``.
        loss: ``DDPGLoss``, ``TD3Loss``, ``TD3BCLoss``, ``SACLoss``, ``REDQLoss``, ``CrossQLoss``,
            ``IQLLoss``, ``CQLLoss`` or ``TQCLoss``; or ``DQNLoss``, ``DistributionalDQNLoss``,
            ``DiscreteSACLoss``, ``DiscreteIQLLoss`` or ``DiscreteCQLLoss``, which have a TD error
            alone.
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
    if not isinstance(loss, SUPPORTED):
        raise TypeError(
            f"loss must be one of TorchRL's with a critic of actions, such as DDPGLoss, got "
            f"{type(loss).__name__}: write batch['signals', 'td_error'] yourself"
        )
    key = loss.tensor_keys.priority
    error = batch.get(key, None)
    if error is None:
        raise KeyError(
            f"{key!r} is missing in the batch: call loss(batch) first. A part of a loss, such as "
            "value_loss of TD3Loss, may return the error and not write it"
        )
    error = error.detach().reshape(len(batch), -1).squeeze(1)
    # SAC with a network of state values writes the square, too.
    squared = isinstance(loss, _SQUARED) or (
        isinstance(loss, SACLoss) and "loss_value" in loss.out_keys
    )
    batch.set(TD_ERROR.key, error.sqrt() if squared else error.abs())
    if hasattr(loss.tensor_keys, "state_action_value") and not isinstance(loss, DiscreteIQLLoss):
        slope = action_gradient(*_value_of_action(batch, loss))
        batch.set(ACTION_GRADIENT.key, action_gradient_priority(slope, order=order))


def _value_of_action(batch: TensorDictBase, loss: Any) -> tuple[Tensor, Tensor]:
    """Return Q of the stored actions by the first critic, ``[B]``, and the actions ``[B, A]``.

    Of ``N`` agents ``[B, N]`` and ``[B, N, A]``.
    """
    name = "value_network" if isinstance(loss, DDPGLoss) else "qvalue_network"
    critic, weights = getattr(loss, name), getattr(loss, f"{name}_params")
    if name == "qvalue_network":
        weights = weights[0]
    keys = loss.tensor_keys
    # TorchRL's DDPG has no name for the action.
    key = getattr(keys, "action", None)
    if key is None:
        key = next(key for key in critic.in_keys if as_path(key)[-1] == "action")
    inputs = batch.select(*critic.in_keys).detach()
    action = inputs[key].clone().requires_grad_()
    # Batch normalization counts, and dropout samples, in training alone.
    in_training = [module for module in critic.modules() if module.training]
    critic.eval()
    with torch.enable_grad(), weights.detach().to_module(critic):
        value: Tensor = critic(inputs.set(key, action))[keys.state_action_value]
    for module in in_training:
        module.training = True
    return value.mean(-1) if value.ndim == action.ndim else value, action
