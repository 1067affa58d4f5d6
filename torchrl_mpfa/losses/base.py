"""Options, networks, signals (Eqs. 13-14) and means over the batch, which all losses share."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator

from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE, check, check_counts
from torchrl_mpfa.losses.averaging import PastCritics, average
from torchrl_mpfa.losses.calling import (
    Networks,
    StackedNetworks,
    Tensors,
    bind,
    bind_frozen,
    call,
    check_networks,
)
from torchrl_mpfa.losses.functional import (
    DISTANCES,
    action_gradient,
    bootstrap_target,
    critic_loss,
    read_trust,
    saturation,
    scale_rewards,
    trusted_loss,
)
from torchrl_mpfa.losses.keys import DEFAULT_SIGNALS, KNOWN_SIGNALS, VALUE, check_importance
from torchrl_mpfa.losses.noise import LEAST_NOISE, last_layer, quantile_loss, with_quantiles
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import (
    action_gradient_priority,
    information_gain_priority,
    td_error_priority,
)
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import ACTION_GRADIENT, INFORMATION_GAIN, TD_ERROR

_ESTIMATORS = (TD0Estimator, TD1Estimator, TDLambdaEstimator)


class SignalLoss:
    r"""Options of the losses that write signals; mixed into one of TorchRL's.

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|` (Eq. 13) and
    ``("signals", "action_gradient")`` :math:`= \lVert \nabla_a Q(s_i, a_i) \rVert` (Eq. 14), each
    of shape ``[B]``. Where TorchRL's ``MultiStepTransform`` has written ``"steps_to_next_obs"``,
    the target is :math:`r_i + \gamma^{n_i} Q'`.

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        critic_network: Critic; reads observations and action, writes ``"state_action_value"``.
        signals: Which of ``"td_error"``, ``"action_gradient"``, ``"value"`` (Q itself) and
            ``"information_gain"`` to write. The last is UPER's, of all critics and of a further
            network, like the critic, which learns the quantiles of the targets: its loss is part
            of the critics', and its weights are among theirs.
        gradient_order: Order of the norm in Eq. (14).
        importance: Use of ``"priority_weight"``: on the ``"critic"`` alone, divided by the batch
            size (Eq. 11); ``"torchrl"``: on all losses, divided by the sum of the weights;
            ``"none"``.
        reward_scale: Factor of the rewards in the loss. The signals are divided by it again, so
            that they stay in the units of the environment's reward, as Eq. (12) is.
        saturation_penalty: Factor of the mean of :math:`\max(0, |u| - l)^2`, added to the actor's
            loss, where :math:`u` is the action before its tanh (``"preactivation"``).
        saturation_limit: The limit :math:`l`.
        target_average: Number of critics of which the target's Q is the mean: the target critic
            and what it was at the last calls of :meth:`keep_target_critics`; 1 is Eq. (5).
        pal_alpha: Priority exponent :math:`\alpha` that the loss function ``"pal"`` stands for.
        **kwargs: Passed to TorchRL's loss.

    Raises:
        TypeError: If a network is no module of tensordicts.
        ValueError: If an argument is out of its range, or the networks are in the wrong order.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_ddpg_loss
        >>> loss = make_ddpg_loss(make_actor(24, 2), make_critic(24, 2), signals=["td_error"])
        >>> isinstance(loss, SignalLoss), loss.signals
        (True, ('td_error',))
    """

    loss_function: str
    tensor_keys: Any
    value_estimator: Any
    value_type: Any
    _value_estimator: Any
    _critic_name: ClassVar[str] = "qvalue_network"
    """TorchRL's name of the critic."""

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
        check_importance(importance)
        if kwargs.get("loss_function", "l2") not in DISTANCES:
            raise ValueError(
                f"loss_function must be one of {DISTANCES}, got {kwargs['loss_function']!r}"
            )
        check((lambda order: order > 0, "positive"), gradient_order=gradient_order)
        check(POSITIVE, reward_scale=reward_scale)
        check(NOT_NEGATIVE, saturation_penalty=saturation_penalty)
        check(NOT_NEGATIVE, saturation_limit=saturation_limit, pal_alpha=pal_alpha)
        check_counts(target_average=target_average)
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
            **kwargs,
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
        self._bound: Networks | None = None
        self._deferred: tuple[Tensor, Tensor] | None = None
        """Actions and values, whose gradients the backward pass of the loss will find."""
        # A list of modules, so that the past is saved, loaded and moved with the loss.
        self.past_critics = nn.ModuleList()
        if target_average > 1:
            # Of the current critics, which the target critics equal at the start.
            for network in self._held_critics(""):
                self.past_critics.append(PastCritics(network.module, target_average - 1))

    # Asked for by a learner.

    def losses(
        self,
        batch: TensorDictBase,
        *,
        trains: Trains = "both",
        loss_function: str | None = None,
        defer_gradient: bool = True,
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The losses of an update, with the signal of Eq. (14) deferred.

        Args:
            batch: Transitions, batch size ``[B]``; the critics' loss writes their signals.
            trains: Whose losses are wanted: the ``"critic"``'s, the ``"actor"``'s, or ``"both"``.
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
            options = {"defer_gradient": defer_gradient, "loss_function": loss_function}
            losses["loss_value"], log = self._critics_part(batch, **options)
        if trains != "critic":
            of_actor, more = self._actors_part(batch)
            losses, log = {**losses, **of_actor}, {**log, **more}
        return losses, log

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Any]:
        """Loss of the critics under TorchRL's name for it, and values for the log."""
        raise NotImplementedError

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Loss of the actor, and others by the same batch, by name; and values for the log."""
        raise NotImplementedError

    def write_action_gradient(self, tensordict: TensorDictBase) -> None:
        r"""Write the signal of Eq. (14) that the critics' loss was asked to defer.

        A transition's action enters the loss through its own Q alone, so
        :math:`\nabla_a Q = \nabla_a L / (\partial L / \partial Q)`: the backward pass of the loss
        has found it on its way, and needs no other one before it.

        Args:
            tensordict: The batch that the loss was computed of; nothing happens if it deferred
                nothing.

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
        slope = value.grad[0].unsqueeze(-1)
        gradient = action.grad / slope
        flat = slope == 0
        if bool(flat.any()):  # Where there is no error there is nothing to divide.
            action = action.detach().requires_grad_(True)
            with torch.enable_grad():
                critic = self._networks().frozen_critics[0]
                value = self._q(critic, tensordict, {self.tensor_keys.action: action})
                gradient = torch.where(flat, action_gradient(value, action), gradient)
        self._write_gradient(tensordict, gradient)

    def keep_target_critics(self) -> None:
        """Keep the target critics as they are now for the average that later targets have."""
        if self.past_critics:
            for critic, past in zip(self._held_critics("target_"), self.past_critics, strict=True):
                past.push(critic.module)  # type: ignore[operator]

    def current_critics(self) -> list[TensorDictModule]:
        """The critics as modules of their own, for looking at Q: they get no gradient."""
        return self._held_critics("")

    def actor_parameters(self) -> list[nn.Parameter]:
        """Parameters that the actor's loss moves."""
        return self._parameters_of("actor_network")

    def critic_parameters(self) -> list[nn.Parameter]:
        """Parameters that the critics' loss moves."""
        more = [] if self.noise_network is None else self.noise_network.parameters()
        return [*self._parameters_of(self._critic_name), *more]

    def _parameters_of(self, name: str) -> list[nn.Parameter]:
        flat = getattr(self, f"{name}_params").flatten_keys().values()
        return [value for value in flat if value.requires_grad]

    # The critics' loss, in the order of its steps.

    def _q(self, critic: TensorDictModule, source: TensorDictBase, chosen: Tensors) -> Tensor:
        """Q of a critic, shape ``[B]``, at the states of ``source`` and the actions chosen."""
        found: Tensor = call(critic, source, chosen)[self.tensor_keys.state_action_value]
        return found.squeeze(-1)

    def _values(self, source: TensorDictBase, action: Tensor) -> Tensor:
        """Q of the current critics, ``[C, B]``; the action leads to the first one alone."""
        critic, keys = self._networks().critic, self.tensor_keys
        if not isinstance(critic, StackedNetworks):
            return self._q(critic, source, {keys.action: action}).unsqueeze(0)
        others = [action.detach()] * (len(self._networks().target_critics) - 1)
        found = critic.call(source, [{keys.action: each} for each in (action, *others)])
        return torch.stack([out[keys.state_action_value].squeeze(-1) for out in found])

    def _stored_values(self, tensordict: TensorDictBase, *, defer_gradient: bool) -> Tensor:
        """Q of the stored actions, ``[C, B]``; writes its slope (Eq. 14), or defers that."""
        self._deferred = None
        with_slope = ACTION_GRADIENT.name in self.signals
        differentiable = torch.is_grad_enabled()
        action = tensordict[self.tensor_keys.action].detach()
        # The slope is wanted under no_grad as well, when a loss is only looked at.
        with torch.set_grad_enabled(with_slope or differentiable):
            if with_slope:
                action.requires_grad_(True)  # A detached alias: the batch itself is not touched.
            value = self._values(tensordict, action)
            if with_slope and defer_gradient and differentiable:
                value.retain_grad()
                self._deferred = action, value
            elif with_slope:
                self._write_gradient(tensordict, action_gradient(value[0], action))
        return value if differentiable else value.detach()

    def _target(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        """Targets by the loss's value estimator, Eq. (5) unless told otherwise, shape ``[B]``."""
        after, keys, estimator = tensordict["next"], self.tensor_keys, self.value_estimator
        if not self.bootstraps_once:
            scaled = scale_rewards(tensordict, keys, self.reward_scale)
            longer: Tensor = estimator.value_estimate(scaled, next_value=next_value.unsqueeze(-1))
            return longer.squeeze(-1)
        steps = tensordict.get(estimator.tensor_keys.steps_to_next_obs, None)
        reward = after[keys.reward] * self.reward_scale
        return bootstrap_target(
            reward.reshape(next_value.shape),
            next_value,
            after[keys.terminated].reshape(next_value.shape),
            gamma=estimator.gamma,
            steps=None if steps is None else steps.reshape(next_value.shape),
        )

    def _write_signals(self, tensordict: TensorDictBase, td_error: Tensor, value: Tensor) -> None:
        """Write ``|TD error|`` (Eq. 13), the largest of the critics, and Q of the first."""
        if TD_ERROR.name in self.signals:
            size = td_error_priority(td_error).amax(0)
            tensordict.set(self.tensor_keys.td_error_signal, size / self.reward_scale)
        if VALUE in self.signals:
            tensordict.set(self.tensor_keys.value_signal, value[0].detach() / self.reward_scale)

    def _write_gradient(self, tensordict: TensorDictBase, gradient: Tensor) -> None:
        """Write the norm of the gradient of the first critic (Eq. 14)."""
        size = action_gradient_priority(gradient, order=self.gradient_order)
        tensordict.set(self.tensor_keys.action_gradient_signal, size / self.reward_scale)

    def _critic_mean(
        self, tensordict: TensorDictBase, value: Tensor, target: Tensor, loss_function: str | None
    ) -> Tensor:
        """Loss of the critics (Eq. 4), with the importance weights of Eq. (11) or TorchRL's."""
        loss = critic_loss(
            value,
            target,
            loss_function or self.loss_function,
            unit=self.reward_scale,
            pal_alpha=self.pal_alpha,
        )
        if self.noise_network is not None:
            loss = loss + self._noise_loss(tensordict, (target - value).detach(), target)
        if self.importance == "critic":
            weight = tensordict.get(self.tensor_keys.priority_weight, None)
            if weight is not None:
                loss = loss * weight.reshape(loss.shape).to(loss.device)
        return self._mean(tensordict, loss)

    def _noise_loss(self, tensordict: TensorDictBase, td_error: Tensor, target: Tensor) -> Tensor:
        """Loss of the quantiles of the targets, ``[B]``; writes the information gain."""
        quantiles = call(self.noise_network, tensordict)[self.tensor_keys.state_action_value]
        least = LEAST_NOISE * self.reward_scale
        gain = information_gain_priority(td_error, quantiles.detach(), least_noise=least)
        tensordict.set(self.tensor_keys.information_gain_signal, gain)
        return quantile_loss(quantiles, target)

    def _mean(self, tensordict: TensorDictBase, loss: Tensor) -> Tensor:
        """Mean over the batch; with ``importance="torchrl"`` by TorchRL's weights."""
        weights = self._maybe_get_priority_weight(tensordict)  # type: ignore[attr-defined]
        reduced: Tensor = self._reduce_loss(loss, tensordict=tensordict, weights=weights)  # type: ignore[attr-defined]
        return reduced

    # The actor's loss.

    def _actor_mean(
        self, tensordict: TensorDictBase, loss: Tensor, chosen: Tensors
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean of the losses ``[B]`` of an actor, with the penalty on saturation; and its log."""
        keys = self.tensor_keys
        loss = trusted_loss(loss, chosen[keys.action], read_trust(tensordict))
        mean = self._mean(tensordict, loss)
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

    # The estimator of the targets.

    @property
    def bootstraps_once(self) -> bool:
        """Whether a target needs its own transition alone, as in Eq. (5)."""
        estimator = self.value_estimator
        return type(estimator) is TD0Estimator and not estimator.average_rewards

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """As in TorchRL: set how targets are made, by TD(0), TD(1) or TD(lambda).

        Args:
            value_type: A member of :class:`~torchrl.objectives.ValueEstimators`, or an estimator.
            **hyperparams: Of the estimator; ``gamma`` among them.

        Raises:
            ValueError: If it is another estimator.
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
        if self._bound is None:
            actor, params = self.actor_network, self.actor_network_params  # type: ignore[attr-defined]
            target = self.target_actor_network_params  # type: ignore[attr-defined]
            critic, of_critic = (
                getattr(self, f"{self._critic_name}{end}") for end in ("", "_params")
            )
            self._bound = Networks(
                actor=bind(actor, params),
                critic=(StackedNetworks if of_critic.batch_size else bind)(critic, of_critic),
                frozen_critics=self._held_critics(""),
                target_actor=bind(actor, target).requires_grad_(False),
                target_critics=average(self._held_critics("target_"), self.past_critics),
            )
        return self._bound

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        """Critics that hold the parameters whose name has this prefix, and get no gradient."""
        name = self._critic_name
        return bind_frozen(getattr(self, name), getattr(self, f"{prefix}{name}_params"))

    def forget_networks(self) -> None:
        """Have the networks that hold the parameters made again: those lie elsewhere now."""
        self._bound = None

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        self._bound = None
        return super()._apply(*args, **kwargs)  # type: ignore[misc]

    def train(self, mode: bool = True) -> Any:
        """Set training mode, of the networks that the loss holds too."""
        self._bound = None
        return super().train(mode)  # type: ignore[misc]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bound": None, "_deferred": None}
