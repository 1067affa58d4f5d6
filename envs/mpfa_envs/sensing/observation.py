"""Names, order and scales of the observation's parts, and the keys of the info dictionary."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from mpfa_envs.checks import check_choice, check_count

if TYPE_CHECKING:
    from numpy.typing import NDArray


Memory = Literal["none", "map"]
"""A robot's memory of its episode: none, or a map of its scans."""

GOAL_CLOSENESS_DISTANCE: Final = 0.3
"""A goal at this distance or nearer has closeness one [m]."""
DISTANCE_SCALE: Final = 10.0
"""Divides the distance to the goal in the observation [m]."""
SPEED_BOUND: Final = 2.0
"""Scaled speeds are clipped to this; a wheel that slips may exceed one for a moment."""

PATH_BOUND: Final = 1.5
"""The scaled length of the path is clipped to this. Longer paths are rare in training, and policies
that saw one stood or swung to and fro; farther ahead a meter changes nothing."""

_BOUNDS: Final = {
    "lidar": (0.0, 1.0),
    "goal_direction": (-1.0, 1.0),
    "goal_closeness": (0.0, 1.0),
    "goal_distance": (0.0, math.inf),
    "linear_speed": (-SPEED_BOUND, SPEED_BOUND),
    "angular_speed": (-SPEED_BOUND, SPEED_BOUND),
    "way_direction": (-1.0, 1.0),
    "way_length": (0.0, PATH_BOUND),
    "lidar_history": (0.0, 1.0),
}
FLAGS: Final[tuple[str, ...]] = ("success", "collision", "timeout")
"""Flags of the info dictionary, in the order of the tables."""
NUMBERS: Final[tuple[str, ...]] = (
    "reward_goal",
    "reward_collision",
    "reward_progress",
    "reward_other",
    "sim_time",
    "path_length",
    "shortest_path",
    "min_clearance",
    "distance",
    "x",
    "y",
    "heading",
    "walker_distance",
    "intrusion_time",
    "time_to_collision",
)
"""Its numbers, likewise."""
INFO_TYPES: Final[dict[str, type[bool] | type[float]]] = {
    **dict.fromkeys(FLAGS, bool),
    **dict.fromkeys(NUMBERS, float),
}
"""Keys of the info dictionary of every reset and step, with the type of their value."""


def observation_slices(
    sectors: int = 18, *, memory: Memory = "none", history: int = 0
) -> dict[str, slice]:
    """Name the parts of the observation.

    Args:
        sectors: Number of sectors of the lidar.
        memory: ``"map"`` adds the path on the robot's map.
        history: Number of earlier scans.

    Returns:
        The slice of each part, in order.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from mpfa_envs.sensing.observation import observation_slices
        >>> observation_slices()["goal_direction"]
        slice(18, 20, None)
    """
    check_choice("memory", memory, Memory)
    widths = {
        "lidar": check_count("sectors", sectors),
        "goal_direction": 2,
        "goal_closeness": 1,
        "goal_distance": 1,
        "linear_speed": 1,
        "angular_speed": 1,
    }
    if memory == "map":
        widths.update({"way_direction": 2, "way_length": 1})
    if check_count("history", history, least=0):
        widths["lidar_history"] = check_count("sectors * history", sectors * history)
    slices, first = {}, 0
    for name, width in widths.items():
        slices[name] = slice(first, first + width)
        first += width
    return slices


OBSERVATION: Final = observation_slices()
"""The parts of the observation with the default lidar."""


def observation_bounds(
    sectors: int, diagonal: float, *, memory: Memory = "none", history: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The least and the greatest observation, ``[O]``, in a room with this diagonal [m]."""
    low, high = [], []
    for name, part in observation_slices(sectors, memory=memory, history=history).items():
        width = part.stop - part.start
        low += [_BOUNDS[name][0]] * width
        high += [diagonal / DISTANCE_SCALE if name == "goal_distance" else _BOUNDS[name][1]] * width
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
