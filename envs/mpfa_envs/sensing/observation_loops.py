"""Observations of many robots, from what they have measured."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.sensing.observation import (
    DISTANCE_SCALE,
    GOAL_CLOSENESS_DISTANCE,
    PATH_BOUND,
    SPEED_BOUND,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
        # The last scan moves to the first place of the earlier ones, and these one place on.
        for index in range(seen.shape[0] - 1, start - 1, -1):
            seen[index] = seen[index - sectors] if index >= start + sectors else seen[index - start]
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
