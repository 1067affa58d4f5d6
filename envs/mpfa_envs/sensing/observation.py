"""The observation: names, order and scales of its parts, how it is made, and its bins."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from mpfa_envs.checks import check_choice, check_count
from mpfa_envs.compiled import njit

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
    """The least and the greatest observation, ``[O]``, in a world with this diagonal [m]."""
    low, high = [], []
    for name, part in observation_slices(sectors, memory=memory, history=history).items():
        width = part.stop - part.start
        low += [_BOUNDS[name][0]] * width
        high += [diagonal / DISTANCE_SCALE if name == "goal_distance" else _BOUNDS[name][1]] * width
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


@njit
def observe_all(
    motions: NDArray[np.float64],  # poses and speeds by odometry [m, m, rad, m/s, rad/s], [N, 5]
    goals: NDArray[np.float64],  # x, y [m], [N, 2]
    distances: NDArray[np.float64],  # of the two [m], [N]
    fresh: NDArray[np.bool_],  # begins its episode: has always seen what it sees, [N]
    chosen: NDArray[np.bool_],  # [N]; the others' observations stay
    ranges: NDArray[np.float64],  # [m], [N, rays]
    median: bool,  # of a sector's rays, in place of the nearest
    scales: tuple[float, float, float],  # closeness_distance [m], top speeds [m/s, rad/s]
    paths: NDArray[np.float64],  # direction (x, y) and length [m], [N, 3]; [0, 3] without maps
    sectors: int,
    history: int,
    observations: NDArray[np.float32],  # [N, O]
) -> None:
    """Write the observations of the chosen robots."""
    count = ranges.shape[1] // sectors
    near, fastest, fastest_turn = scales
    for robot in range(observations.shape[0]):
        if not chosen[robot]:
            continue
        seen, rays = observations[robot], ranges[robot]
        start = seen.shape[0] - sectors * history
        if history:
            # The last scan moves to the first place of the earlier ones, and these one place on.
            # In loops: for an assignment of slices Numba compiles its errors, too, for two seconds.
            for index in range(seen.shape[0] - 1, start + sectors - 1, -1):
                seen[index] = seen[index - sectors]
            for sector in range(sectors):
                seen[start + sector] = seen[sector]
        for sector in range(sectors):
            nearest = _sector_range(rays, sector * count, count, median)
            seen[sector] = near / max(nearest, near)
        if fresh[robot]:
            for index in range(start, seen.shape[0]):
                seen[index] = seen[(index - start) % sectors]
        motion = motions[robot]
        seen[sectors + 4] = min(max(motion[3] / fastest, -SPEED_BOUND), SPEED_BOUND)
        seen[sectors + 5] = min(max(motion[4] / fastest_turn, -SPEED_BOUND), SPEED_BOUND)
    observe_goals(motions, goals, distances, chosen, paths, sectors, observations)


@njit
def observe_goals(
    motions: NDArray[np.float64],  # poses by odometry first [m, m, rad], [N, 5]
    goals: NDArray[np.float64],  # x, y [m], [N, 2]
    distances: NDArray[np.float64],  # of the two [m], [N]
    chosen: NDArray[np.bool_],  # [N]; the others' observations stay
    paths: NDArray[np.float64],  # direction (x, y) and length [m], [N, 3]; [0, 3] without maps
    sectors: int,
    observations: NDArray[np.float32],  # [N, O]
) -> None:
    """Write what depends on the goal in the observations of the chosen robots."""
    for robot in range(observations.shape[0]):
        if not chosen[robot]:
            continue
        seen, motion, distance = observations[robot], motions[robot], distances[robot]
        # A robot on the goal sees it ahead.
        bearing, closeness = 0.0, 1.0
        if distance > 0.0:
            goal = goals[robot]
            bearing = math.atan2(goal[1] - motion[1], goal[0] - motion[0]) - motion[2]
            closeness = min(GOAL_CLOSENESS_DISTANCE / distance, 1.0)
        seen[sectors], seen[sectors + 1] = math.cos(bearing), math.sin(bearing)
        seen[sectors + 2], seen[sectors + 3] = closeness, distance / DISTANCE_SCALE
        if paths.shape[0] > 0:
            seen[sectors + 6], seen[sectors + 7] = paths[robot, 0], paths[robot, 1]
            seen[sectors + 8] = min(paths[robot, 2] / DISTANCE_SCALE, PATH_BOUND)


@njit
def sector_ranges(rays: NDArray[np.float64], sectors: int, median: bool) -> NDArray[np.float64]:
    """Range of each sector, ``[sectors]``, of a scan ``[rays]``."""
    count = rays.shape[0] // sectors
    ranges = np.empty(sectors)
    for sector in range(sectors):
        ranges[sector] = _sector_range(rays, sector * count, count, median)
    return ranges


@njit
def _sector_range(rays: NDArray[np.float64], first: int, count: int, median: bool) -> float:
    """Range of the sector that begins at a ray: the median of its rays, or the nearest."""
    if median:
        ordered = rays[first : first + count].copy()
        for last in range(1, count):
            place, reach = last, ordered[last]
            while place > 0 and ordered[place - 1] > reach:
                ordered[place] = ordered[place - 1]
                place -= 1
            ordered[place] = reach
        half = count // 2
        if count % 2 == 1:
            return ordered[half]
        return 0.5 * (ordered[half - 1] + ordered[half])
    nearest = rays[first]
    for ray in range(first + 1, first + count):
        nearest = min(nearest, rays[ray])
    return nearest


@njit
def lidar_pose(pose: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """The pose, ``[3]``, of a lidar that a robot has at a place (x, y) in its frame [m]."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    return np.array((pose[0] + x * cosine - y * sine, pose[1] + x * sine + y * cosine, pose[2]))


