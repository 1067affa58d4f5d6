"""Train with Stable-Baselines3's SAC or TD3 on many robots at once.

    python examples/stable_baselines.py sac
    python examples/stable_baselines.py sac --world rooms --actions 20000    two minutes
    python examples/stable_baselines.py td3 --world bars --robots 32 --actions 200000

The policy goes to ``policy.npz`` in --output, runs/sb3-ALGORITHM by default, where
``examples/evaluate.py`` and ``examples/export.py`` read it. It needs
``pip install stable-baselines3``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch import nn

from mpfa_envs import ROOMS_TASK, Policy, VectorNavigationEnv, save_policy

SENSES = {name: ROOMS_TASK[name] for name in ("robot", "physics", "memory", "clearance")}
"""Arguments of the environment that a policy needs wherever it drives."""
_NOISE = 0.2
"""Standard deviation of TD3's exploration."""


class Robots(VecEnv):
    """A :class:`~mpfa_envs.VectorNavigationEnv` of the mode SAME_STEP for Stable-Baselines3."""

    def __init__(self, env: VectorNavigationEnv) -> None:
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"env must have AutoresetMode.SAME_STEP, got {env.autoreset_mode}")
        self.env = env
        self._actions = np.zeros((env.num_envs, 2), dtype=np.float32)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode with each robot, by the last seed if one was set."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        observations, _ = self.env.reset(seed=seeds)
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        ended = terminated | truncated
        told: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for robot in np.flatnonzero(ended).tolist():
            told[robot] = {
                "terminal_observation": infos["final_obs"][robot],
                "TimeLimit.truncated": bool(truncated[robot]),
                "is_success": bool(infos["final_info"]["success"][robot]),
            }
        return observations, rewards.astype(np.float32), ended, told

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, for each robot."""
        return [getattr(self.env, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Robots have no attributes of their own."""
        raise AttributeError(f"{attr_name!r} cannot be set for single robots")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Robots have no methods of their own."""
        raise AttributeError(f"{method_name!r} cannot be called for single robots")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No robot is wrapped alone."""
        return [False for _ in self._get_indices(indices)]


def make_model(algorithm: str, env: VecEnv, **options: Any) -> OffPolicyAlgorithm:
    """Make SAC or TD3: two layers of 64, four updates for the robots' actions, unless given."""
    chosen: dict[str, Any] = {
        "learning_rate": 1e-3,
        "batch_size": 256,
        "learning_starts": 1000,
        "gradient_steps": 4,
        "policy_kwargs": {"net_arch": [64, 64]},
        "device": "cpu",
        **options,
    }
    if algorithm == "sac":
        return SAC("MlpPolicy", env, **chosen)
    noise = NormalActionNoise(np.zeros(2), np.full(2, _NOISE))
    return TD3("MlpPolicy", env, action_noise=VectorizedActionNoise(noise, env.num_envs), **chosen)


def policy_of(model: OffPolicyAlgorithm, *, card: dict[str, Any]) -> Policy:
    """The greedy policy of a model, which needs neither PyTorch nor Stable-Baselines3."""
    actor: Any = model.policy.actor
    layers = [*actor.latent_pi, actor.mu, nn.Tanh()] if isinstance(model, SAC) else [*actor.mu]
    return Policy.from_layers(layers, card=card, env_arguments=SENSES)


def main(arguments: Sequence[str] | None = None) -> Path:
    """Train; return the file of the policy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("algorithm", choices=["sac", "td3"])
    parser.add_argument("--world", default="mixed", help="a generator or a world (default: mixed)")
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--actions", type=int, default=100_000, help="of all robots together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="folder (default: runs/sb3-ALGORITHM)")
    options = parser.parse_args(arguments)
    folder = options.output or Path("runs") / f"sb3-{options.algorithm}"
    folder.mkdir(parents=True, exist_ok=True)
    robots = VectorNavigationEnv(
        options.robots,
        autoreset_mode=AutoresetMode.SAME_STEP,
        **{**ROOMS_TASK, "world": options.world},
    )
    env = VecMonitor(Robots(robots))
    model = make_model(options.algorithm, env, seed=options.seed, verbose=1)
    model.learn(options.actions, log_interval=100)
    env.close()
    card = {
        "learner": f"stable-baselines3 {options.algorithm}",
        "curriculum": options.world,
        "seed": options.seed,
        "steps": model.num_timesteps,
    }
    file = save_policy(policy_of(model, card=card), folder)
    print(f"written: {file}")
    return file


if __name__ == "__main__":
    main()
