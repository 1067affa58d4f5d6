"""A PyBullet navigation task for gymnasium and TorchRL."""

from __future__ import annotations

import warnings
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpfa_envs.later import after_import

if TYPE_CHECKING:
    from mpfa_envs.env.config import PAPER_TASK, TaskConfig
    from mpfa_envs.env.navigation import NavigationEnv
    from mpfa_envs.env.registration import ENV_IDS, ROOMS_TASK
    from mpfa_envs.env.torchrl_env import NavigationTorchEnv, make_navigation_env
    from mpfa_envs.env.vector import VectorNavigationEnv
    from mpfa_envs.evaluation.results import EpisodeResult, Interval, spl, summarize
    from mpfa_envs.evaluation.runs import Driver, evaluate, run_tasks
    from mpfa_envs.generators import (
        GENERATORS,
        generate_world,
        generator_tasks,
        register_generator,
        split_worlds,
        world_seed,
    )
    from mpfa_envs.paths.distance import DistanceField, FreeGrid
    from mpfa_envs.paths.planner import PathPlanner
    from mpfa_envs.paths.tasks import sample_task_on_grid
    from mpfa_envs.planners import PLANNERS, DynamicWindow, MapPlanner, make_planner
    from mpfa_envs.policies.export import export_policy
    from mpfa_envs.policies.files import load_policy, save_policy
    from mpfa_envs.policies.policy import Policy, PolicyFileError
    from mpfa_envs.render import render_trajectories
    from mpfa_envs.robots.discrete import WHEEL_PAIRS, DiscreteWheels
    from mpfa_envs.robots.model import ROBOTS, RobotModel
    from mpfa_envs.robots.noise import RobotNoise
    from mpfa_envs.sensing.binning import Binning
    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.sensing.map_memory import MapMemory
    from mpfa_envs.sensing.mirror import Mirror, RandomMirror
    from mpfa_envs.sensing.observation import INFO_TYPES, OBSERVATION, observation_slices
    from mpfa_envs.tasks.reward import RewardTerms, StepOutcome, navigation_reward
    from mpfa_envs.tasks.sampling import evaluation_pairs, sample_task
    from mpfa_envs.tasks.sets import WorldTask, world_tasks
    from mpfa_envs.worlds.barn import BARN_WORLDS, barn_task, barn_world
    from mpfa_envs.worlds.builtin import WORLDS
    from mpfa_envs.worlds.gazebo import load_gazebo_world
    from mpfa_envs.worlds.occupancy import OccupancyGrid
    from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon
    from mpfa_envs.worlds.task import Task
    from mpfa_envs.worlds.walker import Walker
    from mpfa_envs.worlds.world import World, WorldArrays
    from mpfa_envs.worlds.world_file import load_world, save_world
    from mpfa_envs.worlds.yaml_nodes import WorldFileError

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
    "BARN_WORLDS": "worlds.barn",
    "ENV_IDS": "env.registration",
    "GENERATORS": "generators",
    "INFO_TYPES": "sensing.observation",
    "OBSERVATION": "sensing.observation",
    "PAPER_TASK": "env.config",
    "PLANNERS": "planners",
    "ROBOTS": "robots.model",
    "ROOMS_TASK": "env.registration",
    "WHEEL_PAIRS": "robots.discrete",
    "WORLDS": "worlds.builtin",
    "Binning": "sensing.binning",
    "Box": "worlds.shapes",
    "Cylinder": "worlds.shapes",
    "DiscreteWheels": "robots.discrete",
    "DistanceField": "paths.distance",
    "Driver": "evaluation.runs",
    "DynamicWindow": "planners",
    "EpisodeResult": "evaluation.results",
    "FreeGrid": "paths.distance",
    "Interval": "evaluation.results",
    "Lidar": "sensing.lidar",
    "MapMemory": "sensing.map_memory",
    "MapPlanner": "planners",
    "Mirror": "sensing.mirror",
    "NavigationEnv": "env.navigation",
    "NavigationTorchEnv": "env.torchrl_env",
    "OccupancyGrid": "worlds.occupancy",
    "PathPlanner": "paths.planner",
    "Policy": "policies.policy",
    "PolicyFileError": "policies.policy",
    "Polygon": "worlds.shapes",
    "RandomMirror": "sensing.mirror",
    "RewardTerms": "tasks.reward",
    "RobotModel": "robots.model",
    "RobotNoise": "robots.noise",
    "StepOutcome": "tasks.reward",
    "Task": "worlds.task",
    "TaskConfig": "env.config",
    "VectorNavigationEnv": "env.vector",
    "Walker": "worlds.walker",
    "World": "worlds.world",
    "WorldArrays": "worlds.world",
    "WorldFileError": "worlds.yaml_nodes",
    "WorldTask": "tasks.sets",
    "barn_task": "worlds.barn",
    "barn_world": "worlds.barn",
    "evaluate": "evaluation.runs",
    "evaluation_pairs": "tasks.sampling",
    "export_policy": "policies.export",
    "generate_world": "generators",
    "generator_tasks": "generators",
    "load_gazebo_world": "worlds.gazebo",
    "load_policy": "policies.files",
    "load_world": "worlds.world_file",
    "make_navigation_env": "env.torchrl_env",
    "make_planner": "planners",
    "navigation_reward": "tasks.reward",
    "observation_slices": "sensing.observation",
    "register_generator": "generators",
    "render_trajectories": "render",
    "run_tasks": "evaluation.runs",
    "sample_task": "tasks.sampling",
    "sample_task_on_grid": "paths.tasks",
    "save_policy": "policies.files",
    "save_world": "worlds.world_file",
    "spl": "evaluation.results",
    "split_worlds": "generators",
    "summarize": "evaluation.results",
    "world_seed": "generators",
    "world_tasks": "tasks.sets",
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


after_import("gymnasium", "mpfa_envs.env.registration")
