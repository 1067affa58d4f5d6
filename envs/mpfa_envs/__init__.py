"""A PyBullet navigation task for gymnasium and TorchRL."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpfa_envs.driver import Filtered as Filtered
    from mpfa_envs.env.config import PAPER_TASK as PAPER_TASK
    from mpfa_envs.env.config import TaskConfig as TaskConfig
    from mpfa_envs.env.hindsight import GoalRelabeling as GoalRelabeling
    from mpfa_envs.env.navigation import NavigationEnv as NavigationEnv
    from mpfa_envs.env.registration import ENV_IDS as ENV_IDS
    from mpfa_envs.env.registration import ROOMS_TASK as ROOMS_TASK
    from mpfa_envs.env.torchrl_env import NavigationTorchEnv as NavigationTorchEnv
    from mpfa_envs.env.torchrl_env import make_navigation_env as make_navigation_env
    from mpfa_envs.env.vector import VectorNavigationEnv as VectorNavigationEnv
    from mpfa_envs.evaluation.results import summarize as summarize
    from mpfa_envs.evaluation.runs import evaluate as evaluate
    from mpfa_envs.evaluation.runs import run_tasks as run_tasks
    from mpfa_envs.generators.generate import GENERATORS as GENERATORS
    from mpfa_envs.generators.generate import generate_world as generate_world
    from mpfa_envs.generators.generate import register_generator as register_generator
    from mpfa_envs.planners import PLANNERS as PLANNERS
    from mpfa_envs.planners import make_pilot as make_pilot
    from mpfa_envs.planners import make_planner as make_planner
    from mpfa_envs.policies.export import export_policy as export_policy
    from mpfa_envs.policies.policy import POLICIES as POLICIES
    from mpfa_envs.policies.policy import Policy as Policy
    from mpfa_envs.policies.policy import load_policy as load_policy
    from mpfa_envs.policies.policy import save_policy as save_policy
    from mpfa_envs.robots.discrete import DiscreteWheels as DiscreteWheels
    from mpfa_envs.robots.model import ROBOTS as ROBOTS
    from mpfa_envs.robots.model import RobotModel as RobotModel
    from mpfa_envs.robots.noise import RobotNoise as RobotNoise
    from mpfa_envs.robots.robot_file import RobotFileError as RobotFileError
    from mpfa_envs.robots.robot_file import load_robot as load_robot
    from mpfa_envs.safety.filter import SafetyFilter as SafetyFilter
    from mpfa_envs.sensing.lidar import Lidar as Lidar
    from mpfa_envs.sensing.mirror import Mirror as Mirror
    from mpfa_envs.sensing.mirror import RandomMirror as RandomMirror
    from mpfa_envs.sensing.observation import OBSERVATION as OBSERVATION
    from mpfa_envs.sensing.sensors import SENSORS as SENSORS
    from mpfa_envs.sensing.sensors import LidarSensor as LidarSensor
    from mpfa_envs.sensing.sensors import Sensor as Sensor
    from mpfa_envs.sensing.sensors import Sight as Sight
    from mpfa_envs.tasks.reward import REWARDS as REWARDS
    from mpfa_envs.tasks.reward import RewardTerms as RewardTerms
    from mpfa_envs.tasks.reward import StepOutcome as StepOutcome
    from mpfa_envs.tasks.reward import navigation_reward as navigation_reward
    from mpfa_envs.tasks.sampling import WorldTask as WorldTask
    from mpfa_envs.tasks.sampling import world_tasks as world_tasks
    from mpfa_envs.worlds.builtin import WORLDS as WORLDS
    from mpfa_envs.worlds.shapes import Box as Box
    from mpfa_envs.worlds.shapes import Cylinder as Cylinder
    from mpfa_envs.worlds.shapes import Polygon as Polygon
    from mpfa_envs.worlds.walker import Walker as Walker
    from mpfa_envs.worlds.world import Task as Task
    from mpfa_envs.worlds.world import World as World
    from mpfa_envs.worlds.world_file import load_world as load_world
    from mpfa_envs.worlds.world_file import save_world as save_world
    from mpfa_envs.worlds.yaml_nodes import WorldFileError as WorldFileError

EXAMPLE_WORLD = Path(__file__).parent / "assets" / "worlds" / "example.yaml"
"""A world file to start your own from."""
EXAMPLE_ROBOT = Path(__file__).parent / "assets" / "robots" / "example.yaml"
"""A robot file to start your own from."""

_NAMES = {
    "driver": "Filtered",
    "env.config": "PAPER_TASK TaskConfig",
    "env.hindsight": "GoalRelabeling",
    "env.navigation": "NavigationEnv",
    "env.registration": "ENV_IDS ROOMS_TASK",
    "env.torchrl_env": "NavigationTorchEnv make_navigation_env",
    "env.vector": "VectorNavigationEnv",
    "evaluation.results": "summarize",
    "evaluation.runs": "evaluate run_tasks",
    "generators.generate": "GENERATORS generate_world register_generator",
    "planners": "PLANNERS make_pilot make_planner",
    "policies.export": "export_policy",
    "policies.policy": "POLICIES Policy load_policy save_policy",
    "robots.discrete": "DiscreteWheels",
    "robots.model": "ROBOTS RobotModel",
    "robots.noise": "RobotNoise",
    "robots.robot_file": "RobotFileError load_robot",
    "safety.filter": "SafetyFilter",
    "sensing.lidar": "Lidar",
    "sensing.mirror": "Mirror RandomMirror",
    "sensing.observation": "OBSERVATION",
    "sensing.sensors": "SENSORS LidarSensor Sensor Sight",
    "tasks.reward": "REWARDS RewardTerms StepOutcome navigation_reward",
    "tasks.sampling": "WorldTask world_tasks",
    "worlds.builtin": "WORLDS",
    "worlds.shapes": "Box Cylinder Polygon",
    "worlds.walker": "Walker",
    "worlds.world": "Task World",
    "worlds.world_file": "load_world save_world",
    "worlds.yaml_nodes": "WorldFileError",
}
"""Public names by module. A module is imported when a name of it is first used: a robot that
runs :mod:`mpfa_envs.deploy` has neither SciPy nor torch, and Numba takes half a second."""
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(
    ["EXAMPLE_ROBOT", "EXAMPLE_WORLD", *_MODULE_OF], key=lambda name: (not name.isupper(), name)
)
_OF_THE_EXTRA = ("gymnasium", "numba", "PIL", "yaml", "scipy")


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    module = _MODULE_OF.get(name)
    if module is not None:
        try:
            return getattr(import_module(f"mpfa_envs.{module}"), name)
        except ModuleNotFoundError as error:
            package = str(error.name).partition(".")[0]
            if package not in _OF_THE_EXTRA:
                raise
            needs = (
                f"mpfa_envs.{name} needs {package}: install the extra 'envs', see Install in the "
                "README"
            )
            raise ImportError(needs, name=error.name) from error
    return _submodule(__name__, name)


def _submodule(package: str, name: str) -> Any:
    """A module of a package, which is an attribute of it only once it was imported."""
    path = f"{package}.{name}"
    if find_spec(path) is None:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    module = import_module(path)
    if hasattr(module, "__path__"):
        vars(module).setdefault("__getattr__", partial(_submodule, path))
    return module


# Other modules import parts of these; importing one of them alone costs nothing.
for _folder in (
    *("env", "evaluation", "paths", "policies", "robots", "ros"),
    *("safety", "scene", "sensing", "tasks", "walkers", "worlds"),
):
    _submodule(__name__, _folder)
# A robot that runs :mod:`mpfa_envs.deploy` may have no gymnasium, and needs no ids.
if find_spec("gymnasium") is not None:
    import_module("mpfa_envs.env.registration")
