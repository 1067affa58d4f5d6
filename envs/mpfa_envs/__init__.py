"""A PyBullet navigation task for gymnasium and TorchRL."""

from __future__ import annotations

import warnings
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpfa_envs.later import after_import

if TYPE_CHECKING:
    from mpfa_envs.barn import BARN_WORLDS, barn_task, barn_world
    from mpfa_envs.binning import Binning
    from mpfa_envs.builtin_worlds import WORLDS
    from mpfa_envs.config import PAPER_TASK, TaskConfig
    from mpfa_envs.discrete import WHEEL_PAIRS, DiscreteWheels
    from mpfa_envs.distance import DistanceField, FreeGrid
    from mpfa_envs.evaluation import Driver, evaluate, run_tasks
    from mpfa_envs.export import export_policy
    from mpfa_envs.gazebo import load_gazebo_world
    from mpfa_envs.generators import (
        GENERATORS,
        generate_world,
        generator_tasks,
        register_generator,
        split_worlds,
        world_seed,
    )
    from mpfa_envs.grid_tasks import sample_task_on_grid
    from mpfa_envs.lidar import Lidar
    from mpfa_envs.map_memory import MapMemory
    from mpfa_envs.mirror import Mirror, RandomMirror
    from mpfa_envs.navigation import NavigationEnv
    from mpfa_envs.noise import RobotNoise
    from mpfa_envs.observation import INFO_TYPES, OBSERVATION, observation_slices
    from mpfa_envs.occupancy import OccupancyGrid
    from mpfa_envs.path import PathPlanner
    from mpfa_envs.planners import PLANNERS, DynamicWindow, MapPlanner, make_planner
    from mpfa_envs.policy import Policy, PolicyFileError
    from mpfa_envs.policy_file import load_policy, save_policy
    from mpfa_envs.registration import ENV_IDS, ROOMS_TASK
    from mpfa_envs.render import render_trajectories
    from mpfa_envs.results import EpisodeResult, Interval, spl, summarize
    from mpfa_envs.reward import RewardTerms, StepOutcome, navigation_reward
    from mpfa_envs.robot import ROBOTS, RobotModel
    from mpfa_envs.shapes import Box, Cylinder, Polygon
    from mpfa_envs.task_sets import WorldTask, world_tasks
    from mpfa_envs.tasks import Task, evaluation_pairs, sample_task
    from mpfa_envs.torchrl_env import NavigationTorchEnv, make_navigation_env
    from mpfa_envs.vector import VectorNavigationEnv
    from mpfa_envs.walkers import Walker
    from mpfa_envs.world_file import load_world, save_world
    from mpfa_envs.worlds import World, WorldArrays
    from mpfa_envs.yaml_nodes import WorldFileError

EXAMPLE_WORLD = Path(__file__).parent / "assets" / "worlds" / "example.yaml"
"""A world file to start your own from."""

__all__ = [
    "BARN_WORLDS",
    "ENV_IDS",
    "EXAMPLE_WORLD",
    "GENERATORS",
    "INFO_TYPES",
    "OBSERVATION",
    "PAPER_TASK",
    "PLANNERS",
    "ROBOTS",
    "ROOMS_TASK",
    "WHEEL_PAIRS",
    "WORLDS",
    "Binning",
    "Box",
    "Cylinder",
    "DiscreteWheels",
    "DistanceField",
    "Driver",
    "DynamicWindow",
    "EpisodeResult",
    "FreeGrid",
    "Interval",
    "Lidar",
    "MapMemory",
    "MapPlanner",
    "Mirror",
    "NavigationEnv",
    "NavigationTorchEnv",
    "OccupancyGrid",
    "PathPlanner",
    "Policy",
    "PolicyFileError",
    "Polygon",
    "RandomMirror",
    "RewardTerms",
    "RobotModel",
    "RobotNoise",
    "StepOutcome",
    "Task",
    "TaskConfig",
    "VectorNavigationEnv",
    "Walker",
    "World",
    "WorldArrays",
    "WorldFileError",
    "WorldTask",
    "barn_task",
    "barn_world",
    "evaluate",
    "evaluation_pairs",
    "export_policy",
    "generate_world",
    "generator_tasks",
    "load_gazebo_world",
    "load_policy",
    "load_world",
    "make_navigation_env",
    "make_planner",
    "navigation_reward",
    "observation_slices",
    "register_generator",
    "render_trajectories",
    "run_tasks",
    "sample_task",
    "sample_task_on_grid",
    "save_policy",
    "save_world",
    "spl",
    "split_worlds",
    "summarize",
    "world_seed",
    "world_tasks",
]

