"""Classic drivers: planners on the known map, the dynamic window and predictive control."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from mpfa_envs.checks import check_choice, got
from mpfa_envs.planners.ant_colony import AntColony
from mpfa_envs.planners.dynamic_window import DynamicWindow, WindowScore
from mpfa_envs.planners.map_planner import (
    MapPlanner,
    PurePursuit,
    Search,
    path_length,
    shortest_path,
)
from mpfa_envs.planners.predictive import PredictiveControl
from mpfa_envs.robots.resolve import RobotChoice
from mpfa_envs.sensing.observation import Memory

__all__ = [
    "PLANNERS",
    "AntColony",
    "DynamicWindow",
    "MapPlanner",
    "PredictiveControl",
    "PurePursuit",
    "Search",
    "WindowScore",
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
