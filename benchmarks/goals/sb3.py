"""Stable-Baselines3's TD3 with its own hindsight replay, with the settings of a run of ours."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import gymnasium_td3 as page

GOALS = 4
"""Goals in hindsight for each transition."""


def train(options: argparse.Namespace) -> list[tuple[int, float]]:
    """Train with the options of ``gymnasium_td3.py``; return steps and scores.

    Observations and goals are normalized by the mean and the spread of what was seen, as they are
    there but for the least spread; rewards are not. The networks also read the achieved goal.
    """
    torch.set_num_threads(1)
    env = VecNormalize(
        DummyVecEnv([lambda: page.make(options.task)]),
        norm_reward=False,
        clip_obs=5.0,
        gamma=options.gamma,
    )
    [size] = env.action_space.shape  # type: ignore[misc]
    model = TD3(
        "MultiInputPolicy",
        env,
        learning_rate=page.LEARNING_RATE,
        buffer_size=options.steps,
        learning_starts=options.start,
        batch_size=options.batch_size,
        tau=options.tau,
        gamma=options.gamma,
        train_freq=(page.STEPS_A_ROUND, "step"),
        gradient_steps=page.STEPS_A_ROUND,
        action_noise=NormalActionNoise(np.zeros(size), np.full(size, options.noise)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": GOALS, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": [options.width, options.width]},
        seed=options.seed,
        device="cpu",
    )
    found: list[tuple[int, float]] = []
    for steps in range(options.every, options.steps + 1, options.every):
        model.learn(options.every, reset_num_timesteps=False)
        found.append((steps, score(model, env, options.task)))
    env.close()
    return found


def score(model: Any, scales: VecNormalize, name: str) -> float:
    """Return the share of episodes without noise that end at their goal, as the page does."""
    env = page.make(name)
    ended: list[bool] = []
    seen, _ = env.reset(seed=1_000_000)
    while len(ended) < page.EPISODES:
        batch = {key: value[None] for key, value in seen.items()}
        [action], _ = model.predict(scales.normalize_obs(batch), deterministic=True)
        seen, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            ended.append(bool(info.get("is_success", info.get("success", False))))
            seen, _ = env.reset()
    env.close()
    return float(np.mean(ended))
