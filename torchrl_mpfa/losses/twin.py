"""What the losses with several critics, whose least value is the target's, share."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_mpfa.losses.calling import bind, read_inputs
from torchrl_mpfa.losses.distances import distance
from torchrl_mpfa.losses.options import SignalLossMixin


class TwinCriticsMixin(SignalLossMixin):
    """The loss of stacked critics, of which the larger error counts and the first one's slope.

    Mixed into a :class:`~torchrl.objectives.LossModule` with ``qvalue_network``; the options are
    documented at :class:`~torchrl_mpfa.SignalDDPGLoss`.
    """

    qvalue_network: Any
    qvalue_network_params: Any
    target_qvalue_network_params: Any
    num_qvalue_nets: int
    loss_function: str

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
        keys = self.tensor_keys
        at_stored = self._gradient_at_stored
        action = tensordict[keys.action].detach()
        with torch.set_grad_enabled(at_stored or torch.is_grad_enabled()):
            if at_stored:
                action.requires_grad_(True)  # A detached alias: the batch itself is not touched.
            values = self._values(tensordict, action)
        gradient = self._stored_gradient(tensordict, action, values[0], defer=defer_gradient)
        value = torch.stack(values)
        if not torch.is_grad_enabled():
            value = value.detach()

        target, next_value = self._target(tensordict)
        td_error = (target - value).detach()
        self._write_signals(tensordict, td_error.abs().amax(0), value[0], gradient)
        name = loss_function or self.loss_function
        loss = distance(value, target.expand_as(value), name, unit=self.reward_scale)
        loss = self._reduce(loss.sum(0), tensordict)
        metadata = {
            "td_error": td_error.square(),
            "next_state_value": next_value,
            "pred_value": value.detach(),
            "target_value": target,
        }
        return loss, metadata

    def _networks(self) -> Any:
        """The networks with their parameters in place, held for good."""
        raise NotImplementedError

    def _target(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Targets, and the values of the next state in them, each ``[B]``."""
        raise NotImplementedError

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        """The critics with the parameters whose name has this prefix."""
        each = getattr(self, f"{prefix}qvalue_network_params").detach().unbind(0)
        return [bind(self.qvalue_network, params).requires_grad_(False) for params in each]

    def _values(self, source: TensorDictBase, action: Tensor) -> list[Tensor]:
        """Q of the current critics, each of shape ``[B]``; the action leads to the first alone."""
        critics, key = self._networks().critics, self.tensor_keys.action
        actions = [action] + [action.detach()] * (self.num_qvalue_nets - 1)
        found = critics.call([read_inputs(critics.network, source, {key: a}) for a in actions])
        return [out[self.tensor_keys.state_action_value].squeeze(-1) for out in found]
