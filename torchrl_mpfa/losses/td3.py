"""TD3 loss that writes the signals of each transition, as the DDPG loss does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import TD3Loss, ValueEstimators

from torchrl_mpfa.checks import SHARE, check
from torchrl_mpfa.losses.calling import Parts, StackedNetworks, bare, bind, call, read_inputs
from torchrl_mpfa.losses.functional import least_value
from torchrl_mpfa.losses.smoothing import TargetSmoothing, bounds_of, check_noise
from torchrl_mpfa.losses.twin import TwinCritics
from torchrl_mpfa.losses.writing import SignalKeys


class SignalTD3Loss(TwinCritics, TargetSmoothing, TD3Loss):
    r""":class:`~torchrl.objectives.TD3Loss` that also writes the signals of Eqs. (13)-(14).

    Of its two critics' TD errors the larger one counts, as in TorchRL's own ``"td_error"``; the
    gradient is that of the first critic, the one that the actor climbs.

    Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477

    Options: see :class:`~torchrl_mpfa.losses.SignalLoss`.

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        qvalue_network: Critic, of which two are made; reads observations and action, writes
            ``"state_action_value"``.
        action_spec: Bounded spec of the actions, such as ``env.action_spec``.
        bounds: Least and greatest action, numbers or tensors of shape ``[A]``, in place of the
            spec. One of the two must be given.
        **kwargs: Options of :class:`~torchrl_mpfa.losses.SignalLoss`: ``signals``,
            ``gradient_order``, ``importance``, ``reward_scale``, ``saturation_penalty``,
            ``saturation_limit``, ``target_average``, ``pal_alpha``; and of TorchRL's loss:
            ``policy_noise`` and ``noise_clip``, in units of the action, among them.

    Raises:
        TypeError: If a network is no module of tensordicts.
        ValueError: If an argument is out of its range, both or none of ``action_spec`` and
            ``bounds`` are given, or the networks are in the wrong order.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> loss = SignalTD3Loss(make_actor(24, 2), make_critic(24, 2), bounds=(-1.0, 1.0))
        >>> loss.num_qvalue_nets
        2
    """

    @dataclass
    class _AcceptedKeys(SignalKeys, TD3Loss._AcceptedKeys):
        """Keys of TorchRL's loss and of :class:`~torchrl_mpfa.losses.writing.SignalKeys`."""

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        action_spec: Any = None,
        bounds: Any = None,
        **kwargs: Any,
    ) -> None:
        low, high = bounds_of(action_spec, bounds)
        check_noise(kwargs.get("policy_noise", 0.0), kwargs.get("noise_clip", 0.0))
        super().__init__(actor_network, qvalue_network, bounds=(low, high), **kwargs)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Actor's loss by the first critic, with the penalty on saturation if there is one.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and detached values for the log.
        """
        loss, value, metadata = self._policy_loss(tensordict)
        return loss, {"state_action_value_actor": value, **metadata}

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        loss, log = self.actor_loss(batch)
        return {"loss_actor": loss}, log

    def _next_value(self, after: TensorDictBase) -> Tensor:
        actor, key = self._networks().target_actor, self.tensor_keys.action
        action = call(actor, read_inputs(actor, after))[key]
        action = self._smoothed(action)
        return least_value(self._target_values(after, {key: action}))

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
            target_parameters=(
                bare(self.target_actor_network_params),
                bare(self.target_qvalue_network_params),
            ),
            stacked=True,
            action_bounds=(self.min_action, self.max_action),
            target_noise=self.target_noise,
        )


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
        gamma: Discount, in [0, 1].
        loss_function: Distance between value and target; TorchRL's own default is smoothed.
        **kwargs: Passed to :class:`SignalTD3Loss`; ``action_spec`` or ``bounds`` must be there.

    Returns:
        The loss.

    Raises:
        ValueError: If an argument is out of its range, or the bounds of actions are missing.

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
    check(SHARE, gamma=gamma)
    loss = SignalTD3Loss(actor, critic, loss_function=loss_function, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
