"""TD3 loss that writes the signals of each transition, as the DDPG loss does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import TD3Loss, ValueEstimators

from torchrl_mpfa.checks import NOT_NEGATIVE, SHARE, check
from torchrl_mpfa.losses.base import SignalKeys, SignalLoss
from torchrl_mpfa.losses.functional import (
    estimated_target,
    least_value,
    smoothed_action,
    smoothing_noise,
)
from torchrl_mpfa.networks.bounds import given_bounds


class SignalTD3Loss(SignalLoss, TD3Loss):
    r""":class:`~torchrl.objectives.TD3Loss` that also writes the signals of Eqs. (13)-(14).

    The signal of Eq. (13) is the larger TD error of the two critics, as in TorchRL's own
    ``"td_error"``; the gradient is that of the first critic, by which the actor learns.

    Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477

    Further arguments and errors: see :class:`~torchrl_mpfa.losses.SignalLoss`.

    Args:
        actor_network: Policy.
        qvalue_network: Critic, of which two are made.
        action_spec: Bounded spec of the actions, such as ``env.action_spec``.
        bounds: Least and greatest action, numbers or tensors of shape ``[A]``. Either the spec or
            the bounds must be given.
        **kwargs: Further arguments, such as TorchRL's ``policy_noise`` and ``noise_clip``, in units
            of the action.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> loss = SignalTD3Loss(make_actor(24, 2), make_critic(24, 2), bounds=(-1.0, 1.0))
        >>> loss.num_qvalue_nets
        2
    """

    @dataclass
    class _AcceptedKeys(SignalKeys, TD3Loss._AcceptedKeys):
        """Keys of TorchRL's loss and of :class:`~torchrl_mpfa.losses.base.SignalKeys`."""

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    policy_delay = 2
    min_action: Tensor
    max_action: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        action_spec: Any = None,
        bounds: Any = None,
        **kwargs: Any,
    ) -> None:
        within = given_bounds(action_spec, bounds)
        noise = {name: kwargs.get(name, 0.0) for name in ("policy_noise", "noise_clip")}
        check(NOT_NEGATIVE, **noise)
        super().__init__(actor_network, qvalue_network, bounds=within, **kwargs)

    def value_loss(
        self,
        tensordict: TensorDictBase,
        *,
        defer_gradient: bool = False,
        loss_function: str | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Add up the critics' losses; write the signals as :meth:`SignalDDPGLoss.loss_value`."""
        networks, keys, estimator = self._networks(), self.tensor_keys, self.value_estimator
        stored, after = self._stored(tensordict), self._states(tensordict["next"])
        value = self._values(stored)
        with torch.no_grad():
            action = networks.target_actor.outputs(after)[keys.action]
            noise = smoothing_noise(action, deviation=self.policy_noise, limit=self.noise_clip)
            action = smoothed_action(action, noise, low=self.min_action, high=self.max_action)
            found = [q.outputs({**after, keys.action: action}) for q in networks.target_critics]
            values = [each[keys.state_action_value].squeeze(-1) for each in found]
            next_value = least_value(torch.stack(values))
            target = estimated_target(  # Eq. (5)
                tensordict, next_value, estimator, keys, reward_scale=self.reward_scale
            )
        loss = self._critic_mean(tensordict, value, target, loss_function)  # Eqs. (4), (11)
        td_error = (target - value).detach()
        action = stored[keys.action]
        self._write_signals(tensordict, value, td_error, action, defer_gradient)  # Eqs. (13), (14)
        metadata = {
            "td_error": td_error.square(),
            "next_state_value": next_value,
            "pred_value": value.detach(),
            "target_value": target,
        }
        return loss, metadata

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss by the first critic, as :meth:`SignalDDPGLoss.loss_actor`."""
        networks, states = self._networks(), self._states(tensordict)
        chosen = networks.actor.outputs(states)
        found = networks.frozen_critics[0].outputs({**states, **chosen})
        value = found[self.tensor_keys.state_action_value].squeeze(-1)
        loss, log = self._actor_mean(tensordict, -value, chosen)
        return loss, {"state_action_value_actor": value.detach(), **log}

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        return self.value_loss(batch, **options)

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        loss, log = self.actor_loss(batch)
        return {"loss_actor": loss}, log


def make_td3_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    gamma: float = 0.99,
    loss_function: str = "l2",
    **kwargs: Any,
) -> SignalTD3Loss:
    """Make a :class:`SignalTD3Loss` with one-step targets and the squared error of Eq. (11).

    Args:
        actor: Policy.
        critic: Critic, of which two are made, the second with new weights.
        gamma: Discount, in [0, 1].
        loss_function: Distance of value and target. TorchRL's own default is smoothed.
        **kwargs: Arguments of :class:`SignalTD3Loss`, with ``action_spec`` or ``bounds``.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> spec = Bounded(low=-2.0, high=2.0, shape=(1,))
        >>> loss = make_td3_loss(
        ...     make_actor(3, 1, action_spec=spec), make_critic(3, 1), action_spec=spec
        ... )
        >>> loss.max_action.item()
        2.0
    """
    gamma = check(SHARE, gamma=gamma)
    loss = SignalTD3Loss(actor, critic, loss_function=loss_function, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