@njit
def look_from(
    pose: NDArray[np.float64],  # x, y, heading first [m, m, rad], [3]
    angles: NDArray[np.float64],  # of the rays in the robot's frame [rad], [P]
    ranges: NDArray[np.float64],  # [m], [P]
    taken: NDArray[np.float64],  # pose where they were measured, [3]
    max_range: float,  # of a ray that has met nothing [m]
    view: float,  # [rad]
    seen: NDArray[np.float64],  # [m], [R]
) -> None:
    """Write the ranges, left to right, of a scan as it is from another pose.

    Where no ray points any more the nearer of the two beside it counts.
    """
    rays, around = seen.shape[0], view > math.tau - 1e-9
    hits = np.empty(rays)
    hits[:] = math.inf
    away_x, away_y = taken[0] - pose[0], taken[1] - pose[1]
    for ray in range(angles.shape[0]):
        angle, distance = angles[ray] + taken[2], ranges[ray]
        if distance < max_range:
            x = away_x + distance * math.cos(angle)
            y = away_y + distance * math.sin(angle)
            angle, distance = math.atan2(y, x), math.hypot(x, y)
        angle -= pose[2]
        angle -= math.tau * round(angle / math.tau)
        place = math.floor((0.5 - angle / view) * rays)
        if around:
            place %= rays
        if 0 <= place < rays:
            hits[place] = min(hits[place], distance, max_range)
    for ray in range(rays):
        seen[ray] = hits[ray]
        if hits[ray] < math.inf:
            continue
        for step in (-1, 1):
            place = ray + step
            for _ in range(rays):
                if around:
                    place %= rays
                if place < 0 or place >= rays:
                    break
                if hits[place] < math.inf:
                    seen[ray] = min(seen[ray], hits[place])
                    break
                place += step
        seen[ray] = min(seen[ray], max_range)


@dataclass(frozen=True)
class Binning:
    """Cells for a table of values.

    Features: the largest closeness of each of some groups of neighboring lidar sectors, the
    direction of the goal, and its distance.

    Args:
        groups: Number of groups of sectors, of sizes as equal as can be.
        closeness: Rising bounds between the bins of a closeness. With 0.25 m, at which closeness is
            one for the scripts' TurtleBot, 0.25 and 0.6 are 1 m and 0.42 m from its center.
        directions: Number of equal bins of the goal's direction; the first has its middle ahead.
        distances: Rising bounds between the bins of the goal's distance, as it is in the
            observation, where 1 is 10 m.
        sectors: Number of sectors of the lidar.
        observation_size: ``O``; what lies behind the known part of an observation is not looked at.

    Raises:
        ValueError: If a number is not positive, there are more groups than sectors, or bounds do
            not rise.

    Examples:
        >>> binning = Binning()
        >>> binning.cells, binning(np.zeros((5, 24), np.float32)).shape
        (972, (5,))
    """

    groups: int = 3
    closeness: tuple[float, ...] = (0.25, 0.6)
    directions: int = 12
    distances: tuple[float, ...] = (0.1, 0.25)
    sectors: int = 18
    observation_size: int = 24

    def __post_init__(self) -> None:
        for name in ("closeness", "distances"):
            bounds = tuple(float(bound) for bound in getattr(self, name))
            object.__setattr__(self, name, bounds)
            rising = all(low < high for low, high in pairwise(bounds))
            if not (rising and all(map(math.isfinite, bounds))):
                raise ValueError(f"{name} must be finite and rise, got {bounds}")
        for name in ("groups", "directions", "sectors", "observation_size"):
            object.__setattr__(self, name, check_count(name, getattr(self, name)))
        if self.groups > self.sectors:
            raise ValueError(f"groups must be at most {self.sectors} sectors, got {self.groups}")
        known = observation_slices(self.sectors)["angular_speed"].stop
        if self.observation_size < known:
            raise ValueError(f"observation_size must be {known} or more: {self.observation_size}")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of bins of each feature."""
        around = [len(self.closeness) + 1] * self.groups
        return (*around, self.directions, len(self.distances) + 1)

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.sizes)

    def __call__(self, observation: NDArray[np.floating]) -> NDArray[np.int64]:
        """Find the cells.

        Args:
            observation: Observations, shape ``[..., O]``.

        Returns:
            Numbers of cells, shape ``[...]``.
        """
        # In double precision, so that a saved table finds the cells that were trained.
        observation = np.asarray(observation, dtype=np.float64)
        parts = observation_slices(self.sectors)
        lidar = observation[..., parts["lidar"]]
        groups = np.array_split(lidar, self.groups, axis=-1)
        cosine, sine = np.moveaxis(observation[..., parts["goal_direction"]], -1, 0)
        turn = np.arctan2(sine, cosine) / (2.0 * math.pi) * self.directions
        distance = observation[..., parts["goal_distance"]][..., 0]
        bins = [np.digitize(group.max(-1), self.closeness) for group in groups]
        bins += [
            np.rint(turn).astype(np.int64) % self.directions,
            np.digitize(distance, self.distances),
        ]
        found: NDArray[np.int64] = np.ravel_multi_index(bins, self.sizes)
        return found
