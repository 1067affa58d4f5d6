r"""Actor and critics by DDPG, TD3 or SAC: one update from top to bottom (Eqs. 5, 4, 11, 13, 14).

The three differ in four places: the number of critics, the noise on the action of the target, the
delay of the actor, and the entropy of a stochastic actor. ``update`` is that of
:class:`~torchrl_mpfa.learners.optimized.OptimizedLearner`, which calls ``_differentiate`` here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.sac import compute_rsample_log_prob

from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE, SHARE, check, check_counts
from torchrl_mpfa.learners.compiled import CompiledUpdate
from torchrl_mpfa.learners.networks import (
    Tensors,
    as_function,
    check_networks,
    several,
    with_quantiles,
)
from torchrl_mpfa.learners.optimized import IMPORTANCE, OptimizedLearner
from torchrl_mpfa.losses import (
    DISTANCES,
    LEAST_NOISE,
    distance,
    quantile_loss,
    saturation,
    smoothing_noise,
    soft_value,
    target_of,
    trusted_loss,
)
from torchrl_mpfa.networks import StochasticActor
from torchrl_mpfa.networks.bounds import given_bounds
from torchrl_mpfa.priorities import (
    action_gradient_priority,
    information_gain_priority,
    td_error_priority,
)
from torchrl_mpfa.selection import Trains
from torchrl_mpfa.signals import OF_LEARNERS, SIGNALS_KEY

_LEAST_SLOPE = 1e-19
"""Its square is still a normal number in single precision."""


class ActorCritic(OptimizedLearner):
    r"""DDPG, TD3 or SAC: networks, losses, one optimizer, and target networks.

    The critics' loss is Eq. (11), :math:`\frac{1}{N} \sum_i w_i (y_i - Q(s_i, a_i))^2` with the
    target of Eq. (5), :math:`y_i = r_i + \gamma Q'(s_{i+1}, \mu'(s_{i+1}))`; the actor's is
    :math:`-\frac{1}{N} \sum_i Q(s_i, \mu(s_i))`. All gradients of an update are taken at the same
    networks; then all networks take their step, and the target networks follow (Eqs. 4-7). Where
    TorchRL's ``MultiStepTransform`` has written ``"steps_to_next_obs"``, the target is
    :math:`r_i + \gamma^{n_i} Q'`.

    A batch gets ``("signals", "td_error")`` :math:`= |\delta_i|` (Eq. 13), the largest of the
    critics, and ``("signals", "action_gradient")`` :math:`= \lVert \nabla_a Q(s_i, a_i) \rVert`
    (Eq. 14), of the first critic, each of shape ``[B]``; and TorchRL's ``"td_error"``, squared.

    With ``policy_noise`` it is TD3 (Fujimoto et al. 2018, https://arxiv.org/abs/1802.09477). With a
    stochastic actor it is SAC (Haarnoja et al. 2018, https://arxiv.org/abs/1812.05905): the target
    is :math:`r_i + \gamma (\min_k Q'_k(s_{i+1}, a') - \alpha \ln\pi(a' | s_{i+1}))`, the actor's
    loss the mean of :math:`\alpha \ln\pi(a | s_i) - \min_k Q_k(s_i, a)`, and the temperature
    :math:`\alpha` is tuned. Q contains the entropy of later actions, hence so do the signals.

    Args:
        actor: Policy; reads observations, writes ``"action"``. It is held, not copied.
        critic: Critic; reads observations and ``"action"``, writes ``"state_action_value"``.
        critics: Number of critics, of which the target takes the least; by default 2 with a
            stochastic actor or ``policy_noise``, else 1. One is ``critic`` itself; several are
            copies of it with new weights.
        gamma: Discount, in [0, 1].
        policy_noise: Standard deviation of TD3's noise on the target action, in units of the
            action; 0 is Eq. (5).
        noise_clip: Limit of that noise.
        bounds: Bounded spec of the actions, such as ``env.action_spec``; or least and greatest
            action, numbers or tensors of shape ``[A]``. Noise needs them.
        policy_delay: Updates of the critics for one of the actor and of the target networks; by
            default 2 with ``policy_noise``, else 1. A delay steadies a single critic, too.
        alpha: First temperature of SAC. It belongs to scaled rewards: in units of the environment's
            reward it is divided by ``reward_scale``.
        alpha_lr: Learning rate of the temperature's logarithm; 0 leaves it as it is. The
            temperature takes some ``1 / alpha_lr`` updates to change by a factor of e.
        target_entropy: Entropy to which the temperature is tuned; by default minus ``A``.
        signals: Signals to write, of ``"td_error"``, ``"action_gradient"``, ``"value"`` (Q itself)
            and ``"information_gain"``. The last is UPER's. It needs a further network, like the
            critic, that learns the quantiles of the targets: its loss is added to the critics'.
        gradient_order: Order of the norm in Eq. (14).
        importance: Use of ``"priority_weight"``: on the ``"critic"`` alone, divided by the batch
            size (Eq. 11); ``"torchrl"``: on all losses, divided by the sum of the weights;
            ``"none"``.
        loss_function: Distance of value and target: ``"l2"``, ``"l1"``, ``"smooth_l1"``, ``"pal"``.
        pal_alpha: Priority exponent :math:`\alpha` of the distance ``"pal"``.
        reward_scale: Factor of the rewards in the losses. The signals are divided by it again, so
            that they stay in the units of the environment's reward, as Eq. (12) is.
        saturation_penalty: Factor of the mean of :math:`\max(0, |u| - l)^2`, added to the actor's
            loss, where :math:`u` is the (mean) action before its tanh (``"preactivation"``).
        saturation_limit: The limit :math:`l`.
        actor_lr: Learning rate of the actor, Table 1.
        critic_lr: Learning rate of the critics, Table 1.
        critic_weight_decay: L2 decay of the critics' weights. A decay of 1e-2, as in the original
            DDPG paper, was seen to hold Q below the returns.
        tau: :math:`\tau` of Eqs. (6)-(7), Table 1.
        compile: True to make one program of an update by ``torch.compile``, or the arguments for
            it. It needs a C++ compiler and half a minute once (the program is kept on disk), and
            takes half of the time for networks of 64 units. The networks must stay on their device.
            What cannot be compiled stays eager.

    Raises:
        TypeError: If a network is no module of tensordicts.
        ValueError: If an argument is out of its range, or the networks do not fit each other.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic, make_stochastic_actor
        >>> ActorCritic(make_actor(24, 2), make_critic(24, 2)).policy.out_keys
        ['preactivation', 'action']
        >>> td3 = ActorCritic(
        ...     make_actor(24, 2), make_critic(24, 2), policy_noise=0.2, bounds=(-1.0, 1.0)
        ... )
        >>> len(td3.networks["critics"]), td3.policy_delay
        (2, 2)
        >>> ActorCritic(make_stochastic_actor(24, 2), make_critic(24, 2)).stochastic
        True
    """

    def __init__(
        self,
        actor: TensorDictModule,
        critic: TensorDictModule,
        *,
        critics: int | None = None,
        gamma: float = 0.99,
        policy_noise: float = 0.0,
        noise_clip: float = 0.5,
        bounds: Any = None,
        policy_delay: int | None = None,
        alpha: float = 1.0,
        alpha_lr: float = 3e-4,
        target_entropy: float | None = None,
        signals: Sequence[str] = ("td_error", "action_gradient"),
        gradient_order: float = 2.0,
        importance: str = "critic",
        loss_function: str = "l2",
        pal_alpha: float = 0.4,
        reward_scale: float = 1.0,
        saturation_penalty: float = 0.0,
        saturation_limit: float = 1.5,
        actor_lr: float = 1e-4,
        critic_lr: float = 1e-4,
        critic_weight_decay: float = 1e-4,
        tau: float = 0.01,
        compile: bool | dict[str, Any] = False,
    ) -> None:
        check_networks(actor, critic)
        self.stochastic = isinstance(actor, ProbabilisticTensorDictSequential)
        if unknown := [name for name in signals if name not in OF_LEARNERS]:
            raise ValueError(
                f"signals must be among {OF_LEARNERS}, got {unknown}: write a signal of "
                "your own in the batch after update(...)"
            )
        self.signals = tuple(signals)
        if loss_function not in DISTANCES:
            raise ValueError(f"loss_function must be one of {DISTANCES}, got {loss_function!r}")
        self.loss_function = loss_function
        self.importance = check(IMPORTANCE, importance=importance)
        self.gamma = check(SHARE, gamma=gamma)
        self.gradient_order = check((lambda n: n > 0, "positive"), gradient_order=gradient_order)
        self.reward_scale, alpha = check(POSITIVE, reward_scale=reward_scale, alpha=alpha)
        actor_lr, critic_lr = check(POSITIVE, actor_lr=actor_lr, critic_lr=critic_lr)
        alpha_lr, decay = check(
            NOT_NEGATIVE, alpha_lr=alpha_lr, critic_weight_decay=critic_weight_decay
        )
        self.policy_noise, self.noise_clip = check(
            NOT_NEGATIVE, policy_noise=policy_noise, noise_clip=noise_clip
        )
        self.saturation_penalty, self.saturation_limit, self.pal_alpha = check(
            NOT_NEGATIVE,
            saturation_penalty=saturation_penalty,
            saturation_limit=saturation_limit,
            pal_alpha=pal_alpha,
        )
        if self.saturation_penalty > 0 and "preactivation" not in actor.out_keys:
            raise ValueError(
                f"saturation_penalty is {saturation_penalty}, but actor writes no 'preactivation'"
            )
        smooths = self.policy_noise > 0
        count, self.policy_delay = check_counts(
            critics=(2 if self.stochastic or smooths else 1) if critics is None else critics,
            policy_delay=(2 if smooths else 1) if policy_delay is None else policy_delay,
        )
        self.target_entropy = target_entropy
        if target_entropy is not None:
            self.target_entropy = check((math.isfinite, "finite"), target_entropy=target_entropy)
        device = next(critic.parameters()).device
        self.bounds = tuple(end.to(device) for end in given_bounds(bounds)) if smooths else ()

        one = as_function(critic)
        networks: Any = nn.ModuleDict({"actor": as_function(actor)})
        networks["critics"] = nn.ModuleList(several(one, count))
        targets: Any = nn.ModuleDict({name: deepcopy(part) for name, part in networks.items()})
        # Side by side, as TorchRL stacks them: rounding depends on where a number lies.
        layers = zip(*(q.parameters() for q in networks["critics"]), strict=True)
        of_critics = [parameter for layer in layers for parameter in layer]
        # Last, so that the critics start as they would without it.
        if "information_gain" in self.signals:
            networks["noise"] = with_quantiles(one)
            of_critics += networks["noise"].parameters()
        groups = [
            {"params": [*actor.parameters()], "lr": actor_lr},
            {"params": of_critics, "lr": critic_lr, "weight_decay": decay},
        ]
        if self.stochastic:
            del targets["actor"]
            self._log_alpha = nn.Parameter(
                torch.tensor(math.log(alpha), device=device), requires_grad=alpha_lr > 0
            )
            networks["temperature"] = nn.ParameterDict({"log": self._log_alpha})
            groups += [{"params": [self._log_alpha], "lr": alpha_lr}] if alpha_lr > 0 else []
        targets.requires_grad_(False)
        super().__init__(networks, targets, groups, tau)
        self.policy: TensorDictModule = actor
        self._actor_parameters = [*actor.parameters()]
        self._critic_keys = [key for key in critic.in_keys if key != "action"]
        self._state_keys = [*dict.fromkeys([*actor.in_keys, *self._critic_keys])]
        if compile:
            self._program = CompiledUpdate(self, compile if isinstance(compile, dict) else {})

    def _differentiate(
        self, batch: TensorDictBase, trains: Trains, loss_function: str | None
    ) -> dict[str, Tensor]:
        """Set the gradients, write the signals, and return detached values for the log."""
        log: dict[str, Tensor] = {}
        if trains != "actor":
            log |= self._learn_critics(batch, loss_function or self.loss_function)
        if trains != "critic":
            log |= self._learn_actor(batch)
        return log

    # The critics, in the order of Eqs. (5), (4), (11), (13) and (14).

    def _learn_critics(self, batch: TensorDictBase, loss_function: str) -> dict[str, Tensor]:
        """Set the critics' gradients, write the signals, and return values for the log."""
        critics, slopes = self.networks["critics"], "action_gradient" in self.signals
        stored = {key: batch[key].detach() for key in self._critic_keys}
        action = batch["action"].detach().requires_grad_(slopes)
        # What is added to Q gets the gradient by Q.
        shift = action.new_zeros(len(critics), *action.shape[:-1]).requires_grad_(slopes)
        # The slope of the first critic alone is asked for.
        actions = [action, *[action.detach()] * (len(critics) - 1)]
        value = shift + torch.stack(
            [self._value(q, stored, a) for q, a in zip(critics, actions, strict=True)]
        )
        target = self.targets_of(batch)  # Eq. (5)

        scale = self.reward_scale
        losses = distance(
            value, target.expand_as(value), loss_function, unit=scale, pal_alpha=self.pal_alpha
        ).sum(0)  # Eq. (4), of all critics.
        error = (target - value).detach()
        signals = {"td_error": td_error_priority(error).amax(0) / scale}  # Eq. (13)
        if "information_gain" in self.signals:
            inputs = {**stored, "action": action.detach()}
            quantiles = self.networks["noise"].outputs(inputs)["state_action_value"]
            losses = losses + quantile_loss(quantiles, target)
            signals["information_gain"] = information_gain_priority(
                error, quantiles.detach(), least_noise=LEAST_NOISE * scale
            )
        loss = self._mean(losses, batch, weighted=self.importance != "none")  # Eq. (11)
        if slopes:
            # Moves no weight: without error a transition's Q would have no gradient to divide by.
            least = max(_LEAST_SLOPE, torch.finfo(value.dtype).tiny)
            (loss + least * value[0].sum()).backward()
            # A transition's action enters the loss through its own Q alone.
            gradient = action.grad / shift.grad[0].unsqueeze(-1)
            size = action_gradient_priority(gradient, order=self.gradient_order)
            signals["action_gradient"] = size / scale  # Eq. (14)
        else:
            loss.backward()
        value = value.detach()
        signals["value"] = value[0] / scale
        for name in self.signals:
            batch.set((SIGNALS_KEY, name), signals[name])
        squared = error.square()
        batch.set("td_error", squared.amax(0))
        return {
            "loss_value": loss.detach(),
            "td_error": squared,
            "pred_value": value,
            "target_value": target,
            "pred_value_max": value.max(),
            "target_value_max": target.max(),
        }

    @torch.no_grad()
    def targets_of(self, batch: TensorDictBase) -> Tensor:
        """Compute the critics' targets (Eq. 5), shape ``[B]``, in units of scaled rewards."""
        next_states = self._states_of(batch["next"])
        if self.stochastic:
            action, log_density, _ = self._sample(next_states)
            values = self._target_values(next_states, action)
            next_value = soft_value(values, log_density, alpha=self._log_alpha.exp())
        else:
            action = self.targets["actor"].outputs(next_states)["action"]
            if self.policy_noise > 0:
                noise = smoothing_noise(action, deviation=self.policy_noise, limit=self.noise_clip)
                low, high = self.bounds
                action = torch.clamp(action + noise, low, high)
            next_value = self._target_values(next_states, action).amin(0)
        return target_of(batch, next_value, gamma=self.gamma, reward_scale=self.reward_scale)

    def values_of(self, batch: TensorDictBase) -> Tensor:
        """Compute each critic's Q of the actions in a batch, ``[C, B]``, in scaled rewards."""
        stored = {key: batch[key] for key in self._critic_keys}
        critics = self.networks["critics"]
        return torch.stack([self._value(critic, stored, batch["action"]) for critic in critics])

    def _target_values(self, states: Tensors, action: Tensor) -> Tensor:
        """Compute each target critic's Q, ``[C, B]``."""
        critics = self.targets["critics"]
        return torch.stack([self._value(critic, states, action) for critic in critics])

    # The actor.

    def _learn_actor(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Set the gradients of actor and temperature, and return values for the log."""
        states, critics = self._states_of(batch), self.networks["critics"]
        log: dict[str, Tensor] = {}
        if self.stochastic:
            action, log_density, preactivation = self._sample(states)
            values = torch.stack([self._value(critic, states, action) for critic in critics])
            temperature, density = self._log_alpha.detach().exp(), log_density.detach()
            losses = -soft_value(values, log_density, alpha=temperature)
            entropy = -action.shape[-1] if self.target_entropy is None else self.target_entropy
            of_alpha = self._mean(-self._log_alpha * (density + entropy), batch)
            if of_alpha.requires_grad:
                of_alpha.backward()
            log = {
                "loss_alpha": of_alpha.detach(),
                "alpha": temperature,
                "entropy": -density.mean(),
            }
        else:
            chosen = self.networks["actor"].outputs(states)
            action, preactivation = chosen["action"], chosen.get("preactivation")
            losses = -self._value(critics[0], states, action)
        loss = self._mean(trusted_loss(losses, action, batch), batch)
        if self.saturation_penalty > 0 and preactivation is not None:
            excess = saturation(preactivation, limit=self.saturation_limit)
            loss = loss + self.saturation_penalty * excess
        # The critics, through which the gradient flows, get none.
        if moved := [p for p in self._actor_parameters if p.requires_grad]:
            loss.backward(inputs=moved)
        if preactivation is not None:
            log["preactivation"] = preactivation.detach().abs()
        return {"loss_actor": loss.detach(), **log}

    def _sample(self, states: Tensors) -> tuple[Tensor, Tensor, Tensor | None]:
        """Sample actions of a stochastic actor; return log-densities ``[B]`` and means as well."""
        actor: Any = self.policy
        if isinstance(actor, StochasticActor):
            return actor.sample(states)
        outputs = actor.get_dist_params(TensorDict({key: states[key] for key in actor.in_keys}))
        action, log_density = compute_rsample_log_prob(actor.build_dist_from_params(outputs))
        return action, log_density, outputs.get("preactivation", None)

    # What both use.

    def _states_of(self, source: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Read the states in which the actor is to act, without gradients."""
        return {key: source[key].detach() for key in self._state_keys}

    def _value(self, critic: Any, states: Tensors, action: Tensor) -> Tensor:
        """Compute Q of a critic, ``[B]``."""
        value: Tensor = critic.outputs({**states, "action": action})["state_action_value"]
        return value.squeeze(-1)

    def _mean(self, losses: Tensor, batch: TensorDictBase, *, weighted: bool = False) -> Tensor:
        """Average over the batch, with its importance weights if they count."""
        weight = batch.get("priority_weight", None)
        if weight is None or not (weighted or self.importance == "torchrl"):
            return losses.mean()
        weight = weight.reshape(losses.shape).to(losses.device)
        if self.importance == "torchrl":
            return (losses * weight).sum() / weight.sum()
        return (losses * weight).mean()
