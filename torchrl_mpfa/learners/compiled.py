"""All gradients of an update as one function of tensors, which ``torch.compile`` makes one program.

With networks of a hundred units an update is mostly the cost of calling some four hundred small
operations; as one program it takes a third of the time. What it computes is what the losses do,
by the same functions (:mod:`torchrl_mpfa.losses.functional`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call, grad, grad_and_value

from torchrl_mpfa.learners.base import ActorCriticLearner
from torchrl_mpfa.losses.base import SignalLoss
from torchrl_mpfa.losses.calling import Parts
from torchrl_mpfa.losses.functional import (
    bootstrap_target,
    critic_loss,
    least_value,
    saturation,
    smoothed_action,
)
from torchrl_mpfa.losses.writing import VALUE
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import action_gradient_priority, td_error_priority
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

Parameters = dict[str, Tensor]
State = Mapping[NestedKey, Tensor]


class CompilableLearner(ActorCriticLearner):
    """A learner whose update can be one compiled program.

    Args:
        loss: The loss with its networks in it.
        compile: Whether ``torch.compile`` makes one program of an update, or the arguments for it.
            It needs a C++ compiler and half a minute, and takes a third of the time for networks of
            64 units. The networks must stay on their device.
        **kwargs: Options of :class:`~torchrl_mpfa.learners.ActorCriticLearner`: ``actor_lr``,
            ``critic_lr``, ``critic_weight_decay``, ``tau``, ``optimizer``.

    Raises:
        TypeError: If the loss is another learner's.
        ValueError: If an argument is out of its range, or the loss cannot be compiled.
    """

    def __init__(
        self, loss: SignalLoss, *, compile: bool | dict[str, Any] = False, **kwargs: Any
    ) -> None:
        super().__init__(loss, **kwargs)
        self._compiled: CompiledGradients | None = None
        if compile:
            arguments = compile if isinstance(compile, dict) else {}
            self._compiled = CompiledGradients(loss, compile=arguments)

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        if self._compiled is None:
            return super()._differentiate(batch, trains, loss_function)
        return self._compiled(batch, trains=trains, loss_function=loss_function)


class Transitions(NamedTuple):
    """What the critics' loss is computed from, rows first."""

    state: State
    action: Tensor
    after: State
    reward: Tensor
    terminated: Tensor
    gamma: Tensor
    steps: Tensor | None
    weight: Tensor | None
    noise: Tensor | None


