"""DDPG loss that writes the signals of each transition, in one forward pass of the critic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss, ValueEstimators

from torchrl_mpfa.checks import SHARE, check
from torchrl_mpfa.losses.base import SignalLoss
from torchrl_mpfa.losses.calling import Parts, bare, bind, call, read_inputs
from torchrl_mpfa.losses.smoothing import TargetSmoothing, bounds_of, check_noise
from torchrl_mpfa.losses.writing import SignalKeys


class SignalDDPGLoss(SignalLoss, TargetSmoothing, DDPGLoss):
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
        """Keys of TorchRL's loss and of :class:`~torchrl_mpfa.losses.writing.SignalKeys`."""

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
        check_noise(policy_noise, noise_clip)
        within = bounds_of(action_spec, bounds) if policy_noise > 0 else None
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
        step = self._critic_step(
            tensordict, defer_gradient=defer_gradient, loss_function=loss_function
        )
        squared = step.td_error[0].square()
        tensordict.set(self.tensor_keys.priority, squared, inplace=True)
        value = step.value[0].detach()
        metadata = {
            "td_error": squared,
            "pred_value": value,
            "target_value": step.target,
            "target_value_max": step.target.max(),
            "pred_value_max": value.max(),
        }
        return step.loss, metadata

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Actor's loss, with the penalty on saturation if there is one.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and detached values for the log.
        """
        loss, _, metadata = self._policy_loss(tensordict)
        return loss, metadata

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        return self.loss_value(batch, **options)

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        loss, log = self.loss_actor(batch)
        return {"loss_actor": loss}, log

    def _values(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        critic, keys = self._networks().critic, self.tensor_keys
        found = call(critic, read_inputs(critic, tensordict, {keys.action: action}))
        return found[keys.state_action_value].squeeze(-1).unsqueeze(0)

    def _next_value(self, after: TensorDictBase) -> Tensor:
        networks = self._networks()
        chosen = call(networks.target_actor, read_inputs(networks.target_actor, after))
        if self.policy_noise > 0:
            key = self.tensor_keys.action
            chosen = {**chosen, key: self._smoothed(chosen[key])}
        return self._value(networks.target_critic, after, chosen)

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
        params = getattr(self, f"{prefix}value_network_params").detach()
        return [bind(self.value_network, params).requires_grad_(False)]

    def parts(self) -> Parts:
        """The networks as functions of tensors."""
        networks = self._networks()
        critic, smooths = networks.critic, self.policy_noise > 0
        return Parts(
            actor=networks.actor,
            critic=critic,
            critic_parameters=dict(critic.module.named_parameters()),
            target_actor=networks.target_actor,
            target_critics=[networks.target_critic],
            target_parameters=(
                bare(self.target_actor_network_params),
                bare(self.target_value_network_params),
            ),
            stacked=False,
            action_bounds=(self.min_action, self.max_action) if smooths else None,
            target_noise=self.target_noise if smooths else None,
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
