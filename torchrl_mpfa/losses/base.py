"""Options, networks, signals (Eqs. 13-14) and means over the batch of all losses."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator

from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE, Rule, check, check_counts
from torchrl_mpfa.losses.functional import (
    DISTANCES,
    LEAST_NOISE,
    action_gradient,
    critic_loss,
    quantile_loss,
    read_trust,
    saturation,
    trusted_loss,
)
from torchrl_mpfa.losses.stacked import (
    HoldsNetworks,
    Networks,
    PastCritics,
    Tensors,
    as_function,
    average,
    bind_frozen,
    bind_networks,
    check_networks,
    last_layer,
    with_quantiles,
)
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import (
    action_gradient_priority,
    information_gain_priority,
    td_error_priority,
)
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import ACTION_GRADIENT, INFORMATION_GAIN, SIGNALS_KEY, TD_ERROR

VALUE = "value"
"""Name of the signal that is Q itself, which may be negative."""
DEFAULT_SIGNALS = (TD_ERROR.name, ACTION_GRADIENT.name)
KNOWN_SIGNALS = (*DEFAULT_SIGNALS, VALUE, INFORMATION_GAIN.name)
"""Signals that a loss can write."""
_LEAST_SLOPE = 1e-19
"""Its square is still a normal number in single precision."""
_ESTIMATORS = (TD0Estimator, TD1Estimator, TDLambdaEstimator)


@dataclass
class SignalKeys:
    """Keys that a loss of this package reads or writes in addition to those of TorchRL's loss."""

    action: NestedKey = "action"
    preactivation: NestedKey = "preactivation"
    td_error_signal: NestedKey = TD_ERROR.key
    action_gradient_signal: NestedKey = ACTION_GRADIENT.key
    value_signal: NestedKey = (SIGNALS_KEY, VALUE)
    information_gain_signal: NestedKey = INFORMATION_GAIN.key


_USES = ("critic", "torchrl", "none")
IMPORTANCE: Rule = (lambda use: use in _USES, "'critic', 'torchrl' or 'none'")