_MODULES = {
    "BARN_WORLDS": "barn",
    "ENV_IDS": "registration",
    "GENERATORS": "generators",
    "INFO_TYPES": "observation",
    "OBSERVATION": "observation",
    "PAPER_TASK": "config",
    "PLANNERS": "planners",
    "ROBOTS": "robot",
    "ROOMS_TASK": "registration",
    "WHEEL_PAIRS": "discrete",
    "WORLDS": "builtin_worlds",
    "Binning": "binning",
    "Box": "shapes",
    "Cylinder": "shapes",
    "DiscreteWheels": "discrete",
    "DistanceField": "distance",
    "Driver": "evaluation",
    "DynamicWindow": "planners",
    "EpisodeResult": "results",
    "FreeGrid": "distance",
    "Interval": "results",
    "Lidar": "lidar",
    "MapMemory": "map_memory",
    "MapPlanner": "planners",
    "Mirror": "mirror",
    "NavigationEnv": "navigation",
    "NavigationTorchEnv": "torchrl_env",
    "OccupancyGrid": "occupancy",
    "PathPlanner": "path",
    "Policy": "policy",
    "PolicyFileError": "policy",
    "Polygon": "shapes",
    "RandomMirror": "mirror",
    "RewardTerms": "reward",
    "RobotModel": "robot",
    "RobotNoise": "noise",
    "StepOutcome": "reward",
    "Task": "tasks",
    "TaskConfig": "config",
    "VectorNavigationEnv": "vector",
    "Walker": "walkers",
    "World": "worlds",
    "WorldArrays": "worlds",
    "WorldFileError": "yaml_nodes",
    "WorldTask": "task_sets",
    "barn_task": "barn",
    "barn_world": "barn",
    "evaluate": "evaluation",
    "evaluation_pairs": "tasks",
    "export_policy": "export",
    "generate_world": "generators",
    "generator_tasks": "generators",
    "load_gazebo_world": "gazebo",
    "load_policy": "policy_file",
    "load_world": "world_file",
    "make_navigation_env": "torchrl_env",
    "make_planner": "planners",
    "navigation_reward": "reward",
    "observation_slices": "observation",
    "register_generator": "generators",
    "render_trajectories": "render",
    "run_tasks": "evaluation",
    "sample_task": "tasks",
    "sample_task_on_grid": "grid_tasks",
    "save_policy": "policy_file",
    "save_world": "world_file",
    "spl": "results",
    "split_worlds": "generators",
    "summarize": "results",
    "world_seed": "generators",
    "world_tasks": "task_sets",
}
"""Where each name is. A module is imported when a name of it is first asked for: a robot that runs
:mod:`mpfa_envs.deploy` has neither gymnasium nor torch, and Numba takes half a second."""
_RENAMED = {"RoomsEnv": "NavigationEnv", "VECTOR_ENV_IDS": "ENV_IDS"}
"""Old names, which stay for one version."""
_OF_THE_EXTRA = ("gymnasium", "networkx", "numba", "PIL", "yaml", "scipy")


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for."""
    if name in _RENAMED:
        message = f"mpfa_envs.{name} is now mpfa_envs.{_RENAMED[name]}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        name = _RENAMED[name]
    if name in _MODULES:
        try:
            return getattr(import_module(f"mpfa_envs.{_MODULES[name]}"), name)
        except ModuleNotFoundError as error:
            package = str(error.name).partition(".")[0]
            if package not in _OF_THE_EXTRA:
                raise
            needs = f"mpfa_envs.{name} needs {package}: pip install 'torchrl-mpfa[envs]'"
            raise ImportError(needs, name=error.name) from error
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


after_import("gymnasium", "mpfa_envs.registration")
