"""The environments of a run: of its training, and the arguments of its evaluation."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from mpfa_envs import (
    DiscreteWheels,
    NavigationTorchEnv,
    TaskConfig,
    VectorNavigationEnv,
    navigation_reward,
)
from mpfa_envs.env.config import lidar_arguments
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.tasks.reward import RewardFunction
from training.settings.environment import EnvironmentSettings
from training.settings.learners import is_discrete
from training.settings.train import TrainSettings

_DISTANCE = 0.14
"""Farthest that a robot drives in an action [m], unless it is faster than that in 0.2 s."""
_OF_THE_ROBOT = ("physics", "memory", "history")
_OF_THE_TASK = ("max_steps", "clearance", "progress", "progress_scale", "detour_chance", "latency")
INFO = ("success", "collision", "timeout", "path_length", "shortest_path")


def env_arguments(settings: EnvironmentSettings) -> dict[str, Any]:
    """Return the arguments that a policy needs wherever it drives: robot, time and lidar."""
    robot = resolve_robot(settings.robot)
    # Only where it is not the default: policies are asked for no argument that they do not need.
    view = settings.field_of_view
    seen = {} if view in (None, robot.field_of_view) else {"lidar": lidar_arguments(view)}
    given = {
        name: value
        for name in ("plan", "goal_radius")
        if (value := getattr(settings, name)) != getattr(TaskConfig, name)
    }
    if settings.sensors:
        given["sensors"] = list(settings.sensors)
    return {
        "robot": robot,
        **{name: getattr(settings, name) for name in _OF_THE_ROBOT},
        "action_repeat": _repeat(robot)
        if settings.action_repeat is None
        else settings.action_repeat,
        **seen,
        **given,
        # The lidar saturates where the training ends an episode, and shows all distances above; a
        # robot that can stop may drive on from there, and must know how near it is.
        "closeness_distance": robot.lidar_to_rim + (0.0 if robot.can_stop else settings.clearance),
    }


def _repeat(robot: RobotModel) -> int:
    """Time steps in which a robot drives as far as an action of the Kobuki, at least two."""
    return max(2, int(_DISTANCE / (TaskConfig.time_step * robot.max_wheel_speed) + 1e-9))


def task_arguments(settings: EnvironmentSettings) -> dict[str, Any]:
    """Return the task to learn: what a policy needs, rewards, and ends of an episode."""
    return {
        **{name: getattr(settings, name) for name in _OF_THE_TASK},
        "noise": asdict(settings.noise),
        **env_arguments(settings),
        "reward": _reward(settings),
    }


def episode_arguments(settings: EnvironmentSettings) -> dict[str, Any]:
    """Return the arguments that decide which episodes follow one another."""
    return {
        "max_goal_distance": settings.max_goal_distance or math.inf,
        "episodes_per_world": settings.episodes_per_world,
    }


def _reward(settings: EnvironmentSettings) -> RewardFunction | str | None:
    """The reward of a name, or Eq. (25), perhaps with a cost of time."""
    scale, cost = settings.progress_scale, settings.step_cost
    if settings.reward is not None or not cost:
        return settings.reward
    return partial(navigation_reward, progress_scale=scale, step_cost=cost)


def make_training_env(
    world: str,
    settings: EnvironmentSettings,
    *,
    robots: int = 1,
    discrete: bool = False,
    hindsight: bool = False,
) -> EnvBase:
    """Make the training environment of ``[robots]``, with what a run records of ``info``."""
    env = NavigationTorchEnv(
        world=world,
        num_envs=robots,
        info_keys=INFO,
        hindsight=hindsight,
        **episode_arguments(settings),
        **task_arguments(settings),
    )
    return TransformedEnv(env, DiscreteWheels()) if discrete else env


class FilteredRobots:
    """Lets the actions of some robots pass the filter, as many as the settings say: the first."""

    def __init__(self, settings: TrainSettings) -> None:
        task = settings.environment
        self._share = 0.0 if is_discrete(settings.learner) else task.filter
        self._cost = task.filter_cost
        self._keep = TaskConfig(**env_arguments(task)).make_filter() if self._share else None

    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        """Replace ``"action"`` by what is carried out, ``[N, 2]``."""
        if self._keep is None:
            return state
        actions = state["action"].clone()
        some = slice(math.ceil(self._share * len(actions)))
        kept = self._keep(state["observation"][some].numpy(), actions[some].numpy())
        actions[some] = torch.from_numpy(kept)
        self._chosen = state["action"]
        return state.set("action", actions)

    def charge(self, state: TensorDictBase) -> None:
        """Store what was chosen in place of what was carried out, at the cost of the change."""
        if self._keep is not None and self._cost is not None:
            change = (state["action"] - self._chosen).abs().amax(-1, keepdim=True)
            state["next", "reward"] -= self._cost * change
            state.set("action", self._chosen)


def vector_of(env: EnvBase) -> VectorNavigationEnv:
    """Return the robots in an environment of :func:`make_training_env`."""
    base = env.base_env if isinstance(env, TransformedEnv) else env
    assert isinstance(base, NavigationTorchEnv)
    return base.env
