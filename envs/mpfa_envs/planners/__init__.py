"""Classic drivers: planners on the known map, the dynamic window and predictive control."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from mpfa_envs.checks import check_choice, got
from mpfa_envs.control.predictive import PredictiveControl
from mpfa_envs.planners.ant_colony import AntColony
from mpfa_envs.planners.dynamic_window import DynamicWindow, WindowScore
from mpfa_envs.planners.map_planner import (
    MapPlanner,
    PurePursuit,
    Search,
    path_length,
    shortest_path,
)
from mpfa_envs.planners.piloted import pilot_of
from mpfa_envs.robots.resolve import RobotChoice
from mpfa_envs.sensing.observation import Memory

if TYPE_CHECKING:
    from mpfa_envs.deploy.pilot import Pilot

__all__ = [
    "PLANNERS",
    "AntColony",
    "DynamicWindow",
    "MapPlanner",
    "PredictiveControl",
    "PurePursuit",
    "Search",
    "WindowScore",
    "make_pilot",
    "make_planner",
    "path_length",
    "shortest_path",
]

PLANNERS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "astar": "the shortest path on the known map, as of dijkstra, followed by pure pursuit",
        "dijkstra": "the shortest path on the known map, followed by pure pursuit",
        "ant_colony": "an ant colony on the known map, followed by pure pursuit",
        "dwa": "the dynamic window approach, which sees the observation alone",
        "mpc": "sampling model predictive control, on a map of the robot's own",
    }
)
"""The planners by name, each in a sentence."""
_COARSE: Final = 0.2
"""Side of the ants' cells [m]: finer ones double their steps and improve little."""


def make_planner(
    name: str,
    *,
    robot: RobotChoice = "turtlebot2",
    memory: Memory = "none",
    seed: int = 0,
) -> MapPlanner | DynamicWindow | PredictiveControl:
    """Make a planner, which :func:`~mpfa_envs.evaluate` drives as it does a trained policy.

    Args:
        name: One of :data:`PLANNERS`.
        robot: What drives.
        memory: Of the dynamic window: whether it sees the path on the robot's map. Predictive
            control always has the map.
        seed: Of the ant colony, and of predictive control.

    Returns:
        The planner.

    Raises:
        ValueError: If there is no such planner, or it has no use for a memory.

    Examples:
        >>> from mpfa_envs import evaluate, make_planner
        >>> planner = make_planner("astar")
        >>> [each.success for each in evaluate(planner, "B", episodes=2, physics="kinematic")]
        [True, True]
    """
    if name not in PLANNERS:
        raise ValueError(f"name must be one of {sorted(PLANNERS)}, {got(name, PLANNERS)}")
    if name == "dwa":
        return DynamicWindow(robot=robot, memory=memory)
    if name == "mpc":
        check_choice("memory", memory, Memory)
        return PredictiveControl(robot=robot, seed=seed)
    if memory != "none":
        raise ValueError(f"memory must be 'none' for {name}, which knows the map, got {memory!r}")
    if name == "ant_colony":
        return MapPlanner(AntColony(seed=seed), robot=robot, resolution=_COARSE)
    return MapPlanner(shortest_path, robot=robot)


def make_pilot(name: str, *, robot: RobotChoice, seed: int = 0, **options: Any) -> Pilot:
    """Make a pilot of a planner, which drives a robot without a policy.

    Args:
        name: One of :data:`PLANNERS`; those that know the map need a ``plan`` when they begin.
        robot: What drives; its file says where the lidar is and what it sees.
        seed: As for :func:`make_planner`.
        **options: Of the :class:`~mpfa_envs.deploy.Pilot`. The ``clearance`` is that of the filter
            by default, if the robot can stop.

    Returns:
        The pilot.

    Raises:
        ValueError: If there is no such planner, or an option is out of its range.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs.deploy import Scan
        >>> from mpfa_envs.planners import make_pilot
        >>> pilot = make_pilot("mpc", robot="kobuki")
        >>> pilot.begin(goal=(3.0, 0.0))
        >>> scan = Scan(-np.pi, np.pi / 180, np.full(360, 5.0), 0.1, 10.0)
        >>> pilot.decide(scan, pose=(0.0, 0.0, 0.0), speeds=(0.0, 0.0)).linear > 0.5
        True
    """
    memory: Memory = "map" if name == "dwa" else "none"
    return pilot_of(make_planner(name, robot=robot, memory=memory, seed=seed), **options)
