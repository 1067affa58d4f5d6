"""All gradients of an update as one function of tensors, of which a program can be made.

What it computes is what the losses do, by the same functions
(:mod:`torchrl_mpfa.losses.functional`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call, grad, grad_and_value

from torchrl_mpfa.losses.base import VALUE
from torchrl_mpfa.losses.functional import (
    Trust,
    bootstrap_target,
    critic_loss,
    least_value,
    read_trust,
    saturation,
    smoothed_action,
    trusted_loss,
)
from torchrl_mpfa.losses.parts import Parts
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import action_gradient_priority, td_error_priority
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

Parameters = dict[str, Tensor]
State = Mapping[NestedKey, Tensor]


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
    bend: Tensor | None


class Inputs(NamedTuple):
    """What an update is computed from; None where a loss is not wanted."""

    transitions: Transitions | None
    actor_state: State | None
    loss_function: str
    trust: Trust | None


class Found(NamedTuple):
    """What an update computes before any network moves; gradients and signals by name."""

    of_critic: Parameters
    of_actor: Parameters
    signals: Parameters
    log: Parameters


class Gradients:
    """Gradients of critics and actor, signals, and values for the log, of one batch.

    Args:
        loss: The loss.

    Raises:
        ValueError: If the loss does what this cannot.
    """

    def __init__(self, loss: Any) -> None:
        _check(loss)
        self._loss = loss
        self.parts: Parts = loss.parts()
        self._scale, self._pal_alpha = loss.reward_scale, loss.pal_alpha
        self._order, self._with_slope = loss.gradient_order, ACTION_GRADIENT.name in loss.signals
        self._penalty, self._limit = loss.saturation_penalty, loss.saturation_limit
        keys = loss.tensor_keys
        self._action, self._value = keys.action, keys.state_action_value
        self._preactivation = keys.preactivation

    def inputs(self, batch: TensorDictBase, trains: Trains, loss_function: str | None) -> Inputs:
        """Read a batch.

        Args:
            batch: Transitions, batch size ``[B]``.
            trains: Whose losses are differentiated.
            loss_function: Distance of the critics' loss; None: the loss's own.

        Returns:
            What :meth:`__call__` wants.

        Raises:
            KeyError: If the batch lacks an entry.
            ValueError: If the loss has got a value estimator of several steps meanwhile.
        """
        _check_estimator(self._loss)
        return Inputs(
            transitions=None if trains == "actor" else self._transitions(batch),
            actor_state=None if trains == "critic" else self._state(batch),
            loss_function=loss_function or self._loss.loss_function,
            trust=None if trains == "critic" else read_trust(batch),
        )

    def write_signals(self, batch: TensorDictBase, signals: Parameters) -> None:
        """Write the signals that the loss is to write in a batch."""
        keys = self._loss.tensor_keys
        for name, key in (
            (TD_ERROR.name, keys.td_error_signal),
            (ACTION_GRADIENT.name, keys.action_gradient_signal),
            (VALUE, keys.value_signal),
        ):
            if name in self._loss.signals and name in signals:
                batch.set(key, signals[name])

    @torch.no_grad()
    def __call__(
        self,
        actor: Parameters,
        critics: Parameters,
        target_actor: Parameters,
        target_critics: Parameters,
        given: Inputs,
    ) -> Found:
        """Differentiate; a pure function.

        Args:
            actor: Parameters of the actor by name.
            critics: Parameters of the critics by name; of several they are stacked, ``[C, ...]``.
            target_actor: Parameters of the target actor.
            target_critics: Parameters of the target critics.
            given: What it is computed from.

        Returns:
            Gradients by name, signals, and values for the log.
        """
        of_critic: Parameters = {}
        of_actor: Parameters = {}
        signals: Parameters = {}
        log: Parameters = {}
        if given.transitions is not None:
            after, noise = given.transitions.after, given.transitions.noise
            next_value = self._next_value(target_actor, target_critics, after, noise)
            of_critic, signals, log = self._critics_part(
                critics, given.transitions, next_value, given.loss_function
            )
        if given.actor_state is not None:
            of_actor, more = self._actors_part(actor, critics, given.actor_state, given.trust)
            log = {**log, **more}
        return Found(of_critic, of_actor, signals, log)

    def _state(self, source: TensorDictBase) -> State:
        """What actor and critics read beside the action."""
        parts = self.parts
        inputs = {*parts.actor.in_keys, *parts.critic.in_keys} - {self._action}
        return {key: source[key] for key in inputs}

    def _transitions(self, batch: TensorDictBase) -> Transitions:
        loss, keys, noise = self._loss, self._loss.tensor_keys, self.parts.target_noise
        after, action = batch["next"], batch[self._action]
        steps = batch.get(loss.value_estimator.tensor_keys.steps_to_next_obs, None)
        weight = batch.get(keys.priority_weight, None) if loss.importance == "critic" else None
        bend = batch.get(keys.bend, None)
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
            bend=None if bend is None else bend.reshape(-1),
        )

    def _critics_part(
        self,
        critic_parameters: Parameters,
        given: Transitions,
        next_value: Tensor,
        loss_function: str,
    ) -> tuple[Parameters, Parameters, Parameters]:
        """Gradients of the critics (Eq. 11), signals (Eqs. 13-14), and values for the log."""
        parts, module = self.parts, self.parts.critic.module
        state, action, weight = given.state, given.action, given.weight
        unit = self._scale * (1.0 if given.bend is None else given.bend)
        target = bootstrap_target(
            given.reward * self._scale,
            next_value,
            given.terminated,
            gamma=given.gamma,
            steps=given.steps,
        )

        def of_critics(parameters: Parameters) -> tuple[Tensor, Tensor]:
            each = [self._outputs(_with(module, p), state, action) for p in parts.split(parameters)]
            value = torch.stack([out[self._value].squeeze(-1) for out in each])
            loss = critic_loss(
                value,
                target,
                loss_function,
                unit=unit,
                pal_alpha=self._pal_alpha,
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
        self,
        actor_parameters: Parameters,
        critic_parameters: Parameters,
        state: State,
        trust: Trust | None,
    ) -> tuple[Parameters, Parameters]:
        """Gradients of the actor, by the first critic, and values for the log."""
        actor, first = self.parts.actor.module, self._first(critic_parameters)

        def of_policy(parameters: Parameters) -> tuple[Tensor, Parameters]:
            chosen = self._chosen(_with(actor, parameters), state)
            value = self._q(first, state, chosen[self._action])
            loss = trusted_loss(-value, chosen[self._action], trust).mean()
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
        parts = self.parts
        return _with(parts.critic.module, parts.split(critic_parameters)[0])

    def _next_value(
        self, actor: Parameters, critics: Parameters, after: State, noise: Tensor | None
    ) -> Tensor:
        """Value of the next states in the targets, of the least critic, shape ``[B]``."""
        parts = self.parts
        chosen = self._chosen(_with(parts.target_actor.module, actor), after)[self._action]
        if noise is not None and parts.action_bounds is not None:
            low, high = parts.action_bounds
            chosen = smoothed_action(chosen, noise, low=low, high=high)
        each = [
            self._q(_with(critic.module, own), after, chosen)
            for critic, own in zip(parts.target_critics, parts.of_targets(critics), strict=True)
        ]
        return least_value(torch.stack(each))

    def _q(self, critic: Callable[..., Any], state: State, action: Tensor) -> Tensor:
        """Q of a critic, shape ``[B]``."""
        return self._outputs(critic, state, action)[self._value].squeeze(-1)

    def _outputs(
        self, critic: Callable[..., Any], state: State, action: Tensor
    ) -> dict[NestedKey, Tensor]:
        """What a critic gives."""
        given, critics = {**state, self._action: action}, self.parts.critic
        return critics.by_key(critic(*[given[key] for key in critics.in_keys]))

    def _chosen(self, actor: Callable[..., Any], state: State) -> dict[NestedKey, Tensor]:
        """What a policy gives."""
        actors = self.parts.actor
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
