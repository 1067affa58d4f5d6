"""Networks, loss and optimizers of a training run, put together from its settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict.nn import TensorDictModule
from torch import nn

from navigation.settings import LearnerSettings
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
from torchrl_mpfa.methods import Curiosity, Method, loss_options
from torchrl_mpfa.networks import StochasticActor

Options = dict[str, Any]


def make_learner(
    settings: LearnerSettings,
    method: Method,
    observation_size: int,
    action_size: int,
    *,
    device: str = "cpu",
) -> Learner:
    """Networks, loss and optimizers; the loss writes those signals that the method asks for.

    Args:
        settings: Networks, loss and optimizers.
        method: Signals, importance weights, distance, averaging and kind of optimizer.
        observation_size: ``O``.
        action_size: ``A``.
        device: Where the networks are.

    Returns:
        The learner.
    """
    network: Options = {
        "width": settings.width,
        "layers": settings.layers,
        "layer_norm": settings.layer_norm,
        "final_init": settings.final_init,
    }
    sizes = observation_size, action_size
    critic = make_critic(*sizes, late_action=settings.late_action, **network)
    make = make_stochastic_actor if settings.algorithm == "sac" else make_actor
    actor = make(*sizes, **network)
    of_loss: Options = {
        **loss_options(method),
        "gamma": settings.gamma,
        "reward_scale": settings.reward_scale,
        "saturation_penalty": settings.saturation_penalty,
        "saturation_limit": settings.saturation_limit,
    }
    of_learner: Options = {
        "actor_lr": settings.actor_lr,
        "critic_lr": settings.critic_lr,
        "critic_weight_decay": settings.critic_weight_decay,
        "tau": settings.tau,
        "optimizer": method.optimizer,
    }
    make_one = ALGORITHMS[settings.algorithm]
    return make_one(settings, actor.to(device), critic.to(device), of_loss, of_learner)


def _ddpg(
    settings: LearnerSettings,
    actor: TensorDictModule,
    critic: TensorDictModule,
    of_loss: Options,
    of_learner: Options,
) -> Learner:
    loss = make_ddpg_loss(actor, critic, **_smoothing(settings), **of_loss)
    delay = settings.policy_delay
    return DDPGLearner(loss, policy_delay=delay, compile=settings.compile, **of_learner)


def _td3(
    settings: LearnerSettings,
    actor: TensorDictModule,
    critic: TensorDictModule,
    of_loss: Options,
    of_learner: Options,
) -> Learner:
    loss = make_td3_loss(actor, critic, **_smoothing(settings), **of_loss)
    delay = settings.policy_delay
    return TD3Learner(loss, policy_delay=delay, compile=settings.compile, **of_learner)


def _smoothing(settings: LearnerSettings) -> Options:
    return {
        # Wheel speeds are scaled to it by the environment.
        "bounds": (-1.0, 1.0),
        "policy_noise": settings.policy_noise,
        "noise_clip": settings.noise_clip,
    }


def _sac(
    settings: LearnerSettings,
    actor: TensorDictModule,
    critic: TensorDictModule,
    of_loss: Options,
    of_learner: Options,
) -> Learner:
    loss = make_sac_loss(actor, critic, alpha_init=settings.alpha_init, **of_loss)
    return SACLearner(loss, alpha_lr=settings.alpha_lr, **of_learner)


ALGORITHMS: dict[str, Callable[..., Learner]] = {"ddpg": _ddpg, "td3": _td3, "sac": _sac}
"""Learners by the name of their algorithm."""


def policy_layers(policy: TensorDictModule) -> list[nn.Module]:
    """The layers of an actor, from observation to the action without noise."""
    network = policy if isinstance(policy, StochasticActor) else policy.module
    layers: list[nn.Module] = network.layers()
    return layers


def make_curiosity(
    method: Method, observation_size: int, action_size: int, *, device: str = "cpu"
) -> Curiosity | None:
    """The bonus on rewards, if the method has one."""
    if not method.curiosity:
        return None
    made = Curiosity(observation_size, action_size, scale=method.curiosity_scale)
    return made.to(device)
