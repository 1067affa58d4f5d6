"""TD3 loss that writes the signals of each transition, as the DDPG loss does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import TD3Loss, ValueEstimators

from torchrl_mpfa.losses.calling import Parts, StackedNetworks, bind, call, read_inputs
from torchrl_mpfa.losses.ddpg import bootstrap_target
from torchrl_mpfa.losses.options import (
    DEFAULT_SIGNALS,
    VALUE,
    GradientAt,
    Importance,
)
from torchrl_mpfa.losses.twin import TwinCriticsMixin
from torchrl_mpfa.signals import ACTION_GRADIENT, SIGNALS_KEY, TD_ERROR


class SignalTD3Loss(TwinCriticsMixin, TD3Loss):
    r""":class:`~torchrl.objectives.TD3Loss` that also writes the signals of Eqs. (13)-(14).

    Of its two critics' TD errors the larger one counts, as in TorchRL's own ``"td_error"``; the
    gradient is that of the first critic, the one that the actor climbs. Importance weights are
    used as in :class:`SignalDDPGLoss`.

    Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        qvalue_network: Critic, of which two are made; reads observations and action, writes
            ``"state_action_value"``.
        bounds: Least and greatest action.
        signals: As in :class:`SignalDDPGLoss`, as are the following.
        gradient_order: Order of the norm in Eq. (14).
        gradient_at: ``"stored"`` or ``"policy"``.
        importance: ``"critic"``, ``"torchrl"`` or ``"none"``.
        reward_scale: Factor of the rewards in the loss.
        saturation_penalty: Factor of the penalty on actions in the flat ends of the tanh.
        saturation_limit: Where these begin.
        target_average: As in :class:`SignalDDPGLoss`, of each of the target critics.
        **kwargs: Passed to :class:`~torchrl.objectives.TD3Loss`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> loss = make_td3_loss(make_actor(24, 2), make_critic(24, 2))
        >>> loss.num_qvalue_nets
        2
    """

    @dataclass
    class _AcceptedKeys(TD3Loss._AcceptedKeys):
        """Keys of TorchRL's loss, and those that this one reads or writes beside them."""

        preactivation: NestedKey = "preactivation"
        td_error_signal: NestedKey = TD_ERROR.key
        action_gradient_signal: NestedKey = ACTION_GRADIENT.key
        value_signal: NestedKey = (SIGNALS_KEY, VALUE)

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        bounds: tuple[float, float] | None = (-1.0, 1.0),
        signals: Sequence[str] = DEFAULT_SIGNALS,
        gradient_order: float = 2.0,
        gradient_at: GradientAt = "stored",
        importance: Importance = "critic",
        reward_scale: float = 1.0,
        saturation_penalty: float = 0.0,
        saturation_limit: float = 1.5,
        target_average: int = 1,
        **kwargs: Any,
    ) -> None:
        options = {
            "signals": signals,
            "gradient_order": gradient_order,
            "gradient_at": gradient_at,
            "importance": importance,
            "reward_scale": reward_scale,
            "saturation_penalty": saturation_penalty,
            "saturation_limit": saturation_limit,
            "target_average": target_average,
        }
        self._check_options(**options)  # type: ignore[arg-type]
        super().__init__(
            actor_network,
            qvalue_network,
            bounds=None if "action_spec" in kwargs else bounds,
            use_prioritized_weights="auto" if importance == "torchrl" else False,
            **kwargs,
        )
        self._set_options(**options)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Actor's loss by the first critic, with the penalty on saturation if there is one.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and detached values for the log.
        """
        networks = self._networks()
        chosen = call(networks.actor, read_inputs(networks.actor, tensordict))
        value = self._value(networks.frozen_critic, tensordict, chosen)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(-value, tensordict=tensordict, weights=weights)
        loss, metadata = self._penalize_saturation(loss, chosen.get(self.tensor_keys.preactivation))
        return loss, {"state_action_value_actor": value.detach(), **metadata}

    def _networks(self) -> _Networks:
        """The networks with their parameters in place, held for good."""
        if self._bound is None:
            first = self.qvalue_network_params[0].detach()
            actor, critic = self.actor_network, self.qvalue_network
            self._bound = _Networks(
                actor=bind(actor, self.actor_network_params),
                critics=StackedNetworks(critic, self.qvalue_network_params),
                frozen_critic=bind(critic, first).requires_grad_(False),
                target_actor=bind(actor, self.target_actor_network_params).requires_grad_(False),
                target_critics=self._averaged_critics(),
            )
        return self._bound

    def parts(self) -> Parts:
        """The networks as functions of tensors."""
        networks = self._networks()
        return Parts(
            actor=networks.actor,
            critic=networks.critics.network,
            critic_parameters=networks.critics.bare,
            target_actor=networks.target_actor,
            target_critics=networks.target_critics,
            action_bounds=(self.min_action, self.max_action),
        )

    def target_noise(self, action: Tensor) -> Tensor:
        """Noise that smooths the target, as many numbers as actions, ``[B, A]``."""
        noise = torch.randn_like(action).mul_(self.policy_noise)
        return noise.clamp_(-self.noise_clip, self.noise_clip)

    def _target(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Clipped double-Q targets at smoothed actions, and the values in them, each ``[B]``."""
        keys, networks = self.tensor_keys, self._networks()
        after = tensordict.get("next")
        with torch.no_grad():
            action = call(networks.target_actor, read_inputs(networks.target_actor, after))[
                keys.action
            ]
            smoothed = action + self.target_noise(action)
            chosen = {keys.action: torch.clamp(smoothed, self.min_action, self.max_action)}
            values = [self._value(critic, after, chosen) for critic in networks.target_critics]
            next_value = torch.stack(values).amin(0)
            target = bootstrap_target(
                after.get(keys.reward).reshape(next_value.shape) * self.reward_scale,
                next_value,
                after.get(keys.terminated).reshape(next_value.shape),
                gamma=self.value_estimator.gamma,
            )
        return target, next_value


@dataclass
class _Networks:
    """Networks that hold the tensors of a loss."""

    actor: TensorDictModule
    critics: StackedNetworks
    frozen_critic: TensorDictModule
    """The first critic, through which gradients flow but which gets none itself."""
    target_actor: TensorDictModule
    target_critics: list[TensorDictModule]


def make_td3_loss(
    actor: TensorDictModule,
    critic: TensorDictModule,
    *,
    gamma: float = 0.99,
    loss_function: str = "l2",
    **kwargs: Any,
) -> SignalTD3Loss:
    """A :class:`SignalTD3Loss` with one-step targets and the squared error of Eq. (11).

    Args:
        actor: Policy.
        critic: Critic, of which two are made, the second with new weights.
        gamma: Discount.
        loss_function: Distance between value and target; TorchRL's own default is smoothed.
        **kwargs: Passed to :class:`SignalTD3Loss`.

    Returns:
        The loss.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> make_td3_loss(make_actor(24, 2), make_critic(24, 2), policy_noise=0.1).policy_noise
        0.1
    """
    loss = SignalTD3Loss(actor, critic, loss_function=loss_function, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
