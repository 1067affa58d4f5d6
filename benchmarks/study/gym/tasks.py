"""Tasks of Gymnasium, and how their returns are brought to one scale."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction, RescaleObservation, TransformObservation

from torchrl_mpfa.spelling import unknown


@dataclass(frozen=True)
class Task:
    """A task with continuous actions.

    Attributes:
        name: What Gymnasium calls it.
        low: Return of an episode that counts as 0.
        high: Return of an episode that counts as 1.
        repeat: Steps for which an action is held.
        positive_above: What a reward must exceed to be positive for a method; ``"mean"`` where all
            rewards have one sign, with which ``mpfa_per`` weights its signals equally.
        needs: Module that must be installed, if any.
    """

    name: str
    low: float
    high: float
    repeat: int = 1
    positive_above: float | str = 0.0
    needs: str = ""

    def score(self, returned: float) -> float:
        """A return between 0 and 1, beyond the bounds one of these.

        Examples:
            >>> Task("x", low=-200.0, high=0.0).score(-50.0)
            0.75
        """
        return float(np.clip((returned - self.low) / (self.high - self.low), 0.0, 1.0))


TASKS = {
    task.name: task
    for task in (
        # Hanging still for 200 steps costs pi squared each, standing upright nothing.
        Task("Pendulum-v1", low=-1974.0, high=0.0, positive_above="mean"),
        # 0 is standing still, 100 the goal at no cost.
        # With actions of one step nothing was learned in 7,000 of them.
        Task("MountainCarContinuous-v0", low=0.0, high=100.0, repeat=4),
        # Resting, the fingertip is a quarter of a meter from its goal for 50 steps on average.
        Task("Reacher-v5", low=-12.5, high=0.0, positive_above="mean", needs="mujoco"),
    )
}
"""Tasks of table F, by name."""


def task_of(name: str) -> Task:
    """The task of a name."""
    if name not in TASKS:
        raise ValueError(unknown("task", name, TASKS))
    task = TASKS[name]
    if task.needs and find_spec(task.needs) is None:
        raise ValueError(f"task {name!r} needs {task.needs}: pip install 'torchrl-mpfa[mujoco]'")
    return task


class HeldAction(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Holds each action for some steps, or to the end of the episode, and adds their rewards.

    Args:
        env: The environment.
        steps: How many.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], steps: int) -> None:
        super().__init__(env)
        self._steps = steps

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act, and tell where it led."""
        total = 0.0
        for _ in range(self._steps):
            seen, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return seen, total, terminated, truncated, info


def make_env(task: Task) -> gymnasium.Env[Any, Any]:
    """The environment of a task: actions in [-1, 1], and so are observations that have bounds."""
    env: gymnasium.Env[Any, Any] = gymnasium.make(task.name, disable_env_checker=True)
    least, greatest = np.float32(-1), np.float32(1)
    env = RescaleAction(env, least, greatest)
    if task.repeat > 1:
        env = HeldAction(env, task.repeat)
    seen = env.observation_space
    assert isinstance(seen, spaces.Box)
    if seen.is_bounded():
        return RescaleObservation(env, least, greatest)
    # MuJoCo's are double precision.
    single = spaces.Box(-np.inf, np.inf, seen.shape, np.float32)
    return TransformObservation(env, lambda found: found.astype(np.float32), single)
