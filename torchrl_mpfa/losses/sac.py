"""SAC loss that writes the signals of each transition, as the DDPG and TD3 losses do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import SACLoss, ValueEstimators
from torchrl.objectives.sac import compute_rsample_log_prob

from torchrl_mpfa.losses.calling import StackedNetworks, bind, read_inputs
from torchrl_mpfa.losses.ddpg import bootstrap_target
from torchrl_mpfa.losses.options import DEFAULT_SIGNALS, VALUE, GradientAt, Importance
from torchrl_mpfa.losses.twin import TwinCriticsMixin
from torchrl_mpfa.signals import ACTION_GRADIENT, SIGNALS_KEY, TD_ERROR
from torchrl_mpfa.stochastic import StochasticActor


class SignalSACLoss(TwinCriticsMixin, SACLoss):
    r""":class:`~torchrl.objectives.SACLoss` that also writes the signals of Eqs. (13)-(14).

    The target of both critics is :math:`y_i = r_i + \gamma (\min_k Q'_k(s_{i+1}, a') - \alpha
    \ln\pi(a' | s_{i+1}))` with an action :math:`a'` drawn from the current policy; the actor's loss
    is the mean of :math:`\alpha \ln\pi(a | s_i) - \min_k Q_k(s_i, a)`. The temperature
    :math:`\alpha` is tuned until the policy has the entropy ``target_entropy``, minus the number of
    action dimensions unless told otherwise.

    Of the critics' TD errors the larger one counts, as in TorchRL's own ``"td_error"``; gradient
    and value are those of the first critic. Importance weights are used as in
    :class:`SignalDDPGLoss`: neither the actor's nor the temperature's loss has them unless
    ``importance`` is ``"torchrl"``. Q contains the entropy of what follows, hence so do the
    signals.

    Haarnoja et al. (2018), https://arxiv.org/abs/1812.05905

    Args:
        actor_network: Stochastic policy, such as :func:`~torchrl_mpfa.make_stochastic_actor` makes;
            reads observations, writes ``"action"``.
        qvalue_network: Critic, of which two are made; reads observations and action, writes
            ``"state_action_value"``.
        signals: As in :class:`SignalDDPGLoss`, as are the following.
        gradient_order: Order of the norm in Eq. (14).
        gradient_at: ``"stored"``, or ``"policy"``: at the policy's deterministic action.
        importance: ``"critic"``, ``"torchrl"`` or ``"none"``.
        reward_scale: Factor of the rewards in the loss. The temperature belongs to scaled rewards:
            in units of the environment's reward it is :math:`\alpha` divided by this factor, so
            that a smaller one needs a smaller ``alpha_init`` for the same policy.
        saturation_penalty: Factor of the penalty on means in the flat ends of the tanh, where the
            actor writes them as ``"preactivation"``.
        saturation_limit: Where these begin.
        target_average: As in :class:`SignalDDPGLoss`, of each of the target critics.
        **kwargs: Passed to :class:`~torchrl.objectives.SACLoss`; ``alpha_init``,
            ``target_entropy`` and ``fixed_alpha`` among them.

    Raises:
        TypeError: If the actor is not stochastic.
        ValueError: If an argument is out of its range, or one of SAC's first version.

    Examples:
        >>> from torchrl_mpfa import make_critic, make_stochastic_actor
        >>> loss = make_sac_loss(make_stochastic_actor(24, 2), make_critic(24, 2))
        >>> float(loss.target_entropy)
        -2.0
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        """Keys of TorchRL's loss, and those that this one reads or writes beside them."""

        preactivation: NestedKey = "preactivation"
        td_error_signal: NestedKey = TD_ERROR.key
        action_gradient_signal: NestedKey = ACTION_GRADIENT.key
        value_signal: NestedKey = (SIGNALS_KEY, VALUE)

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
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
        if not isinstance(actor_network, ProbabilisticTensorDictSequential):
            raise TypeError(
                "actor_network must be a ProbabilisticTensorDictSequential, got "
                f"{type(actor_network).__name__}"
            )
        for name in ("value_network", "skip_done_states"):
            if kwargs.get(name):
                raise ValueError(f"{name} is not supported, got {kwargs[name]!r}")
        super().__init__(
            actor_network,
            qvalue_network,
            use_prioritized_weights="auto" if importance == "torchrl" else False,
            **kwargs,
        )
        self._set_options(**options)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """What TorchRL's ``forward`` asks for: :meth:`value_loss`, and ``|TD error|``.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and the larger error of the critics, ``[B]``.
        """
        loss, metadata = self.value_loss(tensordict)
        return loss, {"td_error": metadata["td_error"].amax(0).sqrt()}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Actor's loss by the least of the critics, with the penalty on saturation if there is one.

        Args:
            tensordict: A batch of transitions, batch size ``[B]``.

        Returns:
            The loss, and detached values for the log; with ``"log_prob"``, ``[B]``, for
            :meth:`temperature_loss`.
        """
        keys, critics = self.tensor_keys, self._networks().frozen_critics
        action, log_prob, preactivation = self._draw(tensordict)
        inputs = read_inputs(critics.network, tensordict, {keys.action: action})
        found = critics.call([inputs] * self.num_qvalue_nets)
        values = [out[keys.state_action_value].squeeze(-1) for out in found]
        value = torch.stack(values).amin(0)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(
            self._alpha * log_prob - value, tensordict=tensordict, weights=weights
        )
        loss, metadata = self._penalize_saturation(loss, preactivation)
        seen = {"log_prob": log_prob.detach(), "state_action_value_actor": value.detach()}
        return loss, {**seen, **metadata}

    def temperature_loss(self, tensordict: TensorDictBase, log_prob: Tensor) -> Tensor:
        r"""Loss of the temperature, the mean of :math:`-\ln\alpha (\ln\pi(a | s_i) + \bar H)`.

        Args:
            tensordict: The batch that the actor's loss was computed of, batch size ``[B]``.
            log_prob: ``"log_prob"`` out of that, ``[B]``.

        Returns:
            The loss.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        loss: Tensor = self._reduce_loss(
            self.alpha_loss(log_prob), tensordict=tensordict, weights=weights
        )
        return loss

    def _networks(self) -> _Networks:
        """The networks with their parameters in place, held for good."""
        if self._bound is None:
            critic, params = self.qvalue_network, self.qvalue_network_params
            frozen = params.detach()
            self._bound = _Networks(
                actor=bind(self.actor_network, self.actor_network_params),
                critics=StackedNetworks(critic, params),
                frozen_critics=StackedNetworks(critic, frozen),
                frozen_critic=bind(critic, frozen[0]).requires_grad_(False),
                target_critics=self._averaged_critics(),
            )
        return self._bound

    def _draw(self, source: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Actions of the current policy, ``[B, A]``, their log-densities, ``[B]``, and means."""
        actor = self._networks().actor
        inputs = read_inputs(actor, source)
        if isinstance(actor, StochasticActor):
            return actor.draw(inputs)
        found = actor.get_dist_params(TensorDict(inputs))
        action, log_prob = compute_rsample_log_prob(actor.build_dist_from_params(found))
        return action, log_prob, found.get(self.tensor_keys.preactivation, None)

    def _target(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Soft targets, and the values of the next state in them, each ``[B]``."""
        keys, critics = self.tensor_keys, self._networks().target_critics
        after = tensordict.get("next")
        with torch.no_grad():
            action, log_prob, _ = self._draw(after)
            values = [self._value(critic, after, {keys.action: action}) for critic in critics]
            next_value = torch.stack(values).amin(0) - self._alpha * log_prob
            reward = after.get(keys.reward) * self.reward_scale
            if self.value_type is not ValueEstimators.TD0:
                known = tensordict.copy().set(("next", keys.value), next_value.unsqueeze(-1))
                known.set(("next", keys.reward), reward)
                return self.value_estimator.value_estimate(known).squeeze(-1), next_value
            target = bootstrap_target(
                reward.reshape(next_value.shape),
                next_value,
                after.get(keys.terminated).reshape(next_value.shape),
                gamma=self.value_estimator.gamma,
            )
        return target, next_value


@dataclass
class _Networks:
    """Networks that hold the tensors of a loss."""

    actor: ProbabilisticTensorDictSequential
    critics: StackedNetworks
    frozen_critics: StackedNetworks
    """The critics, through which the actor's gradient flows but which get none themselves."""
    frozen_critic: TensorDictModule
    """The first of these."""
    target_critics: list[TensorDictModule]


def make_sac_loss(
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModule,
    *,
    gamma: float = 0.99,
    loss_function: str = "l2",
    **kwargs: Any,
) -> SignalSACLoss:
    """A :class:`SignalSACLoss` with one-step targets and the squared error of Eq. (11).

    Args:
        actor: Stochastic policy.
        critic: Critic, of which two are made, with new weights.
        gamma: Discount.
        loss_function: Distance between value and target; TorchRL's own default is smoothed.
        **kwargs: Passed to :class:`SignalSACLoss`.

    Returns:
        The loss.

    Raises:
        TypeError: If the actor is not stochastic.
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_critic, make_stochastic_actor
        >>> actor, critic = make_stochastic_actor(24, 2), make_critic(24, 2)
        >>> float(make_sac_loss(actor, critic, target_entropy=-1.0).target_entropy)
        -1.0
    """
    loss = SignalSACLoss(actor, critic, loss_function=loss_function, **kwargs)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss
