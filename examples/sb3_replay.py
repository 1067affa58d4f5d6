"""Replay with priorities in Stable-Baselines3's TD3 and DDPG, on a task with continuous actions.

    python examples/sb3_replay.py td3                           MPFA-PER on Pendulum, one minute
    python examples/sb3_replay.py ddpg --replay per --task Pendulum-v1 --actions 10000 --seed 1
    python examples/sb3_replay.py td3 --replay uniform

Stable-Baselines3 has no replay with priorities, and its losses take no importance weights. Here
its classes are subclassed, not changed: a hook of its critic multiplies the gradient of each value
by the weight of its transition, which is the gradient of Eq. (11). It reads the TD errors of the
same gradient. It needs ``pip install stable-baselines3``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_mpfa import METHODS, SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.methods.assembly import learned_signals
from torchrl_mpfa.priorities import action_gradient_priority

METHODS_HERE = ("uniform", "per", "mpfa_per")
LEARNING_STARTS = 100
"""Actions at random before the first update."""


class PriorityReplay(ReplayBuffer):
    """A buffer of this project in the form of Stable-Baselines3's, for observations in one array.

    Args:
        buffer_size: Transitions that it holds.
        observation_space: As in Stable-Baselines3.
        action_space: As in Stable-Baselines3.
        device: Device of the batches; the transitions are on the CPU.
        n_envs: Environments that write a transition each at once.
        optimize_memory_usage: Must be False.
        method: One of :data:`METHODS_HERE`.
        **settings: Other values for the settings of the method.

    Raises:
        ValueError: If ``method`` is another one, or an argument is out of its range.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: Any,
        action_space: Any,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        method: str = "mpfa_per",
        **settings: Any,
    ) -> None:
        if method not in METHODS_HERE:
            raise ValueError(f"method must be one of {METHODS_HERE}, got {method!r}")
        if buffer_size < n_envs:
            raise ValueError(f"buffer_size must be at least n_envs = {n_envs}, got {buffer_size}")
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False, got True")
        # Theirs holds one step, which nobody reads.
        super().__init__(n_envs, observation_space, action_space, device, n_envs)
        self.buffer_size = buffer_size // n_envs
        slots = self.buffer_size * n_envs
        self.method = replace(METHODS["ddpg" if method == "uniform" else method], **settings)
        self.method.capacity = slots
        self.replay = SignalReplayBuffer(
            storage=SignalTensorStorage(slots, device="cpu"), sampler=self.method.sampler()
        )
        self.signals = learned_signals(self.method)
        self.batch: TensorDictBase | None = None
        """The batch that is learned from."""

    def size(self) -> int:
        """Return the number of transitions."""
        return len(self.replay)

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        """Write a transition of each environment; a time limit is no end."""
        shape = (self.n_envs, *self.obs_shape)
        timeout = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        after = {
            "observation": torch.from_numpy(next_obs.reshape(shape)),
            "reward": torch.from_numpy(np.float32(reward).reshape(-1, 1)),
            "terminated": torch.from_numpy((done.astype(bool) & ~timeout).reshape(-1, 1)),
        }
        now = torch.from_numpy(obs.reshape(shape))
        actions = torch.from_numpy(action.reshape(self.n_envs, self.action_dim))
        rows = {"observation": now, "action": actions, "next": after}
        self.replay.extend(TensorDict(rows, [self.n_envs]))

    def reset(self) -> None:
        """Forget all transitions."""
        self.replay.empty()
        self.batch = None

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Sample a batch, and keep it for its priorities.

        Raises:
            RuntimeError: If the batch before got no priorities.
        """
        if self.signals and self.batch is not None:
            raise RuntimeError(
                f"replay_buffer_class must be ReplayBuffer for an algorithm that writes no "
                f"priorities, got PriorityReplay with {self.method.name!r}: take PriorityTD3 or "
                "PriorityDDPG"
            )
        batch = self.batch = self.replay.sample(batch_size)
        after = batch["next"]
        arrays = (
            self._normalize_obs(batch["observation"].numpy(), env),
            batch["action"].numpy(),
            self._normalize_obs(after["observation"].numpy(), env),
            np.float32(after["terminated"].numpy()),
            self._normalize_reward(after["reward"].numpy(), env),
        )
        return ReplayBufferSamples(*map(self.to_torch, arrays))

    def update(self) -> None:
        """Write the priorities of the batch that was learned from."""
        if self.signals and self.batch is not None:
            self.replay.update_tensordict_priority(self.batch)
        self.batch = None


class PriorityTD3(TD3):
    """Stable-Baselines3's TD3 with :class:`PriorityReplay`; its logged loss is without weights."""

    replay_buffer: PriorityReplay

    def _setup_model(self) -> None:
        super()._setup_model()
        self.critic.register_forward_hook(self._write_signals)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Make updates, and write the priorities after each."""
        beta = self.replay_buffer.method.beta_at(1.0 - self._current_progress_remaining)
        if beta is not None:
            self.replay_buffer.replay.anneal(beta, 1.0 - self._current_progress_remaining)
        for _ in range(gradient_steps):
            super().train(1, batch_size)
            self.replay_buffer.update()

    def _write_signals(
        self, critic: nn.Module, inputs: tuple[Tensor, ...], values: tuple[Tensor, ...]
    ) -> None:
        """Write the signals of a batch once its loss is differentiated, which gets the weights."""
        batch = self.replay_buffer.batch
        if not self.replay_buffer.signals or batch is None or not torch.is_grad_enabled():
            return
        observations, actions = inputs[0], inputs[1].detach().requires_grad_()
        value = self.critic.q1_forward(observations, actions).sum()
        slope = action_gradient_priority(torch.autograd.grad(value, actions)[0])
        errors = torch.zeros(len(batch))
        written = {"td_error": errors, "action_gradient": slope.cpu()}
        batch["signals"] = TensorDict(written, [len(batch)])
        weight = batch["priority_weight"].to(self.device).reshape(-1, 1)

        def weigh(gradient: Tensor) -> Tensor:
            # Of a mean of squares it is 2 (Q - y) / B. The largest error of the critics counts.
            error = gradient.abs().reshape(-1).cpu() * len(batch) / 2
            torch.maximum(errors, error, out=errors)
            return gradient * weight

        for prediction in values:
            prediction.register_hook(weigh)


class PriorityDDPG(PriorityTD3, DDPG):
    """Stable-Baselines3's DDPG with :class:`PriorityReplay`."""


