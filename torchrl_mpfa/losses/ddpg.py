"""DDPG loss that writes the signals of each transition, by one forward pass of the critic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, ValueEstimators

from torchrl_mpfa.checks import NOT_NEGATIVE, SHARE, check
from torchrl_mpfa.losses.base import SignalKeys, SignalLoss
from torchrl_mpfa.losses.functional import estimated_target, smoothed_action, smoothing_noise
from torchrl_mpfa.networks.bounds import given_bounds


class SignalDDPGLoss(SignalLoss, DDPGLoss):
    r""":class:`~torchrl.objectives.DDPGLoss` that also writes the signals of Eqs. (13)-(14).

    The critic's loss is Eq. (11), :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2` with the
    target of Eq. (5), :math:`y_i = r_i + \gamma Q'(s_{i+1}, \mu'(s_{i+1}))`; the actor's is
    :math:`-\frac{1}{N} \sum_i Q(s_i, \mu(s_i))`. TorchRL's own ``"td_error"`` is written as well,
    squared as ever.

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Further arguments and errors: see :class:`~torchrl_mpfa.losses.SignalLoss`.

    Args:
        actor_network: Policy.
        value_network: Critic.
        delay_actor: True to use a target actor in the target, as in Eq. (5). TorchRL's default is
            False.
        policy_noise: Standard deviation of TD3's noise on the target action, in units of the
            action; 0 is Eq. (5).
        noise_clip: Limit of that noise.
        action_spec: Bounded spec of the actions, such as ``env.action_spec``. Noise needs the spec
            or ``bounds``.
        bounds: Least and greatest action, numbers or tensors of shape ``[A]``.
        **kwargs: Further arguments.

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
        """Keys of TorchRL's loss and of :class:`~torchrl_mpfa.losses.base.SignalKeys`."""

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
        policy_noise = check(NOT_NEGATIVE, policy_noise=policy_noise)
        noise_clip = check(NOT_NEGATIVE, noise_clip=noise_clip)
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
        """Compute the critic's loss (Eq. 11); write the signals (Eqs. 13-14) in ``tensordict``.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.
            defer_gradient: True to leave the signal of Eq. (14) to :meth:`write_action_gradient`,
                after the backward pass of the loss.
            loss_function: Distance of value and target for this call, one of ``"l1"``, ``"l2"``,
                ``"smooth_l1"`` and ``"pal"``; by default the loss's own.

        Returns:
            The loss, and detached values for the log.
        """
        networks, keys, estimator = self._networks(), self.tensor_keys, self.value_estimator
        stored, after = self._stored(tensordict), self._states(tensordict["next"])
        value = self._values(stored)
        with torch.no_grad():
            chosen = networks.target_actor.outputs(after)
            if self.policy_noise > 0:
                action = chosen[keys.action]
                noise = smoothing_noise(action, deviation=self.policy_noise, limit=self.noise_clip)
                low, high = self.min_action, self.max_action
                chosen[keys.action] = smoothed_action(action, noise, low=low, high=high)
            found = networks.target_critics[0].outputs({**after, **chosen})
            next_value = found[keys.state_action_value].squeeze(-1)
            target = estimated_target(  # Eq. (5)
                tensordict, next_value, estimator, keys, reward_scale=self.reward_scale
            )
        loss = self._critic_mean(tensordict, value, target, loss_function)  # Eqs. (4), (11)
        td_error = (target - value).detach()
        action = stored[keys.action]
        self._write_signals(tensordict, value, td_error, action, defer_gradient)  # Eqs. (13), (14)

        squared, value = td_error[0].square(), value[0].detach()
        tensordict.set(keys.priority, squared, inplace=True)
        metadata = {
            "td_error": squared,
            "pred_value": value,
            "target_value": target,
            "target_value_max": target.max(),
            "pred_value_max": value.max(),
        }
        return loss, metadata

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the actor's loss, with the penalty on saturation if there is one.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and detached values for the log.
        """
        networks, states = self._networks(), self._states(tensordict)
        chosen = networks.actor.outputs(states)
        found = networks.frozen_critics[0].outputs({**states, **chosen})
        value = found[self.tensor_keys.state_action_value].squeeze(-1)
        return self._actor_mean(tensordict, -value, chosen)

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        return self.loss_value(batch, **options)

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        loss, log = self.loss_actor(batch)
        return {"loss_actor": loss}, log


def make_ddpg_loss(
    actor: TensorDictModule, critic: TensorDictModule, *, gamma: float = 0.99, **kwargs: Any
) -> SignalDDPGLoss:
    """Make a :class:`SignalDDPGLoss` with the target of Eq. (5).

    Args:
        actor: Policy.
        critic: Critic.
        gamma: Discount, in [0, 1].
        **kwargs: Arguments of :class:`SignalDDPGLoss`.

    Examples:
        >>> from torchrl_mpfa.networks import make_actor, make_critic
        >>> make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)).importance
        'critic'
    """
    gamma = check(SHARE, gamma=gamma)
    loss = SignalDDPGLoss(actor, critic, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
