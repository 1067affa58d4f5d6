"""What the losses with several critics, whose least value is the target's, share."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_mpfa.losses.base import SignalLoss
from torchrl_mpfa.losses.calling import Tensors, bind, read_inputs


class TwinCritics(SignalLoss):
    """The loss of stacked critics, of which the largest error counts and the first one's slope.

    Mixed into a :class:`~torchrl.objectives.LossModule` with ``qvalue_network``; options: see
    :class:`~torchrl_mpfa.losses.SignalLoss`.
    """

    qvalue_network: Any
    num_qvalue_nets: int
    _critic_name = "qvalue_network"

    def value_loss(
        self,
        tensordict: TensorDictBase,
        *,
        defer_gradient: bool = False,
        loss_function: str | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Sum of the critics' losses; writes the signals (Eqs. 13-14) in ``tensordict``.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.
            defer_gradient: As in :meth:`SignalDDPGLoss.loss_value`.
            loss_function: As there.

        Returns:
            The loss, and detached values for the log.
        """
        step = self._critic_step(
            tensordict, defer_gradient=defer_gradient, loss_function=loss_function
        )
        metadata = {
            "td_error": step.td_error.square(),
            "next_state_value": step.next_value,
            "pred_value": step.value.detach(),
            "target_value": step.target,
        }
        return step.loss, metadata

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        return self.value_loss(batch, **options)

    def _values(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        critics, key = self._networks().critics, self.tensor_keys.action
        actions = [action] + [action.detach()] * (self.num_qvalue_nets - 1)
        found = critics.call([read_inputs(critics.network, tensordict, {key: a}) for a in actions])
        key = self.tensor_keys.state_action_value
        return torch.stack([out[key].squeeze(-1) for out in found])

    def _target_values(self, after: TensorDictBase, chosen: Tensors) -> Tensor:
        """Q of the target critics at the next state, shape ``[C, B]``."""
        critics = self._networks().target_critics
        return torch.stack([self._value(critic, after, chosen) for critic in critics])

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        each = getattr(self, f"{prefix}qvalue_network_params").detach().unbind(0)
        return [bind(self.qvalue_network, params).requires_grad_(False) for params in each]
