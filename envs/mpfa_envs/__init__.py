"""A PyBullet navigation task for gymnasium and TorchRL."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from mpfa_envs.arguments import PAPER_TASK
from mpfa_envs.barn import BARN_WORLDS, barn_task, barn_world
from mpfa_envs.binning import Binning
from mpfa_envs.builtin_worlds import WORLDS
from mpfa_envs.lidar import Lidar
from mpfa_envs.navigation import NavigationEnv
from mpfa_envs.observation import INFO_TYPES, OBSERVATION, observation_slices
from mpfa_envs.path import PathPlanner
from mpfa_envs.policy import Policy, PolicyFileError, load_policy, save_policy
from mpfa_envs.render import render_trajectories
from mpfa_envs.results import EpisodeResult, Interval, spl, summarize
from mpfa_envs.reward import RewardTerms, StepOutcome, navigation_reward
from mpfa_envs.robot import ROBOTS, RobotModel
from mpfa_envs.shapes import Box, Cylinder, Polygon
from mpfa_envs.tasks import Task, evaluation_pairs, sample_task
from mpfa_envs.walkers import Walker
from mpfa_envs.world_file import WorldFileError, load_world, save_world
from mpfa_envs.worlds import World, WorldArrays

if TYPE_CHECKING:
    from mpfa_envs.discrete import WHEEL_PAIRS, DiscreteWheels
    from mpfa_envs.distance import DistanceField, FreeGrid, sample_task_on_grid
    from mpfa_envs.evaluation import Driver, evaluate, run_tasks
    from mpfa_envs.generators import (
        GENERATORS,
        generate_world,
        generator_tasks,
        split_worlds,
        world_seed,
    )
    from mpfa_envs.mirror import Mirror, RandomMirror
    from mpfa_envs.planners import PLANNERS, DynamicWindow, MapPlanner, make_planner
    from mpfa_envs.task_sets import WorldTask, world_tasks
    from mpfa_envs.torchrl_env import NavigationTorchEnv, make_navigation_env
    from mpfa_envs.vector import VectorNavigationEnv

ENV_IDS = tuple(f"mpfa/Navigation-{name}-v1" for name in WORLDS)
"""The ids that ``gymnasium.make`` knows once this package is imported."""
VECTOR_ENV_IDS = tuple(
    f"mpfa/Navigation-{name}-v1"
    for name in ("Rooms", "Clutter", "Bars", "Fields", "Halls", "Mazes", "Mixed", "Crowd")
)
"""The ids of the generators' worlds, which only ``gymnasium.make_vec`` knows."""
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
    "VECTOR_ENV_IDS",
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
    "PathPlanner",
    "Policy",
    "PolicyFileError",
    "Polygon",
    "RandomMirror",
    "RewardTerms",
    "RobotModel",
    "StepOutcome",
    "Task",
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
    "generate_world",
    "generator_tasks",
    "load_policy",
    "load_world",
    "make_navigation_env",
    "make_planner",
    "navigation_reward",
    "observation_slices",
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


def _refuse_one_robot(world: str, **_: Any) -> Any:
    raise gymnasium.error.Error(
        f"world {world!r} is new in each episode, which VectorNavigationEnv alone has: use "
        f"gymnasium.make_vec('mpfa/Navigation-{world.capitalize()}-v1', num_envs=1), or one world "
        f"of it: gymnasium.make('mpfa/Navigation-A-v1', world='{world}-7')"
    )


for _id, _name in zip(ENV_IDS, WORLDS, strict=True):
    # A second import, as after a reload, must not warn about an id that is known.
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mpfa_envs.navigation:NavigationEnv",
            vector_entry_point="mpfa_envs.vector:VectorNavigationEnv",
            kwargs={"world": _name},
        )
for _id in VECTOR_ENV_IDS:
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mpfa_envs:_refuse_one_robot",
            vector_entry_point="mpfa_envs.vector:VectorNavigationEnv",
            kwargs={"world": _id.split("-")[1].lower()},
        )


_LATER = {
    "GENERATORS": "generators",
    "WHEEL_PAIRS": "discrete",
    "DiscreteWheels": "discrete",
    "PLANNERS": "planners",
    "DistanceField": "distance",
    "Driver": "evaluation",
    "DynamicWindow": "planners",
    "FreeGrid": "distance",
    "MapMemory": "map_memory",
    "MapPlanner": "planners",
    "Mirror": "mirror",
    "NavigationTorchEnv": "torchrl_env",
    "RandomMirror": "mirror",
    "VectorNavigationEnv": "vector",
    "WorldTask": "task_sets",
    "evaluate": "evaluation",
    "generate_world": "generators",
    "generator_tasks": "generators",
    "make_navigation_env": "torchrl_env",
    "make_planner": "planners",
    "run_tasks": "evaluation",
    "sample_task_on_grid": "distance",
    "split_worlds": "generators",
    "world_seed": "generators",
    "world_tasks": "task_sets",
}
"""Names whose modules need torch, or Numba, which takes half a second to import."""


def __getattr__(name: str) -> Any:
    """Import the parts that take long when they are first asked for."""
    if name in _LATER:
        return getattr(import_module(f"mpfa_envs.{_LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