def make_model(algorithm: str, task: Any, replay: str, **options: Any) -> PriorityTD3:
    """Make TD3 or DDPG with a replay: two layers of 64, one update an action, unless given."""
    # Rewards may all have one sign: what is above their mean counts as positive.
    settings = {"positive_above": "mean"} if replay == "mpfa_per" else {}
    chosen = {
        "buffer_size": 100_000,
        "policy_kwargs": {"net_arch": [64, 64]},
        "device": "cpu",
        "learning_starts": LEARNING_STARTS,
        "replay_buffer_class": PriorityReplay,
        "replay_buffer_kwargs": {"method": replay, **settings},
        **options,
    }
    model = {"td3": PriorityTD3, "ddpg": PriorityDDPG}[algorithm]("MlpPolicy", task, **chosen)
    actions = model.action_space.shape or ()
    model.action_noise = NormalActionNoise(np.zeros(actions), np.full(actions, 0.1))
    return model


def main(arguments: Sequence[str] | None = None) -> float:
    """Train; return the mean return of ten greedy episodes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("algorithm", choices=["td3", "ddpg"])
    parser.add_argument("--replay", choices=METHODS_HERE, default="mpfa_per")
    parser.add_argument("--task", default="Pendulum-v1", help="of Gymnasium, observations a vector")
    parser.add_argument("--actions", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.actions <= LEARNING_STARTS:
        parser.error(f"--actions must be more than {LEARNING_STARTS}, got {options.actions}")
    model = make_model(options.algorithm, options.task, options.replay, seed=options.seed)
    model.learn(options.actions)
    env = model.get_env()
    assert env is not None
    score = float(np.mean(evaluate_policy(model, env, n_eval_episodes=10)[0]))
    print(f"{options.task}, {options.algorithm}, {options.replay}: mean return {score:.1f}")
    return score


if __name__ == "__main__":
    main()
