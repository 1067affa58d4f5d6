"""All gradients of an update as one function of tensors, which ``torch.compile`` makes one program.

With networks of a hundred units an update is mostly the cost of calling some four hundred small
operations; as one program it takes a third of the time. It computes what the losses compute.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call, grad, grad_and_value
from torchrl.objectives import ValueEstimators

from torchrl_mpfa.losses.ddpg import SignalDDPGLoss, bootstrap_target
from torchrl_mpfa.losses.distances import distance
from torchrl_mpfa.losses.options import VALUE, saturation
from torchrl_mpfa.losses.td3 import SignalTD3Loss
from torchrl_mpfa.networks import DirectModule
from torchrl_mpfa.priorities import action_gradient_priority, td_error_priority
from torchrl_mpfa.signals import ACTION_GRADIENT, TD_ERROR

Parameters = dict[str, Tensor]
State = Mapping[NestedKey, Tensor]


class WholeGradients:
    """Sets the gradients of all parameters and writes the signals, in one call.

    Args:
        loss: The loss; its networks must not move to another device later.
        compile: Arguments of ``torch.compile``; None: not compiled, which only a test wants.

    Raises:
        ValueError: If the loss does what this cannot.
    """

    def __init__(
        self, loss: SignalDDPGLoss | SignalTD3Loss, *, compile: dict[str, Any] | None
    ) -> None:
        _check(loss)
        self._loss, self._parts = loss, loss.parts()
        self._actor_parameters = dict(self._parts.actor.module.named_parameters())
        self._gamma = float(loss.value_estimator.gamma)
        self._scale: float = loss.reward_scale
        self._order, self._at_policy = loss.gradient_order, loss.gradient_at == "policy"
        self._penalty, self._limit = loss.saturation_penalty, loss.saturation_limit
        keys = loss.tensor_keys
        self._action, self._value = keys.action, keys.state_action_value
        self._preactivation = keys.preactivation
        self._call: Callable[..., Any] = self._gradients
        if compile is not None:
            self._call = torch.compile(self._gradients, fullgraph=True, dynamic=False, **compile)

    def __call__(
        self,
        batch: TensorDictBase,
        *,
        actor_batch: TensorDictBase | None,
        loss_function: str | None = None,
    ) -> dict[str, Tensor]:
        """Differentiate.

        Args:
            batch: Transitions, batch size ``[B]``; gets its signals.
            actor_batch: What the actor learns from; None: its parameters get no gradients.
            loss_function: Distance of the critic's loss; None: the loss's own.

        Returns:
            Detached values for the log.
        """
        loss, parts, keys = self._loss, self._parts, self._loss.tensor_keys
        inputs = {*parts.actor.in_keys, *parts.critic.in_keys} - {self._action}
        after, action = batch["next"], batch[self._action]
        weight = batch.get(keys.priority_weight, None) if loss.importance == "critic" else None
        of_critic, of_actor, signals, log = self._call(
            self._actor_parameters,
            parts.critic_parameters,
            {key: batch[key] for key in inputs},
            action,
            {key: after[key] for key in inputs},
            after[keys.reward].reshape(-1),
            after[keys.terminated].reshape(-1),
            weight=None if weight is None else weight.reshape(-1),
            noise=loss.target_noise(action) if isinstance(loss, SignalTD3Loss) else None,
            actor_state=None if actor_batch is None else {key: actor_batch[key] for key in inputs},
            loss_function=loss_function or loss.loss_function,
            with_slope=ACTION_GRADIENT.name in loss.signals,
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
            if name in loss.signals:
                batch.set(key, signals[name])
        return dict(log)

    @torch.no_grad()
    def _gradients(
        self,
        actor_parameters: Parameters,
        critic_parameters: Parameters,
        state: State,
        action: Tensor,
        after: State,
        reward: Tensor,
        terminated: Tensor,
        *,
        weight: Tensor | None,
        noise: Tensor | None,
        actor_state: State | None,
        loss_function: str,
        with_slope: bool,
    ) -> tuple[Parameters, Parameters, Parameters, Parameters]:
        """Gradients of critics and actor, signals, and values for the log; a pure function."""
        parts, module = self._parts, self._parts.critic.module
        target = self._target(after, reward, terminated, noise)

        def critic_loss(parameters: Parameters) -> tuple[Tensor, Tensor]:
            each = [self._q(_with(module, p), state, action) for p in parts.split(parameters)]
            value = torch.stack(each)
            loss = distance(value, target.expand_as(value), loss_function, unit=self._scale).sum(0)
            return (loss if weight is None else loss * weight).mean(), value

        of_critic, (loss_value, value) = grad_and_value(critic_loss, has_aux=True)(
            critic_parameters
        )
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
        first = _with(module, parts.split(critic_parameters)[0])
        if with_slope:
            actor = _with(parts.actor.module, actor_parameters)
            at = self._chosen(actor, state)[self._action] if self._at_policy else action
            slope = grad(lambda a: self._q(first, state, a).sum())(at)
            size = action_gradient_priority(slope, order=self._order)
            signals[ACTION_GRADIENT.name] = size / self._scale
        if actor_state is None:
            return of_critic, {}, signals, log

        def actor_loss(parameters: Parameters) -> tuple[Tensor, Parameters]:
            chosen = self._chosen(_with(parts.actor.module, parameters), actor_state)
            loss = -self._q(first, actor_state, chosen[self._action]).mean()
            before = chosen.get(self._preactivation)
            if before is None:
                return loss, {}
            if self._penalty > 0:
                loss = loss + self._penalty * saturation(before, limit=self._limit)
            return loss, {"preactivation": before.abs()}

        of_actor, (log["loss_actor"], more) = grad_and_value(actor_loss, has_aux=True)(
            actor_parameters
        )
        return of_critic, of_actor, signals, {**log, **more}

    def _target(
        self, after: State, reward: Tensor, terminated: Tensor, noise: Tensor | None
    ) -> Tensor:
        """Targets y of Eq. (5), or TD3's with noise and the least of several critics, ``[B]``."""
        parts = self._parts
        chosen = self._chosen(parts.target_actor.module, after)[self._action]
        if noise is not None:
            low, high = parts.action_bounds
            chosen = (chosen + noise).clamp(low, high)
        each = [self._q(critic.module, after, chosen) for critic in parts.target_critics]
        scaled = reward * self._scale
        return bootstrap_target(scaled, torch.stack(each).amin(0), terminated, gamma=self._gamma)

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


def _check(loss: SignalDDPGLoss | SignalTD3Loss) -> None:
    networks = {
        "actor_network": loss.actor_network,
        "critic": loss.value_network if isinstance(loss, SignalDDPGLoss) else loss.qvalue_network,
    }
    for name, network in networks.items():
        if not isinstance(network, DirectModule):
            raise ValueError(
                f"compile needs a DirectModule as {name}, got {type(network).__name__}"
            )
    for name, value, needed in (
        ("value_type", loss.value_type, ValueEstimators.TD0),
        ("reduction", loss.reduction, "mean"),
    ):
        if value != needed:
            raise ValueError(f"compile needs {name} = {needed!r} in the loss, got {value!r}")
    if loss.importance == "torchrl":
        raise ValueError("compile needs importance = 'critic' or 'none', got 'torchrl'")
