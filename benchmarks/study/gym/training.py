"""One run: TD3 with the replay of a method, and greedy evaluations on the way."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymWrapper, InitTracker, TransformedEnv
from torchrl.modules import OrnsteinUhlenbeckProcessModule

from benchmarks.study.gym.tasks import Task, make_env, task_of
from torchrl_mpfa import TD3Learner, make_actor, make_critic, make_td3_loss, run_updates
from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.methods import Replay, loss_options, make_replay
from torchrl_mpfa.spelling import unknown

METHODS = ("uniform", "per", "mpfa_per", "mpfa_plus")
"""Those of the table, by their names in the catalogue; others would need more of a run."""
_FIRST_START = 10_000
"""Seed of the first episode of an evaluation; no run has such a seed."""
_AFTER = ("observation", "reward", "done", "terminated")
_KEPT = ("observation", "action", *(("next", name) for name in _AFTER))
"""What a transition is, without the state of the noise and of the collector."""


@dataclass(frozen=True, kw_only=True)
class Regime:
    """What all runs of the table have in common, whatever the task and the method."""

    actions: int = 12_000
    first_actions: int = 1_000
    """Actions before the first update."""
    actions_at_once: int = 4
    """Actions between two blocks of updates."""
    updates: int = 2
    """Updates in a block."""
    batch_size: int = 256
    width: int = 64
    """Units of each of the two hidden layers of actor and critics."""
    learning_rate: float = 1e-3
    tau: float = 0.01
    gamma: float = 0.99
    reward_scale: float = 0.1
    saturation_penalty: float = 1.0
    """Without it the car's actor was seen to stay at full throttle."""
    target_noise: float = 0.2
    """Standard deviation of the noise on the target's action, of which 1 is the greatest."""
    target_noise_clip: float = 0.5
    noise: float = 0.3
    """sigma of the Ornstein-Uhlenbeck noise on the actions."""
    noise_return: float = 0.15
    """Its theta: the share of the noise that is lost in a step."""
    noise_end: float = 0.1
    """What is left of the noise at the end, to which it falls linearly."""
    every: int = 1_000
    """Actions between two evaluations."""
    episodes: int = 10
    """Of each evaluation."""

    def __post_init__(self) -> None:
        names = ("actions", "actions_at_once", "updates", "batch_size", "width", "every")
        check_counts(**{name: getattr(self, name) for name in (*names, "episodes")})
        if self.first_actions < self.batch_size:
            raise ValueError(
                f"first_actions must be at least batch_size, {self.batch_size}, got "
                f"{self.first_actions}"
            )
        for name in ("actions", "every"):
            value = getattr(self, name)
            if value % self.actions_at_once:
                raise ValueError(
                    f"{name} must be a multiple of {self.actions_at_once}, got {value}"
                )
        # A run without an evaluation would have no rows.
        least = max(self.first_actions, self.every)
        if self.actions < least:
            raise ValueError(
                f"actions must be at least first_actions and every, {least}, got {self.actions}"
            )


@dataclass(frozen=True)
class Settings:
    """All that a run depends on."""

    task: str
    method: str
    seed: int
    regime: Regime = Regime()

    def __post_init__(self) -> None:
        task_of(self.task)
        if self.method not in METHODS:
            raise ValueError(unknown("method", self.method, METHODS))
        if self.seed < 0 or self.seed >= _FIRST_START:
            raise ValueError(f"seed must be from 0 to {_FIRST_START - 1}, got {self.seed}")


