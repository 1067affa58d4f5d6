"""Networks, loss and optimizers of a training run, put together from its settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict.nn import TensorDictModule

from methods import Method
from replay_assembly import learned_signals
from settings import Learner as LearnerSettings
from torchrl_mpfa import (
    DDPGLearner,
    Learner,
    SACLearner,
    TD3Learner,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_sac_loss,
    make_stochastic_actor,
    make_td3_loss,
)
from torchrl_mpfa.methods import Curiosity


def make_policy(
    settings: LearnerSettings, observation_size: int, action_size: int
) -> TensorDictModule:
    """The actor, random by itself for SAC."""
    make = make_stochastic_actor if settings.algorithm == "sac" else make_actor
    return make(
        observation_size,
        action_size,
        width=settings.width,
        layers=settings.layers,
        layer_norm=settings.layer_norm,
        final_init=settings.final_init,
    )


def make_learner(
    settings: LearnerSettings,
    method: Method,
    observation_size: int,
    action_size: int,
    *,
    device: str = "cpu",
) -> Learner:
    """Networks, loss and optimizers; the loss writes those signals that the method asks for.

    Raises:
        ValueError: If the algorithm is unknown.
    """
    if settings.algorithm not in ALGORITHMS:
        raise ValueError(
            f"learner.algorithm must be one of {sorted(ALGORITHMS)}, got {settings.algorithm!r}"
        )
    critic = make_critic(
        observation_size,
        action_size,
        width=settings.width,
        layers=settings.layers,
        layer_norm=settings.layer_norm,
        final_init=settings.final_init,
        late_action=settings.late_action,
    )
    actor = make_policy(settings, observation_size, action_size)
    actor, critic = actor.to(device), critic.to(device)
    of_loss: dict[str, Any] = {
        "gamma": settings.gamma,
        "signals": learned_signals(method),
        "importance": method.importance,
        "loss_function": method.loss_function,
        "target_average": method.target_average,
        "reward_scale": settings.reward_scale,
        "saturation_penalty": settings.saturation_penalty,
        "saturation_limit": settings.saturation_limit,
    }
    of_learner: dict[str, Any] = {
        "actor_lr": settings.actor_lr,
        "critic_lr": settings.critic_lr,
        "critic_weight_decay": settings.critic_weight_decay,
        "tau": settings.tau,
        "optimizer": method.optimizer,
        "compile": settings.compile,
    }
    return ALGORITHMS[settings.algorithm](settings, actor, critic, of_loss, of_learner)


Options = dict[str, Any]


def _ddpg(
    settings: LearnerSettings,
    actor: TensorDictModule,
    critic: TensorDictModule,
    of_loss: Options,
    of_learner: Options,
) -> Learner:
    return DDPGLearner(make_ddpg_loss(actor, critic, **of_loss), **of_learner)


def _td3(
    settings: LearnerSettings,
    actor: TensorDictModule,
    critic: TensorDictModule,
    of_loss: Options,
    of_learner: Options,
) -> Learner:
    smoothing: Options = {"policy_noise": settings.policy_noise, "noise_clip": settings.noise_clip}
    loss = make_td3_loss(actor, critic, **of_loss, **smoothing)
    return TD3Learner(loss, **of_learner, policy_delay=settings.policy_delay)


def _sac(
    settings: LearnerSettings,
    actor: TensorDictModule,
    critic: TensorDictModule,
    of_loss: Options,
    of_learner: Options,
) -> Learner:
    loss = make_sac_loss(actor, critic, **of_loss, alpha_init=settings.alpha_init)
    return SACLearner(loss, **of_learner, alpha_lr=settings.alpha_lr)


ALGORITHMS: dict[str, Callable[..., Learner]] = {"ddpg": _ddpg, "td3": _td3, "sac": _sac}
"""Learners by the name of their algorithm."""


def make_curiosity(
    method: Method, observation_size: int, action_size: int, *, device: str = "cpu"
) -> Curiosity | None:
    """The bonus on rewards, if the method has one."""
    if not method.curiosity:
        return None
    made = Curiosity(observation_size, action_size, scale=method.curiosity_scale)
    return made.to(device)
