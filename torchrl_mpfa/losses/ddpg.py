"""DDPG loss that writes the signals of each transition, out of one forward pass of the critic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import DDPGLoss, ValueEstimators

from torchrl_mpfa.losses.calling import Parts, bind, call, read_inputs
from torchrl_mpfa.losses.distances import distance
from torchrl_mpfa.losses.options import (
    DEFAULT_SIGNALS,
    VALUE,
    GradientAt,
    Importance,
    SignalLossMixin,
)
from torchrl_mpfa.signals import ACTION_GRADIENT, SIGNALS_KEY, TD_ERROR


class SignalDDPGLoss(SignalLossMixin, DDPGLoss):
    r""":class:`~torchrl.objectives.DDPGLoss` that also writes the signals of Eqs. (13)-(14).

    The critic's loss is Eq. (11), :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2` with the
    target of Eq. (5), :math:`y_i = r_i + \gamma Q'(s_{i+1}, \mu'(s_{i+1}))`; the actor's is
    :math:`-\frac{1}{N} \sum_i Q(s_i, \mu(s_i))`. The batch gets
    ``("signals", "td_error")`` :math:`= |\delta_i|` and ``("signals", "action_gradient")``
    :math:`= \lVert \nabla_a Q(s_i, a_i) \rVert`, each of shape ``[B]``. TorchRL's own
    ``"td_error"`` is written as well, squared as ever.

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        value_network: Critic; reads observations and action, writes ``"state_action_value"``.
        signals: Which of ``"td_error"``, ``"action_gradient"`` and ``"value"`` (Q itself) to write.
        gradient_order: Order of the norm in Eq. (14).
        gradient_at: Where the gradient is taken: at the ``"stored"`` action (Eq. 14), or at that
            of the current ``"policy"``, for one more forward pass.
        importance: Use of ``"priority_weight"``: on the ``"critic"`` alone, divided by the batch
            size (Eq. 11); ``"torchrl"``: on both losses, divided by the sum of the weights;
            ``"none"``.
        reward_scale: Factor of the rewards in the loss. The signals are divided by it again, so
            that they stay in the units of the environment's reward, as Eq. (12) is.
        saturation_penalty: Factor of the mean of :math:`\max(0, |u| - l)^2`, added to the actor's
            loss, where :math:`u` is the action before its tanh (``"preactivation"``).
        saturation_limit: The limit :math:`l`.
        target_average: Number of critics of which the target's Q is the mean: the target critic
            and what it was at the last calls of :meth:`keep_target_critics`; 1 is Eq. (5).
        delay_actor: Whether the target has a target actor, as Eq. (5) has; TorchRL's default is
            not to.
        **kwargs: Passed to :class:`~torchrl.objectives.DDPGLoss`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
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
    class _AcceptedKeys(DDPGLoss._AcceptedKeys):
        """Keys of TorchRL's loss, and those that this one reads or writes beside them."""

        action: NestedKey = "action"
        preactivation: NestedKey = "preactivation"
        td_error_signal: NestedKey = TD_ERROR.key
        action_gradient_signal: NestedKey = ACTION_GRADIENT.key
        value_signal: NestedKey = (SIGNALS_KEY, VALUE)

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        signals: Sequence[str] = DEFAULT_SIGNALS,
        gradient_order: float = 2.0,
        gradient_at: GradientAt = "stored",
        importance: Importance = "critic",
        reward_scale: float = 1.0,
        saturation_penalty: float = 0.0,
        saturation_limit: float = 1.5,
        target_average: int = 1,
        delay_actor: bool = True,
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
            value_network,
            delay_actor=delay_actor,
            use_prioritized_weights="auto" if importance == "torchrl" else False,
            **kwargs,
        )
        self._set_options(**options)

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
        keys = self.tensor_keys
        at_stored = self._gradient_at_stored
        action = tensordict[keys.action].detach()
        # The gradient is wanted under no_grad as well, when a loss is only looked at.
        with torch.set_grad_enabled(at_stored or torch.is_grad_enabled()):
            if at_stored:
                action.requires_grad_(True)  # A detached alias: the batch itself is not touched.
            value = self._value(self._networks().critic, tensordict, {keys.action: action})
        gradient = self._stored_gradient(tensordict, action, value, defer=defer_gradient)
        if not torch.is_grad_enabled():
            value = value.detach()

        target = self._target(tensordict)
        td_error = (target - value).detach()
        self._write_signals(tensordict, td_error, value, gradient)
        squared = td_error.square()
        tensordict.set(keys.priority, squared, inplace=True)
        loss = distance(value, target, loss_function or self.loss_function, unit=self.reward_scale)
        loss = self._reduce(loss, tensordict)
        seen = value.detach()
        metadata = {
            "td_error": squared,
            "pred_value": seen,
            "target_value": target,
            "target_value_max": target.max(),
            "pred_value_max": seen.max(),
        }
        return loss, metadata

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Actor's loss, with the penalty on saturation if there is one.

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
        return self._penalize_saturation(loss, chosen.get(self.tensor_keys.preactivation))

    def _networks(self) -> _Networks:
        """The networks with their parameters in place, held for good."""
        if self._bound is None:
            actor, critic = self.actor_network_params, self.value_network_params
            target_actor = self.target_actor_network_params
            self._bound = _Networks(
                actor=bind(self.actor_network, actor),
                critic=bind(self.value_network, critic),
                frozen_critic=bind(self.value_network, critic.detach()).requires_grad_(False),
                target_actor=bind(self.actor_network, target_actor).requires_grad_(False),
                target_critic=self._averaged_critics()[0],
            )
        return self._bound

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        """The critic with the parameters whose name has this prefix."""
        params = getattr(self, f"{prefix}value_network_params").detach()
        return [bind(self.value_network, params).requires_grad_(False)]

    def parts(self) -> Parts:
        """The networks as functions of tensors."""
        networks = self._networks()
        critic = networks.critic
        return Parts(
            actor=networks.actor,
            critic=critic,
            critic_parameters=dict(critic.module.named_parameters()),
            target_actor=networks.target_actor,
            target_critics=[networks.target_critic],
        )

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """Targets y of Eq. (5), shape ``[B]``; a time limit bootstraps, an end does not."""
        keys = self.tensor_keys
        if self.value_type is not ValueEstimators.TD0:
            if self.reward_scale != 1.0:
                tensordict = tensordict.copy()
                scaled = tensordict.get(("next", keys.reward)) * self.reward_scale
                tensordict.set(("next", keys.reward), scaled)
            longer: Tensor = self.value_estimator.value_estimate(
                tensordict, target_params=self._cached_target_params
            )
            return longer.squeeze(-1)
        after = tensordict.get("next")
        networks = self._networks()
        with torch.no_grad():
            chosen = call(networks.target_actor, read_inputs(networks.target_actor, after))
            next_value = self._value(networks.target_critic, after, chosen)
            return bootstrap_target(
                after.get(keys.reward).reshape(next_value.shape) * self.reward_scale,
                next_value,
                after.get(keys.terminated).reshape(next_value.shape),
                gamma=self.value_estimator.gamma,
            )