def prepare_process() -> None:
    """Set threads, arithmetic and logging."""
    torch.set_num_threads(1)
    # Decayed weights become denormal numbers, with which a CPU is slow.
    torch.set_flush_denormal(True)
    # TorchRL announces each storage in the middle of the progress bar.
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def train(settings: Settings) -> pd.DataFrame:
    """Train, and evaluate the greedy policy on the way.

    Args:
        settings: Of the run.

    Returns:
        A row for each evaluation: ``actions``, ``return``, the mean of its episodes, ``score``, the
        same between 0 and 1, and ``trained_for``, the time of the training until then [s].
    """
    regime, task = settings.regime, task_of(settings.task)
    torch.manual_seed(settings.seed)
    env = TransformedEnv(GymWrapper(make_env(task)), InitTracker())
    env.set_seed(settings.seed)
    # Networks first: all methods begin with the same ones.
    learner = make_learner(settings, env)
    replay = make_replay(
        settings.method,
        capacity=regime.actions,
        batch_size=regime.batch_size,
        generator=torch.Generator().manual_seed(settings.seed),
        positive_above=task.positive_above,
    )
    rows, began = [], time.perf_counter()
    for actions in iterations(regime, env, learner, replay, seed=settings.seed):
        if actions % regime.every == 0:
            paused = time.perf_counter()
            returned = float(greedy_returns(learner.policy, task, regime.episodes).mean())
            rows.append((actions, returned, task.score(returned), round(paused - began, 3)))
            began += time.perf_counter() - paused
    env.close()
    return pd.DataFrame(rows, columns=["actions", "return", "score", "trained_for"])


def make_learner(settings: Settings, env: EnvBase) -> TD3Learner:
    """Networks, loss and optimizer; the loss writes those signals that the method asks for.

    Args:
        settings: Of the run.
        env: With actions in [-1, 1].

    Returns:
        The learner.
    """
    regime = settings.regime
    sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    loss = make_td3_loss(
        make_actor(*sizes, width=regime.width),
        make_critic(*sizes, width=regime.width),
        action_spec=env.action_spec,
        gamma=regime.gamma,
        reward_scale=regime.reward_scale,
        saturation_penalty=regime.saturation_penalty,
        policy_noise=regime.target_noise,
        noise_clip=regime.target_noise_clip,
        **loss_options(settings.method),
    )
    rate = regime.learning_rate
    return TD3Learner(loss, actor_lr=rate, critic_lr=rate, tau=regime.tau)


def iterations(
    regime: Regime, env: EnvBase, learner: TD3Learner, replay: Replay, *, seed: int
) -> Iterator[int]:
    """Act with noise, store, learn."""
    noise = OrnsteinUhlenbeckProcessModule(
        env.action_spec,
        theta=regime.noise_return,
        sigma=regime.noise,
        dt=1.0,
        eps_end=regime.noise_end,
        annealing_num_steps=regime.actions,
    )
    # However many random numbers the parts were made of, all methods explore alike.
    torch.manual_seed(seed)
    collector = Collector(
        env,
        TensorDictSequential(learner.policy, noise),
        frames_per_batch=regime.actions_at_once,
        total_frames=regime.actions,
    )
    actions = 0
    for steps in collector:
        replay.buffer.extend(steps.select(*_KEPT))
        noise.step(len(steps))
        actions += len(steps)
        replay.anneal(actions / regime.actions)
        if actions >= regime.first_actions:
            run_updates(replay.buffer, learner, replay.select, updates=regime.updates)
        yield actions
    collector.shutdown(close_env=False)


@torch.no_grad()
def greedy_returns(policy: TensorDictModule, task: Task, episodes: int) -> NDArray[np.float64]:
    """Total rewards of episodes without noise, from starts that are always the same.

    Args:
        policy: From ``"observation"`` to ``"action"``.
        task: The task.
        episodes: How many.

    Returns:
        Shape ``[episodes]``.
    """
    envs = [make_env(task) for _ in range(episodes)]
    seen = np.stack([env.reset(seed=_FIRST_START + n)[0] for n, env in enumerate(envs)])
    returns, going = np.zeros(episodes), list(range(episodes))
    while going:
        batch = TensorDict({"observation": torch.from_numpy(seen[going])}, [len(going)])
        actions = policy(batch)["action"].numpy()
        for number, action in zip(list(going), actions, strict=True):
            seen[number], reward, terminated, truncated, _ = envs[number].step(action)
            returns[number] += float(reward)
            if terminated or truncated:
                going.remove(number)
    for env in envs:
        env.close()
    return returns
