"""DDPG loss that writes the signals of each transition, in one forward pass of the critic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, ValueEstimators

from torchrl_mpfa.checks import NOT_NEGATIVE, SHARE, check
from torchrl_mpfa.losses.base import SignalLoss
from torchrl_mpfa.losses.calling import call
from torchrl_mpfa.losses.functional import smoothed_action, smoothing_noise
from torchrl_mpfa.losses.keys import SignalKeys
from torchrl_mpfa.networks.bounds import given_bounds


class SignalDDPGLoss(SignalLoss, DDPGLoss):
    r""":class:`~torchrl.objectives.DDPGLoss` that also writes the signals of Eqs. (13)-(14).

    The critic's loss is Eq. (11), :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2` with the
    target of Eq. (5), :math:`y_i = r_i + \gamma Q'(s_{i+1}, \mu'(s_{i+1}))`; the actor's is
    :math:`-\frac{1}{N} \sum_i Q(s_i, \mu(s_i))`. TorchRL's own ``"td_error"`` is written as well,
    squared as ever.

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Options: see :class:`~torchrl_mpfa.losses.SignalLoss`.

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        value_network: Critic; reads observations and action, writes ``"state_action_value"``.
        delay_actor: Whether the target has a target actor, as Eq. (5) has; TorchRL's default is
            not to.
        policy_noise: Standard deviation of noise on the target action, in units of the action, as
            TD3 has it; 0 is Eq. (5).
        noise_clip: Limit of that noise.
        action_spec: Bounded spec of the actions, such as ``env.action_spec``; noise needs it, or
            ``bounds``.
        bounds: Least and greatest action, numbers or tensors of shape ``[A]``, in its place.
        **kwargs: Options of :class:`~torchrl_mpfa.losses.SignalLoss`: ``signals``,
            ``gradient_order``, ``importance``, ``reward_scale``, ``saturation_penalty``,
            ``saturation_limit``, ``target_average``, ``pal_alpha``; and of TorchRL's loss.

    Raises:
        TypeError: If a network is no module of tensordicts.
        ValueError: If an argument is out of its range, or the networks are in the wrong order.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa.networks import make_actor, make_critic
        >>> from torchrl.objectives import SoftUpdate
        >>> loss = SignalDDPGLoss(make_actor(24, 2), make_critic(24, 2))
        >>> targets = SoftUpdate(loss, tau=0.01)
        >>> end = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.rand(8, 24), "reward": torch.rand(8, 1)}
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.rand(8, 24),
        ...         "action": torch.rand(8, 2),
        ...         "next": {**after, "done": end, "terminated": end},
        ...     },
        ...     [8],
        ... )
        >>> losses = loss(batch)
        >>> batch["signals"]["action_gradient"].shape
        torch.Size([8])
    """

    @dataclass
    class _AcceptedKeys(SignalKeys, DDPGLoss._AcceptedKeys):
        """Keys of TorchRL's loss and of :class:`~torchrl_mpfa.losses.keys.SignalKeys`."""

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _critic_name = "value_network"

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        delay_actor: bool = True,
        policy_noise: float = 0.0,
        noise_clip: float = 0.5,
        action_spec: Any = None,
        bounds: Any = None,
        **kwargs: Any,
    ) -> None:
        check(NOT_NEGATIVE, policy_noise=policy_noise, noise_clip=noise_clip)
        within = given_bounds(action_spec, bounds) if policy_noise > 0 else None
        super().__init__(actor_network, value_network, delay_actor=delay_actor, **kwargs)
        self.policy_noise, self.noise_clip = policy_noise, noise_clip
        if within is not None:
            # Arguments, hence not part of a state.
            for name, value in zip(("min_action", "max_action"), within, strict=True):
                self.register_buffer(name, value, persistent=False)

    def loss_value(
        self,
        tensordict: TensorDictBase,
        *,
        defer_gradient: bool = False,
        loss_function: str | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Critic's loss (Eq. 11); writes the signals (Eqs. 13-14) in ``tensordict``.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.
            defer_gradient: Leave the signal of Eq. (14) to :meth:`write_action_gradient`, which
                has it from the backward pass at no cost.
            loss_function: Distance of value and target for this call, one of ``"l1"``, ``"l2"``,
                ``"smooth_l1"`` and ``"pal"``; by default the loss's own.

        Returns:
            The loss, and detached values for the log.
        """
        value = self._stored_values(tensordict, defer_gradient=defer_gradient)  # And Eq. (14).
        with torch.no_grad():
            target = self._target(tensordict, self._next_value(tensordict["next"]))  # Eq. (5)
        td_error = (target - value).detach()
        self._write_signals(tensordict, td_error, value)  # Eq. (13)
        loss = self._critic_mean(tensordict, value, target, loss_function)  # Eqs. (4), (11)

        squared, value = td_error[0].square(), value[0].detach()
        tensordict.set(self.tensor_keys.priority, squared, inplace=True)
        metadata = {
            "td_error": squared,
            "pred_value": value,
            "target_value": target,
            "target_value_max": target.max(),
            "pred_value_max": value.max(),
        }
        return loss, metadata

    def _next_value(self, after: TensorDictBase) -> Tensor:
        """Q of the target networks at the next states in Eq. (5), shape ``[B]``."""
        networks, key = self._networks(), self.tensor_keys.action
        chosen = call(networks.target_actor, after)
        if self.policy_noise > 0:
            noise, (low, high) = self.target_noise(chosen[key]), (self.min_action, self.max_action)
            chosen[key] = smoothed_action(chosen[key], noise, low=low, high=high)
        return self._q(networks.target_critics[0], after, chosen)

    def target_noise(self, action: Tensor) -> Tensor:
        """Noise that smooths the target, as many numbers as actions, ``[B, A]``."""
        return smoothing_noise(action, deviation=self.policy_noise, limit=self.noise_clip)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Actor's loss, with the penalty on saturation if there is one.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and detached values for the log.
        """
        networks = self._networks()
        chosen = call(networks.actor, tensordict)
        value = self._q(networks.frozen_critics[0], tensordict, chosen)
        return self._actor_mean(tensordict, -value, chosen)

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        return self.loss_value(batch, **options)

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        loss, log = self.loss_actor(batch)
        return {"loss_actor": loss}, log


def make_ddpg_loss(
    actor: TensorDictModule, critic: TensorDictModule, *, gamma: float = 0.99, **kwargs: Any
) -> SignalDDPGLoss:
    """A :class:`SignalDDPGLoss` with the target of Eq. (5).

    Args:
        actor: Policy.
        critic: Critic.
        gamma: Discount, in [0, 1].
        **kwargs: Passed to :class:`SignalDDPGLoss`.

    Returns:
        The loss.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa.networks import make_actor, make_critic
        >>> make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)).importance
        'critic'
    """
    check(SHARE, gamma=gamma)
    loss = SignalDDPGLoss(actor, critic, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