class SignalLoss(HoldsNetworks):
    r"""Options of the losses that write signals, mixed into one of TorchRL's losses.

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|` (Eq. 13) and
    ``("signals", "action_gradient")`` :math:`= \lVert \nabla_a Q(s_i, a_i) \rVert` (Eq. 14), each
    of shape ``[B]``. Where TorchRL's ``MultiStepTransform`` has written ``"steps_to_next_obs"``,
    the target is :math:`r_i + \gamma^{n_i} Q'`.

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        critic_network: Critic; reads observations and action, writes ``"state_action_value"``.
        signals: Signals to write, of ``"td_error"``, ``"action_gradient"``, ``"value"`` (Q itself)
            and ``"information_gain"``. The last is UPER's. It needs a further network, like the
            critic, that learns the quantiles of the targets: its loss is added to the critics'.
        gradient_order: Order of the norm in Eq. (14).
        importance: Use of ``"priority_weight"``: on the ``"critic"`` alone, divided by the batch
            size (Eq. 11); ``"torchrl"``: on all losses, divided by the sum of the weights;
            ``"none"``.
        reward_scale: Factor of the rewards in the loss. The signals are divided by it again, so
            that they stay in the units of the environment's reward, as Eq. (12) is.
        saturation_penalty: Factor of the mean of :math:`\max(0, |u| - l)^2`, added to the actor's
            loss, where :math:`u` is the action before its tanh (``"preactivation"``).
        saturation_limit: The limit :math:`l`.
        target_average: Number of critics in the mean of the target: the target critic and its
            states at the last calls of :meth:`keep_target_critics`; 1 is Eq. (5).
        pal_alpha: Priority exponent :math:`\alpha` of the loss function ``"pal"``.
        **kwargs: Arguments of TorchRL's loss. ``loss_function``, the distance of value and target,
            may be ``"pal"``, too.

    Raises:
        TypeError: If a network is no module of tensordicts.
        ValueError: If an argument is out of its range, or the networks are in the wrong order.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor(24, 2), make_critic(24, 2), signals=["td_error"])
        >>> isinstance(loss, SignalLoss), loss.signals
        (True, ('td_error',))
    """

    actor_network: Any
    loss_function: str
    reduction: str
    tensor_keys: Any
    value_estimator: Any
    value_type: Any
    _value_estimator: Any
    _bound: Networks | None
    _critic_name: ClassVar[str] = "qvalue_network"
    """TorchRL's name of the critic."""
    policy_delay: ClassVar[int] = 1
    """Updates of the critics for one of the actor, unless a learner is given another number."""

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule,
        *,
        signals: Sequence[str] = DEFAULT_SIGNALS,
        gradient_order: float = 2.0,
        importance: str = "critic",
        reward_scale: float = 1.0,
        saturation_penalty: float = 0.0,
        saturation_limit: float = 1.5,
        target_average: int = 1,
        pal_alpha: float = 0.4,
        **kwargs: Any,
    ) -> None:
        # Before TorchRL's constructor changes the networks.
        check_networks(actor_network, critic_network, critic_name=self._critic_name)
        unknown = [name for name in signals if name not in KNOWN_SIGNALS]
        if unknown:
            raise ValueError(f"signals must be among {KNOWN_SIGNALS}, got {unknown}")
        check(IMPORTANCE, importance=importance)
        if kwargs.get("loss_function", "l2") not in DISTANCES:
            raise ValueError(
                f"loss_function must be one of {DISTANCES}, got {kwargs['loss_function']!r}"
            )
        gradient_order = check((lambda n: n > 0, "positive"), gradient_order=gradient_order)
        reward_scale = check(POSITIVE, reward_scale=reward_scale)
        saturation_penalty = check(NOT_NEGATIVE, saturation_penalty=saturation_penalty)
        saturation_limit = check(NOT_NEGATIVE, saturation_limit=saturation_limit)
        pal_alpha = check(NOT_NEGATIVE, pal_alpha=pal_alpha)
        target_average = check_counts(target_average=target_average)
        if target_average > 1 and not isinstance(critic_network, DirectModule):
            raise ValueError(
                f"target_average = {target_average} needs a DirectModule as critic, "
                f"got {type(critic_network).__name__}"
            )
        one = critic_network[0] if isinstance(critic_network, list) else critic_network
        with_noise = INFORMATION_GAIN.name in signals
        if with_noise:
            last_layer(one)
            one = deepcopy(one)
        super().__init__(
            actor_network,
            critic_network,
            use_prioritized_weights="auto" if importance == "torchrl" else False,
            # TorchRL makes tensors of some, whose type would be that of a number of NumPy.
            **{k: v.item() if isinstance(v, np.generic) else v for k, v in kwargs.items()},
        )  # type: ignore[call-arg]
        self.signals = tuple(signals)
        self.gradient_order = gradient_order
        self.importance = importance
        self.reward_scale = reward_scale
        self.saturation_penalty = saturation_penalty
        self.saturation_limit = saturation_limit
        self.target_average = target_average
        self.pal_alpha = pal_alpha
        # Last, so that the critics start as they would without it.
        self.noise_network = with_quantiles(one) if with_noise else None
        self._deferred: tuple[Tensor, Tensor] | None = None
        """Actions and values, for their gradients in the backward pass of the loss."""
        # A list of modules, so that the past is saved, loaded and moved with the loss.
        self.past_critics = nn.ModuleList()
        if target_average > 1:
            # Of the current critics, which the target critics equal at the start.
            for network in self._held_critics(""):
                self.past_critics.append(PastCritics(network.module, target_average - 1))

    # Methods for a learner.

    def losses(
        self,
        batch: TensorDictBase,
        *,
        trains: Trains = "both",
        loss_function: str | None = None,
        defer_gradient: bool = True,
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Compute the losses of an update, with the signal of Eq. (14) deferred.

        Args:
            batch: Transitions, batch size ``[B]``; the critics' loss writes their signals.
            trains: Losses to compute: the ``"critic"``'s, the ``"actor"``'s, or ``"both"``.
            loss_function: Distance of the critics' loss; None: the loss's own.
            defer_gradient: False writes the signal of Eq. (14) at once.

        Returns:
            Losses by name, to be summed and differentiated before :meth:`write_action_gradient`;
            and values for the log.
        """
        losses: dict[str, Tensor] = {}
        log: dict[str, Tensor] = {}
        self._deferred = None  # Of an update that failed halfway.
        if trains != "actor":
            losses["loss_value"], log = self._critics_part(
                batch, defer_gradient=defer_gradient, loss_function=loss_function
            )
        if trains != "critic":
            of_actor, more = self._actors_part(batch)
            losses, log = {**losses, **of_actor}, {**log, **more}
        return losses, log

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        """Compute the critics' loss by TorchRL's method for it; return values for the log too."""
        raise NotImplementedError

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Compute the actor's loss, and others of the same batch; return values for the log too."""
        raise NotImplementedError

    def write_action_gradient(self, tensordict: TensorDictBase) -> None:
        r"""Write the signal of Eq. (14) that the critics' loss deferred.

        A transition's action enters the loss through its own Q alone, so
        :math:`\nabla_a Q = \nabla_a L / (\partial L / \partial Q)`: the backward pass of the loss
        gives both factors, and no pass of its own is needed. A transition without error counts as
        one with the least error that can be divided by.

        Args:
            tensordict: The batch of the loss; nothing is written if nothing was deferred.

        Raises:
            RuntimeError: If the loss was not differentiated.
        """
        if self._deferred is None:
            return
        (action, value), self._deferred = self._deferred, None
        if action.grad is None or value.grad is None:
            raise RuntimeError(
                "the action gradient was deferred: call backward() on the loss first"
            )
        gradient = action.grad / value.grad[0].unsqueeze(-1)
        self._write_slope(tensordict, gradient)

    def keep_target_critics(self) -> None:
        """Keep the target critics' present state for the mean of later targets."""
        if self.past_critics:
            for critic, past in zip(self._held_critics("target_"), self.past_critics, strict=True):
                past.push(critic.module)  # type: ignore[operator]

    def current_critics(self) -> list[TensorDictModule]:
        """Return modules that hold the critics' parameters, without gradients."""
        return self._held_critics("")

    def actor_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that the actor's loss moves."""
        return self._parameters_of("actor_network")

    def critic_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that the critics' loss moves."""
        more = [] if self.noise_network is None else self.noise_network.parameters()
        return [*self._parameters_of(self._critic_name), *more]

    def temperature_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that only SAC has: its temperature, unless that is fixed."""
        return []

    def _parameters_of(self, name: str) -> list[nn.Parameter]:
        flat = getattr(self, f"{name}_params").flatten_keys().values()
        return [value for value in flat if value.requires_grad]

    # The steps of a loss, in their order.

    def _stored(self, batch: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Read a critic's inputs of stored transitions, without gradients."""
        return {key: batch[key].detach() for key in self._networks().stored}

    def _states(self, source: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Read the states in which the actor is to act, without gradients."""
        return {key: source[key].detach() for key in self._networks().states}

    def _values(self, stored: dict[NestedKey, Tensor]) -> Tensor:
        """Compute Q of the stored actions, ``[C, B]``; the first critic's slope can follow."""
        keys, each = self.tensor_keys, []
        with_slope = ACTION_GRADIENT.name in self.signals
        action = stored[keys.action].requires_grad_(with_slope)
        # The slope is written under no_grad as well, when a loss is only looked at.
        with torch.set_grad_enabled(with_slope or torch.is_grad_enabled()):
            for critic in self._networks().critics:
                found = critic.outputs({**stored, keys.action: action})
                each.append(found[keys.state_action_value].squeeze(-1))
                action = action.detach()
            return torch.stack(each) if len(each) > 1 else each[0].unsqueeze(0)

    def _critic_mean(
        self, batch: TensorDictBase, value: Tensor, target: Tensor, loss_function: str | None
    ) -> Tensor:
        """Compute the critics' loss (Eq. 4), with the weights of Eq. (11) or TorchRL's."""
        loss = critic_loss(
            value,
            target,
            loss_function or self.loss_function,
            unit=self.reward_scale,
            pal_alpha=self.pal_alpha,
        )
        if self.noise_network is not None:
            loss = loss + self._noise_loss(batch, (target - value).detach(), target)
        if self.importance == "critic":
            weight = batch.get(self.tensor_keys.priority_weight, None)
            if weight is not None:
                loss = loss * weight.reshape(loss.shape).to(loss.device)
        return self._mean(batch, loss)

    def _noise_loss(self, batch: TensorDictBase, td_error: Tensor, target: Tensor) -> Tensor:
        """Compute the loss of the targets' quantiles, ``[B]``; write the information gain."""
        found = as_function(self.noise_network).outputs(self._stored(batch))
        quantiles = found[self.tensor_keys.state_action_value]
        least = LEAST_NOISE * self.reward_scale
        gain = information_gain_priority(td_error, quantiles.detach(), least_noise=least)
        batch.set(self.tensor_keys.information_gain_signal, gain)
        return quantile_loss(quantiles, target)

    def _write_signals(
        self, batch: TensorDictBase, value: Tensor, td_error: Tensor, action: Tensor, defer: bool
    ) -> None:
        """Write ``|TD error|`` (Eq. 13), the largest of the critics, the slope (Eq. 14), and Q."""
        keys, self._deferred = self.tensor_keys, None
        if TD_ERROR.name in self.signals:
            size = td_error_priority(td_error).amax(0)
            batch.set(keys.td_error_signal, size / self.reward_scale)
        if VALUE in self.signals:
            batch.set(keys.value_signal, value[0].detach() / self.reward_scale)
        if ACTION_GRADIENT.name not in self.signals:
            return
        if defer and torch.is_grad_enabled():
            value.register_hook(_without_zeros)
            value.retain_grad()
            self._deferred = action, value
        else:
            with torch.enable_grad():
                self._write_slope(batch, action_gradient(value[0], action))

    def _write_slope(self, batch: TensorDictBase, gradient: Tensor) -> None:
        """Write the norm of the gradient of the first critic (Eq. 14)."""
        size = action_gradient_priority(gradient, order=self.gradient_order)
        batch.set(self.tensor_keys.action_gradient_signal, size / self.reward_scale)

    def _actor_mean(
        self, batch: TensorDictBase, loss: Tensor, chosen: Tensors
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Average an actor's losses ``[B]``, add the penalty on saturation; return its log too."""
        keys = self.tensor_keys
        loss = trusted_loss(loss, chosen[keys.action], read_trust(batch))
        mean = self._mean(batch, loss)
        preactivation = chosen.get(keys.preactivation)
        if preactivation is None:
            if self.saturation_penalty > 0:
                raise KeyError(
                    f"saturation_penalty is {self.saturation_penalty}, but the actor writes no "
                    f"{keys.preactivation!r}"
                )
            return mean, {}
        if self.saturation_penalty > 0:
            penalty = saturation(preactivation, limit=self.saturation_limit)
            mean = mean + self.saturation_penalty * penalty
        return mean, {"preactivation": preactivation.detach().abs()}

    def _mean(self, batch: TensorDictBase, loss: Tensor) -> Tensor:
        """Average over the batch; with ``importance="torchrl"`` by TorchRL's weights."""
        weights = self._maybe_get_priority_weight(batch)  # type: ignore[attr-defined]
        reduced: Tensor = self._reduce_loss(loss, tensordict=batch, weights=weights)  # type: ignore[attr-defined]
        return reduced

    # The estimator of the targets.

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """Choose the estimator of the targets, TD(0), TD(1) or TD(lambda), as in TorchRL.

        Args:
            value_type: A member of :class:`~torchrl.objectives.ValueEstimators`, or an estimator.
            **hyperparams: Arguments of the estimator, such as ``gamma``.

        Raises:
            ValueError: If the estimator is of another kind.
        """
        kept = self._value_estimator, self.value_type
        try:
            found = super().make_value_estimator(value_type, **hyperparams)  # type: ignore[misc]
        except NotImplementedError as error:
            self._value_estimator, self.value_type = kept
            raise ValueError(f"value_type is not supported: {error}") from error
        if not isinstance(self._value_estimator, _ESTIMATORS):
            made = type(self._value_estimator).__name__
            self._value_estimator, self.value_type = kept
            names = ", ".join(each.__name__ for each in _ESTIMATORS)
            raise ValueError(f"value_type must make one of {names}, got {made}")
        self._forward_value_estimator_keys()  # type: ignore[attr-defined]
        return found

    # The networks, made once: they hold the parameters of the loss.

    def _networks(self) -> Networks:
        """Return the networks, bound to the parameters if they are not yet."""
        if self._bound is None:
            name = self._critic_name
            self._bound = bind_networks(
                (self.actor_network, self.actor_network_params, self.target_actor_network_params),  # type: ignore[attr-defined]
                (getattr(self, name), getattr(self, f"{name}_params")),
                average(self._held_critics("target_"), self.past_critics),
            )
        return self._bound

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        """Return critics that hold the parameters with this prefix, without gradients."""
        name = self._critic_name
        return bind_frozen(getattr(self, name), getattr(self, f"{prefix}{name}_params"))


def _without_zeros(slope: Tensor) -> Tensor:
    """Replace zeros by a number that moves no weight, and that can be divided by."""
    return slope.masked_fill(slope == 0, max(_LEAST_SLOPE, torch.finfo(slope.dtype).tiny))
