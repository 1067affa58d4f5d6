"""Writing the signals of each transition in the batch that a loss was computed of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.losses.calling import Tensors, call, read_inputs
from torchrl_mpfa.losses.functional import action_gradient
from torchrl_mpfa.priorities import action_gradient_priority, td_error_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, SIGNALS_KEY, TD_ERROR

VALUE = "value"
"""Name of the signal that is Q itself, which may be negative."""
DEFAULT_SIGNALS = (TD_ERROR.name, ACTION_GRADIENT.name)
WRITTEN = (*DEFAULT_SIGNALS, VALUE)


@dataclass
class SignalKeys:
    """Keys that a loss of this package reads or writes beside those of TorchRL's loss."""

    action: NestedKey = "action"
    preactivation: NestedKey = "preactivation"
    td_error_signal: NestedKey = TD_ERROR.key
    action_gradient_signal: NestedKey = ACTION_GRADIENT.key
    value_signal: NestedKey = (SIGNALS_KEY, VALUE)
    bend: NestedKey = "bend"


class SignalWriting:
    """How a loss writes ``|TD error|`` (Eq. 13), the norm of the slope (Eq. 14), and Q."""

    tensor_keys: Any
    signals: tuple[str, ...]
    gradient_order: float
    reward_scale: float
    _deferred: tuple[Tensor, Tensor] | None
    """Actions and values whose gradients the backward pass of the loss will find."""

    def _networks(self) -> Any:
        """The networks with their parameters in place, held for good."""
        raise NotImplementedError

    def write_action_gradient(self, tensordict: TensorDictBase) -> None:
        r"""Write the signal of Eq. (14) that the critics' loss was asked to defer.

        A transition's action enters the loss through its own Q alone, so
        :math:`\nabla_a Q = \nabla_a L / (\partial L / \partial Q)`: the backward pass of the loss
        has found it on its way, and needs no other one before it.

        Args:
            tensordict: The batch that the loss was computed of; nothing happens if it deferred
                nothing.

        Raises:
            RuntimeError: If the loss was not differentiated.
        """
        if self._deferred is None:
            return
        (action, value), self._deferred = self._deferred, None
        if action.grad is None or value.grad is None:
            raise RuntimeError(
                "the action gradient was deferred: call backward() on the loss first"
            )
        slope = value.grad[0].unsqueeze(-1)
        gradient = action.grad / slope
        flat = slope == 0
        if bool(flat.any()):  # Where there is no error there is nothing to divide.
            gradient = torch.where(flat, self._gradient(tensordict, action), gradient)
        self._write_gradient(tensordict, gradient)

    def _write_signals(self, tensordict: TensorDictBase, td_error: Tensor, value: Tensor) -> None:
        """Write ``|TD error|`` (Eq. 13), the largest of the critics, and Q of the first."""
        if TD_ERROR.name in self.signals:
            size = td_error_priority(td_error).amax(0)
            tensordict.set(self.tensor_keys.td_error_signal, size / self.reward_scale)
        if VALUE in self.signals:
            tensordict.set(self.tensor_keys.value_signal, value[0].detach() / self.reward_scale)

    def _write_gradient(self, tensordict: TensorDictBase, gradient: Tensor) -> None:
        """Write the norm of the gradient of the first critic (Eq. 14)."""
        size = action_gradient_priority(gradient, order=self.gradient_order)
        tensordict.set(self.tensor_keys.action_gradient_signal, size / self.reward_scale)

    def _gradient(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Gradient of Q at these actions by a pass of its own, shape ``[B, A]``."""
        action = action.detach().requires_grad_(True)
        with torch.enable_grad():
            critic = self._networks().frozen_critic
            value = self._value(critic, tensordict, {self.tensor_keys.action: action})
            return action_gradient(value, action)

    def _value(self, critic: TensorDictModule, source: TensorDictBase, chosen: Tensors) -> Tensor:
        """Q of a critic, shape ``[B]``, at the observations of one and the actions of the other."""
        found = call(critic, read_inputs(critic, source, chosen))
        return found[self.tensor_keys.state_action_value].squeeze(-1)
