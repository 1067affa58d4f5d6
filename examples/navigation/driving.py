"""The robot in its training episodes, action by action."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from navigation.environments import INFO, make_training_env
from navigation.exploration import Explorer
from navigation.settings import TrainSettings

TRANSITION = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)
"""What a buffer keeps of a step."""


class Driver:
    """Drives the robot of a run, at random in its first steps and by an explorer after them.

    Args:
        settings: Of the run.
    """

    def __init__(self, settings: TrainSettings) -> None:
        self.settings = settings
        self._env: EnvBase | None = None
        self._world = ""

    def environment(self, world: str) -> EnvBase:
        """The environment of a world, kept for as long as the world stays the same."""
        if self._env is None or world != self._world:
            self.close()
            self._env = make_training_env(world, self.settings.environment)
            self._world = world
        return self._env

    def begin(self, world: str, explorer: Explorer, *, seed: int, step: int) -> None:
        """Begin an episode.

        Args:
            world: Name of a world, or a world file.
            explorer: What acts.
            seed: Seed of the environment and of the noise.
            step: Actions of the run before this episode.
        """
        env = self.environment(world)
        env.set_seed(seed)
        torch.manual_seed(seed)
        explorer.begin_episode()
        self._explorer, self._step = explorer, step
        self._state = env.reset()

    def drive(self) -> TensorDictBase:
        """Choose an action and take it.

        Returns:
            The entries of :data:`TRANSITION`, batch size ``[1]``.
        """
        assert self._env is not None
        state = self._env.step(self._act(self._env, self._state))
        self._step += 1
        self._last, self._state = state["next"], step_mdp(state)
        return state.select(*TRANSITION).unsqueeze(0)

    @torch.no_grad()
    def _act(self, env: EnvBase, state: TensorDictBase) -> TensorDictBase:
        if self._step < self.settings.exploration.random_steps:
            return env.rand_action(state)
        observation = state.get("observation").to(self.settings.device)
        return state.set("action", self._explorer.act(observation).cpu())

    def info(self) -> dict[str, Any]:
        """Entries of the environment's info after the last action."""
        return {name: self._last["info", name].item() for name in INFO}

    def close(self) -> None:
        """Release the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None