class CompiledGradients:
    """Sets the gradients of all parameters and writes the signals, in one call.

    Args:
        loss: The loss; its networks must not move to another device later.
        compile: Arguments of ``torch.compile``; None: not compiled, which only a test wants.

    Raises:
        ValueError: If the loss does what this cannot.
    """

    def __init__(self, loss: Any, *, compile: dict[str, Any] | None) -> None:
        _check(loss)
        self._loss = loss
        self._parts: Parts = loss.parts()
        self._actor_parameters = dict(self._parts.actor.module.named_parameters())
        self._scale, self._pal_alpha = loss.reward_scale, loss.pal_alpha
        self._order, self._with_slope = loss.gradient_order, ACTION_GRADIENT.name in loss.signals
        self._penalty, self._limit = loss.saturation_penalty, loss.saturation_limit
        keys = loss.tensor_keys
        self._action, self._value = keys.action, keys.state_action_value
        self._preactivation = keys.preactivation
        self._call: Callable[..., Any] = self._gradients
        if compile is not None:
            # Apart from other learners, whose recompilations would count against this one's limit.
            self._call = torch.compile(
                self._gradients,
                fullgraph=True,
                dynamic=False,
                **{"isolate_recompiles": True, **compile},
            )

    def __call__(
        self,
        batch: TensorDictBase,
        *,
        trains: Trains = "both",
        loss_function: str | None = None,
    ) -> dict[str, Tensor]:
        """Differentiate.

        Args:
            batch: Transitions, batch size ``[B]``; gets its signals, unless ``trains`` is
                ``"actor"``.
            trains: Whose losses are differentiated; the other's parameters get no gradients.
            loss_function: Distance of the critics' loss; None: the loss's own.

        Returns:
            Detached values for the log.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If the loss has got a value estimator of several steps meanwhile.
        """
        loss, parts, keys = self._loss, self._parts, self._loss.tensor_keys
        _check_estimator(loss)
        of_critic, of_actor, signals, log = self._call(
            self._actor_parameters,
            parts.critic_parameters,
            transitions=None if trains == "actor" else self._transitions(batch),
            actor_state=None if trains == "critic" else self._state(batch),
            loss_function=loss_function or loss.loss_function,
        )
        for parameters, gradients in (
            (parts.critic_parameters, of_critic),
            (self._actor_parameters, of_actor),
        ):
            for name, parameter in parameters.items():
                parameter.grad = gradients.get(name)
        for name, key in (
            (TD_ERROR.name, keys.td_error_signal),
            (ACTION_GRADIENT.name, keys.action_gradient_signal),
            (VALUE, keys.value_signal),
        ):
            if name in loss.signals and trains != "actor":
                batch.set(key, signals[name])
        return dict(log)

    def _state(self, source: TensorDictBase) -> State:
        """What actor and critics read beside the action."""
        parts = self._parts
        inputs = {*parts.actor.in_keys, *parts.critic.in_keys} - {self._action}
        return {key: source[key] for key in inputs}

    def _transitions(self, batch: TensorDictBase) -> Transitions:
        loss, keys, noise = self._loss, self._loss.tensor_keys, self._parts.target_noise
        after, action = batch["next"], batch[self._action]
        steps = batch.get(loss.value_estimator.tensor_keys.steps_to_next_obs, None)
        weight = batch.get(keys.priority_weight, None) if loss.importance == "critic" else None
        return Transitions(
            state=self._state(batch),
            action=action,
            after=self._state(after),
            reward=after[keys.reward].reshape(-1),
            terminated=after[keys.terminated].reshape(-1),
            gamma=loss.value_estimator.gamma,
            steps=None if steps is None else steps.reshape(-1),
            weight=None if weight is None else weight.reshape(-1),
            noise=None if noise is None else noise(action),
        )

    @torch.no_grad()
    def _gradients(
        self,
        actor_parameters: Parameters,
        critic_parameters: Parameters,
        *,
        transitions: Transitions | None,
        actor_state: State | None,
        loss_function: str,
    ) -> tuple[Parameters, Parameters, Parameters, Parameters]:
        """Gradients of critics and actor, signals, and values for the log; a pure function."""
        of_critic: Parameters = {}
        of_actor: Parameters = {}
        signals: Parameters = {}
        log: Parameters = {}
        if transitions is not None:
            of_critic, signals, log = self._critics_part(
                critic_parameters, transitions, loss_function
            )
        if actor_state is not None:
            of_actor, more = self._actors_part(actor_parameters, critic_parameters, actor_state)
            log = {**log, **more}
        return of_critic, of_actor, signals, log

    def _critics_part(
        self, critic_parameters: Parameters, given: Transitions, loss_function: str
    ) -> tuple[Parameters, Parameters, Parameters]:
        """Gradients of the critics (Eq. 11), signals (Eqs. 13-14), and values for the log."""
        parts, module = self._parts, self._parts.critic.module
        state, action, weight = given.state, given.action, given.weight
        target = bootstrap_target(
            given.reward * self._scale,
            self._next_value(given.after, given.noise),
            given.terminated,
            gamma=given.gamma,
            steps=given.steps,
        )

        def of_critics(parameters: Parameters) -> tuple[Tensor, Tensor]:
            each = [self._q(_with(module, p), state, action) for p in parts.split(parameters)]
            value = torch.stack(each)
            loss = critic_loss(
                value, target, loss_function, unit=self._scale, pal_alpha=self._pal_alpha
            )
            return (loss if weight is None else loss * weight).mean(), value

        of_critic, (loss_value, value) = grad_and_value(of_critics, has_aux=True)(critic_parameters)
        td_error = target - value
        signals = {
            TD_ERROR.name: td_error_priority(td_error).amax(0) / self._scale,
            VALUE: value[0] / self._scale,
        }
        log = {
            "loss_value": loss_value,
            "td_error": td_error.square(),
            "pred_value": value,
            "target_value": target,
        }
        if self._with_slope:
            first = self._first(critic_parameters)
            slope = grad(lambda a: self._q(first, state, a).sum())(action)
            size = action_gradient_priority(slope, order=self._order)
            signals[ACTION_GRADIENT.name] = size / self._scale
        return of_critic, signals, log

    def _actors_part(
        self, actor_parameters: Parameters, critic_parameters: Parameters, state: State
    ) -> tuple[Parameters, Parameters]:
        """Gradients of the actor, by the first critic, and values for the log."""
        actor, first = self._parts.actor.module, self._first(critic_parameters)

        def of_policy(parameters: Parameters) -> tuple[Tensor, Parameters]:
            chosen = self._chosen(_with(actor, parameters), state)
            loss = -self._q(first, state, chosen[self._action]).mean()
            before = chosen.get(self._preactivation)
            if before is None:
                return loss, {}
            if self._penalty > 0:
                loss = loss + self._penalty * saturation(before, limit=self._limit)
            return loss, {"preactivation": before.abs()}

        of_actor, (loss, more) = grad_and_value(of_policy, has_aux=True)(actor_parameters)
        return of_actor, {"loss_actor": loss, **more}

    def _first(self, critic_parameters: Parameters) -> Callable[..., Any]:
        """The first critic, whose slope counts."""
        parts = self._parts
        return _with(parts.critic.module, parts.split(critic_parameters)[0])

    def _next_value(self, after: State, noise: Tensor | None) -> Tensor:
        """Value of the next states in the targets, of the least critic, shape ``[B]``."""
        parts = self._parts
        chosen = self._chosen(parts.target_actor.module, after)[self._action]
        if noise is not None and parts.action_bounds is not None:
            low, high = parts.action_bounds
            chosen = smoothed_action(chosen, noise, low=low, high=high)
        each = [self._q(critic.module, after, chosen) for critic in parts.target_critics]
        return least_value(torch.stack(each))

    def _q(self, critic: Callable[..., Any], state: State, action: Tensor) -> Tensor:
        """Q of a critic, shape ``[B]``."""
        given, critics = {**state, self._action: action}, self._parts.critic
        found = critics.by_key(critic(*[given[key] for key in critics.in_keys]))
        return found[self._value].squeeze(-1)

    def _chosen(self, actor: Callable[..., Any], state: State) -> dict[NestedKey, Tensor]:
        """What a policy gives."""
        actors = self._parts.actor
        return actors.by_key(actor(*[state[key] for key in actors.in_keys]))


def _with(module: nn.Module, parameters: Parameters) -> Callable[..., Any]:
    """The module with other parameters, as a function of its inputs."""
    return lambda *inputs: functional_call(module, parameters, inputs)


def _check(loss: Any) -> None:
    for name in ("actor_network", loss._critic_name):
        network = getattr(loss, name)
        if not isinstance(network, DirectModule):
            raise ValueError(
                f"compile needs a DirectModule as {name}, got {type(network).__name__}"
            )
    _check_estimator(loss)
    if loss.reduction != "mean":
        raise ValueError(f"compile needs reduction = 'mean' in the loss, got {loss.reduction!r}")
    if loss.importance == "torchrl":
        raise ValueError("compile needs importance = 'critic' or 'none', got 'torchrl'")
    if loss.saturation_penalty > 0:
        key, written = loss.tensor_keys.preactivation, loss.actor_network.out_keys
        if key not in written:
            raise ValueError(
                f"saturation_penalty is {loss.saturation_penalty}, but the actor writes no {key!r}"
            )


def _check_estimator(loss: Any) -> None:
    if not loss.bootstraps_once:
        raise ValueError(
            "compile needs the value estimator TD0 without average_rewards in the loss, got "
            f"{type(loss.value_estimator).__name__}"
        )
