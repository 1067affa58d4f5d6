"""What the losses of this package share: their options, the signals, and the critics' loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE, check, check_counts
from torchrl_mpfa.losses.averaging import AveragedNetwork, PastCritics
from torchrl_mpfa.losses.calling import Tensors, call, read_inputs
from torchrl_mpfa.losses.functional import DISTANCES, action_gradient, critic_loss, saturation
from torchrl_mpfa.losses.refusals import check_networks
from torchrl_mpfa.losses.targets import EstimatedTargets
from torchrl_mpfa.losses.trust import read_trust, trusted_loss
from torchrl_mpfa.losses.writing import DEFAULT_SIGNALS, WRITTEN, SignalWriting
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import ACTION_GRADIENT

Importance = Literal["critic", "torchrl", "none"]


class CriticStep(NamedTuple):
    """The loss of the critics, and what it was computed from."""

    loss: Tensor
    value: Tensor
    """Q of each critic, shape ``[C, B]``."""
    td_error: Tensor
    """Target less value, shape ``[C, B]``."""
    target: Tensor
    """Shape ``[B]``."""
    next_value: Tensor
    """Value of the next state in the target, shape ``[B]``."""


class SignalLoss(SignalWriting, EstimatedTargets):
    r"""Options of the losses that write signals; mixed into one of TorchRL's.

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|` (Eq. 13) and
    ``("signals", "action_gradient")`` :math:`= \lVert \nabla_a Q(s_i, a_i) \rVert` (Eq. 14), each
    of shape ``[B]``. Where TorchRL's ``MultiStepTransform`` has written ``"steps_to_next_obs"``,
    the target is :math:`r_i + \gamma^{n_i} Q'`.

    Args:
        actor_network: Policy; reads observations, writes ``"action"``.
        critic_network: Critic; reads observations and action, writes ``"state_action_value"``.
        signals: Which of ``"td_error"``, ``"action_gradient"`` and ``"value"`` (Q itself) to write.
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
    _critic_name: ClassVar[str]
    """TorchRL's name of the critic."""

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule,
        *,
        signals: Sequence[str] = DEFAULT_SIGNALS,
        gradient_order: float = 2.0,
        importance: Importance = "critic",
        reward_scale: float = 1.0,
        saturation_penalty: float = 0.0,
        saturation_limit: float = 1.5,
        target_average: int = 1,
        pal_alpha: float = 0.4,
        **kwargs: Any,
    ) -> None:
        # Before TorchRL's constructor changes the networks.
        check_networks(actor_network, critic_network, critic_name=self._critic_name)
        unknown = [name for name in signals if name not in WRITTEN]
        if unknown:
            raise ValueError(f"signals must be among {WRITTEN}, got {unknown}")
        if importance not in ("critic", "torchrl", "none"):
            raise ValueError(
                f"importance must be 'critic', 'torchrl' or 'none', got {importance!r}"
            )
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
        super().__init__(
            actor_network,
            critic_network,
            use_prioritized_weights="auto" if importance == "torchrl" else False,
            **kwargs,
        )  # type: ignore[call-arg]
        self.signals = tuple(signals)
        self.gradient_order = gradient_order
        self.importance: Importance = importance
        self.reward_scale = reward_scale
        self.saturation_penalty = saturation_penalty
        self.saturation_limit = saturation_limit
        self.target_average = target_average
        self.pal_alpha = pal_alpha
        self._bound: Any = None
        self._deferred: tuple[Tensor, Tensor] | None = None
        # A list of modules, so that the past is saved, loaded and moved with the loss.
        self.past_critics = nn.ModuleList()
        if target_average > 1:
            # Of the current critics, which the target critics equal at the start.
            for network in self._held_critics(""):
                self.past_critics.append(PastCritics(network.module, target_average - 1))

    def current_critics(self) -> list[TensorDictModule]:
        """The critics as modules of their own, for looking at Q: they get no gradient."""
        return self._held_critics("")

    # What each loss has of its own.

    def _held_critics(self, prefix: str) -> list[TensorDictModule]:
        """Critics that hold the parameters whose name has this prefix, and get no gradient."""
        raise NotImplementedError

    def _values(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Q of the current critics, ``[C, B]``; the action leads to the first one alone."""
        raise NotImplementedError

    def _next_value(self, after: TensorDictBase) -> Tensor:
        """Value of the next states in the targets, shape ``[B]``."""
        raise NotImplementedError

    def _critics_part(self, batch: TensorDictBase, **options: Any) -> tuple[Tensor, Tensors]:
        """Loss of the critics under TorchRL's name for it, and values for the log."""
        raise NotImplementedError

    def _actors_part(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Loss of the actor, and others by the same batch, by name; and values for the log."""
        raise NotImplementedError

    # What a learner asks for.

    def losses(
        self,
        batch: TensorDictBase,
        *,
        trains: Trains = "both",
        loss_function: str | None = None,
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The losses of an update, with the signal of Eq. (14) deferred.

        Args:
            batch: What is learned from, batch size ``[B]``; the critics' loss writes its signals.
            trains: Whose losses are wanted: the ``"critic"``'s, the ``"actor"``'s, or ``"both"``.
            loss_function: Distance of the critics' loss; None: the loss's own.

        Returns:
            Losses by name, to be summed and differentiated before :meth:`write_action_gradient`;
            and values for the log.
        """
        losses: dict[str, Tensor] = {}
        values: dict[str, Tensor] = {}
        self._deferred = None  # Of an update that failed halfway.
        if trains != "actor":
            loss, log = self._critics_part(batch, defer_gradient=True, loss_function=loss_function)
            losses["loss_value"] = loss
            values.update(log)
        if trains != "critic":
            of_actor, more = self._actors_part(batch)
            losses.update(of_actor)
            values.update(more)
        return losses, values

    def keep_target_critics(self) -> None:
        """Keep the target critics as they are now for the average that later targets have."""
        if self.past_critics:
            for critic, past in zip(self._held_critics("target_"), self.past_critics, strict=True):
                past.push(critic.module)  # type: ignore[operator]

    def actor_parameters(self) -> list[nn.Parameter]:
        """What the actor's loss moves."""
        return self._parameters_of("actor_network")

    def critic_parameters(self) -> list[nn.Parameter]:
        """What the critics' loss moves."""
        return self._parameters_of(self._critic_name)

    def _parameters_of(self, name: str) -> list[nn.Parameter]:
        flat = getattr(self, f"{name}_params").flatten_keys().values()
        return [value for value in flat if value.requires_grad]

    # The critics' loss.

    def _critic_step(
        self, tensordict: TensorDictBase, *, defer_gradient: bool, loss_function: str | None
    ) -> CriticStep:
        """Loss of the critics (Eq. 11); writes the signals (Eqs. 13-14) in ``tensordict``."""
        self._deferred = None
        with_slope = ACTION_GRADIENT.name in self.signals
        differentiable = torch.is_grad_enabled()
        name = loss_function or self.loss_function
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
        if not differentiable:
            value = value.detach()

        with torch.no_grad():
            next_value = self._next_value(tensordict["next"])
            target = self._target(tensordict, next_value)
        td_error = (target - value).detach()
        self._write_signals(tensordict, td_error, value)
        bend = tensordict.get(self.tensor_keys.bend, None)
        loss = critic_loss(
            value,
            target,
            name,
            unit=self.reward_scale * (1.0 if bend is None else bend.reshape(-1)),
            pal_alpha=self.pal_alpha,
        )
        return CriticStep(self._weigh(loss, tensordict), value, td_error, target, next_value)

    def _weigh(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mean over the batch, with the importance weights of Eq. (11), or TorchRL's way."""
        if self.importance == "critic":
            weight = tensordict.get(self.tensor_keys.priority_weight, None)
            if weight is not None:
                loss = loss * weight.reshape(loss.shape).to(loss.device)
        return self._reduce(loss, tensordict)

    def _reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mean over the batch; with ``importance="torchrl"`` by TorchRL's weights."""
        weights = self._maybe_get_priority_weight(tensordict)  # type: ignore[attr-defined]
        reduced: Tensor = self._reduce_loss(loss, tensordict=tensordict, weights=weights)  # type: ignore[attr-defined]
        return reduced

    def _averaged_critics(self) -> list[TensorDictModule]:
        """Target critics, each of them with its past ones if ``target_average`` is above one."""
        critics = self._held_critics("target_")
        if not self.past_critics:
            return critics
        return [
            DirectModule(
                AveragedNetwork(critic.module, past),  # type: ignore[arg-type]
                in_keys=critic.in_keys,
                out_keys=critic.out_keys,
            )
            for critic, past in zip(critics, self.past_critics, strict=True)
        ]

    # The actor's loss.

    def _policy_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Loss of a deterministic actor, the values in it, ``[B]``, and others for the log."""
        networks = self._networks()
        chosen = call(networks.actor, read_inputs(networks.actor, tensordict))
        value = self._value(networks.frozen_critic, tensordict, chosen)
        action = chosen[self.tensor_keys.action]
        loss = self._reduce(trusted_loss(-value, action, read_trust(tensordict)), tensordict)
        loss, log = self._penalize_saturation(loss, chosen.get(self.tensor_keys.preactivation))
        return loss, value.detach(), log

    def _penalize_saturation(
        self, loss: Tensor, preactivation: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Add the penalty on actions before their tanh, ``[B, A]``; give their size for the log."""
        if preactivation is None:
            if self.saturation_penalty > 0:
                raise KeyError(
                    f"saturation_penalty is {self.saturation_penalty}, but the actor writes no "
                    f"{self.tensor_keys.preactivation!r}"
                )
            return loss, {}
        if self.saturation_penalty > 0:
            penalty = saturation(preactivation, limit=self.saturation_limit)
            loss = loss + self.saturation_penalty * penalty
        return loss, {"preactivation": preactivation.detach().abs()}

    def forget_networks(self) -> None:
        """Have the networks that hold the parameters made anew: those lie elsewhere now."""
        self._bound = None

    # The networks hold the parameters of the loss; these may put others in their place.

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        self._bound = None
        return super()._apply(*args, **kwargs)  # type: ignore[misc]

    def train(self, mode: bool = True) -> Any:
        """Set training mode, of the networks that the loss holds too."""
        self._bound = None
        return super().train(mode)  # type: ignore[misc]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bound": None, "_deferred": None}
