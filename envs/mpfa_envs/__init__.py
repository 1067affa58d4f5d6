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
    from mpfa_envs.evaluation.results import summarize
    from mpfa_envs.evaluation.runs import evaluate, run_tasks
    from mpfa_envs.generators import GENERATORS, generate_world, register_generator
    from mpfa_envs.planners import PLANNERS, make_planner
    from mpfa_envs.policies.export import export_policy
    from mpfa_envs.policies.files import load_policy, save_policy
    from mpfa_envs.policies.policy import Policy
    from mpfa_envs.robots.discrete import DiscreteWheels
    from mpfa_envs.robots.model import ROBOTS, RobotModel
    from mpfa_envs.robots.noise import RobotNoise
    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.sensing.mirror import Mirror, RandomMirror
    from mpfa_envs.sensing.observation import OBSERVATION
    from mpfa_envs.tasks.reward import RewardTerms, StepOutcome, navigation_reward
    from mpfa_envs.tasks.sets import WorldTask, world_tasks
    from mpfa_envs.worlds.builtin import WORLDS
    from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon
    from mpfa_envs.worlds.task import Task
    from mpfa_envs.worlds.walker import Walker
    from mpfa_envs.worlds.world import World
    from mpfa_envs.worlds.world_file import load_world, save_world
    from mpfa_envs.worlds.yaml_nodes import WorldFileError

EXAMPLE_WORLD = Path(__file__).parent / "assets" / "worlds" / "example.yaml"
"""A world file to start your own from."""

__all__ = [
    "ENV_IDS",
    "EXAMPLE_WORLD",
    "GENERATORS",
    "OBSERVATION",
    "PAPER_TASK",
    "PLANNERS",
    "ROBOTS",
    "ROOMS_TASK",
    "WORLDS",
    "Box",
    "Cylinder",
    "DiscreteWheels",
    "Lidar",
    "Mirror",
    "NavigationEnv",
    "NavigationTorchEnv",
    "Policy",
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
    "WorldFileError",
    "WorldTask",
    "evaluate",
    "export_policy",
    "generate_world",
    "load_policy",
    "load_world",
    "make_navigation_env",
    "make_planner",
    "navigation_reward",
    "register_generator",
    "run_tasks",
    "save_policy",
    "save_world",
    "summarize",
    "world_tasks",
]

_MODULES = {
    "ENV_IDS": "env.registration",
    "GENERATORS": "generators",
    "OBSERVATION": "sensing.observation",
    "PAPER_TASK": "env.config",
    "PLANNERS": "planners",
    "ROBOTS": "robots.model",
    "ROOMS_TASK": "env.registration",
    "WORLDS": "worlds.builtin",
    "Box": "worlds.shapes",
    "Cylinder": "worlds.shapes",
    "DiscreteWheels": "robots.discrete",
    "Lidar": "sensing.lidar",
    "Mirror": "sensing.mirror",
    "NavigationEnv": "env.navigation",
    "NavigationTorchEnv": "env.torchrl_env",
    "Policy": "policies.policy",
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
    "WorldFileError": "worlds.yaml_nodes",
    "WorldTask": "tasks.sets",
    "evaluate": "evaluation.runs",
    "export_policy": "policies.export",
    "generate_world": "generators",
    "load_policy": "policies.files",
    "load_world": "worlds.world_file",
    "make_navigation_env": "env.torchrl_env",
    "make_planner": "planners",
    "navigation_reward": "tasks.reward",
    "register_generator": "generators",
    "run_tasks": "evaluation.runs",
    "save_policy": "policies.files",
    "save_world": "worlds.world_file",
    "summarize": "evaluation.results",
    "world_tasks": "tasks.sets",
}
"""Where each name is. A module is imported when a name of it is first asked for: a robot that runs
:mod:`mpfa_envs.deploy` has neither gymnasium nor torch, and Numba takes half a second."""
_RENAMED = {
    "BARN_WORLDS": "worlds.barn.BARN_WORLDS",
    "Binning": "sensing.binning.Binning",
    "DistanceField": "paths.distance.DistanceField",
    "Driver": "evaluation.runs.Driver",
    "DynamicWindow": "planners.DynamicWindow",
    "EpisodeResult": "evaluation.results.EpisodeResult",
    "FreeGrid": "paths.distance.FreeGrid",
    "INFO_TYPES": "sensing.observation.INFO_TYPES",
    "Interval": "evaluation.results.Interval",
    "MapMemory": "sensing.map_memory.MapMemory",
    "MapPlanner": "planners.MapPlanner",
    "OccupancyGrid": "worlds.occupancy.OccupancyGrid",
    "PathPlanner": "paths.planner.PathPlanner",
    "PolicyFileError": "policies.policy.PolicyFileError",
    "RoomsEnv": "env.navigation.NavigationEnv",
    "VECTOR_ENV_IDS": "env.registration.ENV_IDS",
    "WHEEL_PAIRS": "robots.discrete.WHEEL_PAIRS",
    "WorldArrays": "worlds.world.WorldArrays",
    "barn_task": "worlds.barn.barn_task",
    "barn_world": "worlds.barn.barn_world",
    "evaluation_pairs": "tasks.sampling.evaluation_pairs",
    "generator_tasks": "generators.generator_tasks",
    "load_gazebo_world": "worlds.gazebo.load_gazebo_world",
    "observation_slices": "sensing.observation.observation_slices",
    "render_trajectories": "render.render_trajectories",
    "sample_task": "tasks.sampling.sample_task",
    "sample_task_on_grid": "paths.tasks.sample_task_on_grid",
    "spl": "evaluation.results.spl",
    "split_worlds": "generators.split_worlds",
    "world_seed": "generators.world_seed",
}
"""Old names, which stay for one version, and where they are."""
_OF_THE_EXTRA = ("gymnasium", "networkx", "numba", "PIL", "yaml", "scipy")


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for."""
    module = _MODULES.get(name)
    if name in _RENAMED:
        message = f"mpfa_envs.{name} is now mpfa_envs.{_RENAMED[name]}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        module, _, name = _RENAMED[name].rpartition(".")
    if module is not None:
        try:
            return getattr(import_module(f"mpfa_envs.{module}"), name)
        except ModuleNotFoundError as error:
            package = str(error.name).partition(".")[0]
            if package not in _OF_THE_EXTRA:
                raise
            needs = f"mpfa_envs.{name} needs {package}: pip install 'torchrl-mpfa[envs]'"
            raise ImportError(needs, name=error.name) from error
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


after_import("gymnasium", "mpfa_envs.env.registration")
