"""A PyBullet navigation task for gymnasium and TorchRL."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from mpfa_envs.builtin_worlds import WORLDS
from mpfa_envs.evaluation import (
    EpisodeResult,
    Interval,
    evaluate,
    run_episodes,
    spl,
    summarize,
)
from mpfa_envs.lidar import Lidar
from mpfa_envs.navigation import PAPER_TASK, NavigationEnv
from mpfa_envs.observation import INFO_TYPES, OBSERVATION, observation_slices
from mpfa_envs.path import PathPlanner
from mpfa_envs.policy import Policy, PolicyFileError, load_policy, save_policy
from mpfa_envs.random_worlds import random_world
from mpfa_envs.render import render_trajectories
from mpfa_envs.reward import RewardTerms, StepOutcome, navigation_reward
from mpfa_envs.robot import ROBOTS, RobotModel
from mpfa_envs.tasks import Task, evaluation_pairs, sample_task
from mpfa_envs.world_file import WorldFileError, load_world, save_world
from mpfa_envs.worlds import Box, Cylinder, World

if TYPE_CHECKING:
    from mpfa_envs.mirror import Mirror, RandomMirror
    from mpfa_envs.torchrl_env import NavigationTorchEnv, make_navigation_env

ENV_IDS = tuple(f"mpfa/Navigation-{name}-v1" for name in WORLDS)
"""The ids that ``gymnasium.make`` knows once this package is imported."""
EXAMPLE_WORLD = Path(__file__).parent / "assets" / "worlds" / "example.yaml"
"""A world file to start your own from."""

__all__ = [
    "ENV_IDS",
    "EXAMPLE_WORLD",
    "INFO_TYPES",
    "OBSERVATION",
    "PAPER_TASK",
    "ROBOTS",
    "WORLDS",
    "Box",
    "Cylinder",
    "EpisodeResult",
    "Interval",
    "Lidar",
    "Mirror",
    "NavigationEnv",
    "NavigationTorchEnv",
    "PathPlanner",
    "Policy",
    "PolicyFileError",
    "RandomMirror",
    "RewardTerms",
    "RobotModel",
    "StepOutcome",
    "Task",
    "World",
    "WorldFileError",
    "evaluate",
    "evaluation_pairs",
    "load_policy",
    "load_world",
    "make_navigation_env",
    "navigation_reward",
    "observation_slices",
    "random_world",
    "render_trajectories",
    "run_episodes",
    "sample_task",
    "save_policy",
    "save_world",
    "spl",
    "summarize",
]

for _id, _name in zip(ENV_IDS, WORLDS, strict=True):
    # A second import, as after a reload, must not warn about an id that is known.
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id, entry_point="mpfa_envs.navigation:NavigationEnv", kwargs={"world": _name}
        )


_TORCH_PARTS = {
    "Mirror": "mirror",
    "NavigationTorchEnv": "torchrl_env",
    "RandomMirror": "mirror",
    "make_navigation_env": "torchrl_env",
}


def __getattr__(name: str) -> Any:
    """Import the TorchRL parts when they are first asked for: the rest needs no torch."""
    if name in _TORCH_PARTS:
        return getattr(import_module(f"mpfa_envs.{_TORCH_PARTS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
