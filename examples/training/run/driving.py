"""The robots of a run in their training episodes, one action of each at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from training.environments import (
    INFO,
    FilteredRobots,
    make_training_env,
    vector_of,
)
from training.records import EpisodeRecord
from training.run.exploration import Explorer
from training.settings.learners import is_discrete
from training.settings.train import TrainSettings

TRANSITION = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)
"""Entries of a step that a buffer keeps."""
_UNIFORM_SIGMA = 3**-0.5
"""Standard deviation of actions that are uniform in [-1, 1]."""


class Robots:
    """Robots that act at random in the first steps of a run and by an explorer after them.

    Args:
        settings: Of the run.
    """

    def __init__(self, settings: TrainSettings) -> None:
        self.settings = settings
        self.count = settings.robots
        self.seconds = 0.0
        """Wall-clock time of the run before this process [s]."""
        self.given_up = 0
        """Episodes of the run that were under way when another stage began."""
        self._started = time.perf_counter()
        self._filter = FilteredRobots(settings)
        self._env: EnvBase | None = None
        self._world: str | None = None
        self._state: TensorDictBase | None = None
        self._rewards = torch.zeros(self.count, dtype=torch.double)
        self._steps = torch.zeros(self.count, dtype=torch.long)
        self._numbers = torch.zeros(self.count, 1, dtype=torch.long)
        """Number of the episode that each robot is in."""
        self._begun = 0

    def environment(self, world: str) -> EnvBase:
        """The environment of a stage, kept for as long as its world stays the same."""
        if self._env is None or world != self._world:
            self.close()
            self._env = make_training_env(
                world,
                self.settings.environment,
                robots=self.count,
                discrete=is_discrete(self.settings.learner),
                hindsight=self.settings.method.hindsight > 0,
            )
            self._world = world
        return self._env

    def begin(self, world: str, explorer: Explorer, *, seed: int) -> None:
        """Begin an episode with each robot; episodes in progress are given up."""
        env = self.environment(world)
        env.set_seed(seed)
        self.given_up += int((self._steps > 0).sum())
        self._begin_episodes(torch.ones(self.count, dtype=torch.bool), explorer)
        self._rewards.zero_()
        self._steps.zero_()
        self._state = env.reset()

    def _begin_episodes(self, begun: Tensor, explorer: Explorer) -> None:
        """Number the episodes that begin, and signal them to the explorer."""
        count = int(begun.sum())
        self._numbers[begun, 0] = torch.arange(self._begun, self._begun + count)
        self._begun += count
        explorer.begin_episodes(begun)

    def drive(
        self, explorer: Explorer, *, actions: int, episode: int, entries: Sequence[NestedKey] = ()
    ) -> tuple[TensorDictBase, list[EpisodeRecord]]:
        """Take one action with each robot.

        Args:
            explorer: What acts.
            actions: Of the run before these.
            episode: Episodes of the run that have ended.
            entries: Further entries of the transitions: ``"episode"``; ``"behavior_mean"`` and
                ``"behavior_sigma"``, the actions without noise and the spread of the noise; or
                entries of the environment.

        Returns:
            The entries of :data:`TRANSITION` and those others, batch size ``[robots]``, and the
            records of the episodes that ended.
        """
        assert self._env is not None and self._state is not None
        state, self._state = self._env.step_and_maybe_reset(
            self._act(explorer, self._state, actions, entries)
        )
        self._filter.charge(state)
        if "episode" in entries:
            state.set("episode", self._numbers.clone())
        total = actions + self.count
        records = self._note(state["next"], explorer, episode=episode, total_steps=total)
        return state.select(*TRANSITION, *entries), records

    def _note(
        self, after: TensorDictBase, explorer: Explorer, *, episode: int, total_steps: int
    ) -> list[EpisodeRecord]:
        """Count an action of each robot; return the records of the episodes that ended."""
        self._rewards += after["reward"].squeeze(-1)
        self._steps += 1
        done = after["done"].squeeze(-1)
        records = [
            self._record(after[robot], robot, episode=episode + number, total_steps=total_steps)
            for number, robot in enumerate(done.nonzero().squeeze(-1).tolist())
        ]
        if records:
            self._begin_episodes(done, explorer)
            self._rewards[done] = 0.0
            self._steps[done] = 0
        return records

    @torch.no_grad()
    def _act(
        self, explorer: Explorer, state: TensorDictBase, actions: int, entries: Sequence[NestedKey]
    ) -> TensorDictBase:
        assert self._env is not None
        if actions < self.settings.exploration.random_steps:
            state = self._env.rand_action(state)
            mean = torch.zeros_like(state["action"])
            behavior = mean, torch.full((self.count, 1), _UNIFORM_SIGMA)
        else:
            observation = state.get("observation").to(self.settings.device)
            state = state.set("action", explorer.act(observation).cpu())
            behavior = explorer.behavior()
        if "behavior_mean" in entries:
            for name, value in zip(("behavior_mean", "behavior_sigma"), behavior, strict=True):
                state.set(name, value.clone())
        return self._filter(state)

    def _record(
        self, after: TensorDictBase, robot: int, *, episode: int, total_steps: int
    ) -> EpisodeRecord:
        reward, steps = self._rewards[robot].item(), int(self._steps[robot])
        info: dict[str, Any] = {name: after["info", name].item() for name in INFO}
        return EpisodeRecord(
            episode=episode,
            world=self._world or "",
            steps=steps,
            total_steps=total_steps,
            reward=reward,
            average_reward=reward / steps,
            seconds=self.elapsed(),
            **info,
        )

    def elapsed(self) -> float:
        """Wall-clock time of the run so far [s]."""
        return self.seconds + time.perf_counter() - self._started

    def state_dict(self) -> dict[str, Any]:
        """Return where every robot is, and what its next observation and record depend on."""
        assert self._env is not None and self._state is not None
        observation: Tensor = self._state["observation"]
        hindsight: Tensor | None = self._state.get("hindsight", None)
        return {
            "environment": _as_tensors(vector_of(self._env).state_dict()),
            "observation": observation.clone(),
            "hindsight": None if hindsight is None else hindsight.clone(),
            "rewards": self._rewards.clone(),
            "steps": self._steps.clone(),
            "numbers": self._numbers.clone(),
            "begun": self._begun,
            "seconds": self.elapsed(),
            "given_up": self.given_up,
        }

    def recall(self, state: dict[str, Any]) -> None:
        """Restore what counts for the whole run, and which episodes were in progress."""
        self.seconds = state["seconds"]
        self.given_up = state["given_up"]
        self._rewards, self._steps = state["rewards"].clone(), state["steps"].clone()
        self._numbers, self._begun = state["numbers"].clone(), state["begun"]

    def load_state_dict(self, world: str, state: dict[str, Any]) -> None:
        """Restore a state of :meth:`state_dict`."""
        env = self.environment(world)
        # A reset makes the entries that a step wants; what is in them is replaced.
        self._state = env.reset()
        vector_of(env).load_state_dict(_as_arrays(state["environment"]))
        self._state["observation"] = state["observation"].clone()
        if self.settings.method.hindsight:
            self._state["hindsight"] = state["hindsight"].clone()
        self.recall(state)

    def close(self) -> None:
        """Release the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None


def _as_tensors(value: Any) -> Any:
    """Replace NumPy arrays, which a safe loader takes for code, by tensors."""
    return _replaced(value, np.ndarray, torch.from_numpy)


def _as_arrays(value: Any) -> Any:
    """Replace tensors by NumPy arrays."""
    return _replaced(value, torch.Tensor, torch.Tensor.numpy)


def _replaced(value: Any, kind: type[Any], convert: Callable[[Any], Any]) -> Any:
    if isinstance(value, kind):
        return convert(value)
    if isinstance(value, dict):
        return {name: _replaced(each, kind, convert) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_replaced(each, kind, convert) for each in value]
    return value