@dataclass
class _Networks:
    """Networks that hold the tensors of a loss."""

    actor: TensorDictModule
    critic: TensorDictModule
    frozen_critic: TensorDictModule
    """The critic, through which the actor's gradient flows but which gets none itself."""
    target_actor: TensorDictModule
    target_critic: TensorDictModule


def bootstrap_target(
    reward: Tensor, next_value: Tensor, terminated: Tensor, *, gamma: float | Tensor
) -> Tensor:
    r"""One-step target, :math:`y_i = r_i + \gamma Q'(s_{i+1}, \mu'(s_{i+1}))` (Eq. 5).

    The paper leaves out that nothing follows an end, and prints the current critic's parameters
    where the target critic's are meant.

    Args:
        reward: :math:`r_i`, shape ``[B]``.
        next_value: Q of the target networks at the next state, shape ``[B]``.
        terminated: Whether the episode ended there; a time limit is no end, shape ``[B]``.
        gamma: Discount.

    Returns:
        Targets, shape ``[B]``.

    Examples:
        >>> end = torch.tensor([False, True])
        >>> bootstrap_target(torch.ones(2), torch.ones(2), end, gamma=0.5).tolist()
        [1.5, 1.0]
    """
    return reward + gamma * next_value * ~terminated


def make_ddpg_loss(
    actor: TensorDictModule, critic: TensorDictModule, *, gamma: float = 0.99, **kwargs: Any
) -> SignalDDPGLoss:
    """A :class:`SignalDDPGLoss` with the one-step target of Eq. (5).

    Args:
        actor: Policy.
        critic: Critic.
        gamma: Discount.
        **kwargs: Passed to :class:`SignalDDPGLoss`.

    Returns:
        The loss.

    Examples:
        >>> from torchrl_mpfa.networks import make_actor, make_critic
        >>> make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)).importance
        'critic'
    """
    loss = SignalDDPGLoss(actor, critic, **kwargs)
    # One step only: longer targets would need time-ordered batches, which replay does not give.
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
