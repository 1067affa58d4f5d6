"""The parts of a training run, put together from its settings."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.data import RandomSampler, TensorSpec
from torchrl.modules import AdditiveGaussianModule

from settings import Exploration, Replay
from settings import Learner as LearnerSettings
from torchrl_mpfa import (
    Adjustment,
    DDPGLearner,
    EntropyFusion,
    FixedFusion,
    Learner,
    PositiveBoost,
    PositiveDecay,
    SignalReplayBuffer,
    SignalSampler,
    SignalTensorStorage,
    TD3Learner,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_td3_loss,
)


def make_sampler(settings: Replay) -> SignalSampler | RandomSampler:
    """The sampler that the settings describe: signals, fusion, adjustments."""
    if not settings.signals:
        return RandomSampler()
    if settings.fusion not in ("entropy", "fixed"):
        raise ValueError(f"replay.fusion must be 'entropy' or 'fixed', got {settings.fusion!r}")
    adjustments: list[Adjustment] = []
    if settings.boost:
        adjustments.append(
            PositiveBoost(boost=settings.boost_factor, bound=settings.boost_bound)  # type: ignore[arg-type]
        )
    if settings.decay:
        adjustments.append(
            PositiveDecay(
                sharpness=settings.decay_sharpness,
                position=settings.decay_position,  # type: ignore[arg-type]
            )
        )
    return SignalSampler(
        settings.capacity,
        settings.alpha,
        settings.beta,
        settings.eps,
        max_priority_within_buffer=True,
        signals=settings.signals,
        fusion=EntropyFusion(population=settings.population)  # type: ignore[arg-type]
        if settings.fusion == "entropy"
        else FixedFusion(dict.fromkeys(settings.signals, 1.0)),
        adjustments=adjustments,
    )


def make_buffer(settings: Replay, *, seed: int) -> SignalReplayBuffer:
    """Storage, sampler and buffer, with a generator of their own."""
    return SignalReplayBuffer(
        # As the environment gives it: each write would be converted to a device that is named.
        storage=SignalTensorStorage(settings.capacity, device="auto"),
        sampler=make_sampler(settings),
        batch_size=settings.batch_size,
        generator=torch.Generator().manual_seed(seed),
    )


def make_policy(
    settings: LearnerSettings, observation_size: int, action_size: int
) -> TensorDictModule:
    """The actor."""
    return make_actor(
        observation_size,
        action_size,
        width=settings.width,
        layers=settings.layers,
        layer_norm=settings.layer_norm,
        final_init=settings.final_init,
    )


def make_learner(
    settings: LearnerSettings,
    signals: list[str],
    observation_size: int,
    action_size: int,
    *,
    device: str = "cpu",
) -> Learner:
    """Networks, loss and optimizers; the loss writes those signals that the replay asks for."""
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
        "signals": [name for name in signals if name in ("td_error", "action_gradient")],
        "importance": settings.importance,
        "reward_scale": settings.reward_scale,
        "saturation_penalty": settings.saturation_penalty,
        "saturation_limit": settings.saturation_limit,
    }
    of_learner: dict[str, Any] = {
        "actor_lr": settings.actor_lr,
        "critic_lr": settings.critic_lr,
        "critic_weight_decay": settings.critic_weight_decay,
        "tau": settings.tau,
        "compile": settings.compile,
    }
    if settings.algorithm == "ddpg":
        return DDPGLearner(make_ddpg_loss(actor, critic, **of_loss), **of_learner)
    if settings.algorithm == "td3":
        smoothing: dict[str, Any] = {
            "policy_noise": settings.policy_noise,
            "noise_clip": settings.noise_clip,
        }
        loss = make_td3_loss(actor, critic, **of_loss, **smoothing)
        return TD3Learner(loss, **of_learner, policy_delay=settings.policy_delay)
    raise ValueError(f"learner.algorithm must be 'ddpg' or 'td3', got {settings.algorithm!r}")


def make_noise(settings: Exploration, action_spec: TensorSpec) -> AdditiveGaussianModule:
    """Gaussian noise on the action, clipped to its range, falling linearly."""
    return AdditiveGaussianModule(
        action_spec,
        sigma_init=settings.sigma,
        sigma_end=settings.sigma_end,
        annealing_num_steps=settings.annealing_steps,
    )
