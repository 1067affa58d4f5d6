"""Observations of many robots, from what they have measured."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.sensing.observation import (
    DISTANCE_SCALE,
    GOAL_CLOSENESS_DISTANCE,
    SPEED_BOUND,
    WAY_BOUND,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


@njit
def observe_all(
    motions: NDArray[np.float64],
    goals: NDArray[np.float64],
    distances: NDArray[np.float64],
    fresh: NDArray[np.bool_],
    chosen: NDArray[np.bool_],
    ranges: NDArray[np.float64],
    median: bool,
    scales: tuple[float, float, float],
    ways: NDArray[np.float64],
    sectors: int,
    history: int,
    observations: NDArray[np.float32],
) -> None:
    """Build the observations of the chosen robots.

    Args:
        motions: Poses and speeds (x, y, heading, forward, turning) that the robots hold to be
            theirs [m, m, rad, m/s, rad/s], ``[N, 5]``.
        goals: Where they should go (x, y) [m], ``[N, 2]``.
        distances: Distances of the two [m], ``[N]``.
        fresh: Whose episode begins: they have always seen what they see, ``[N]``.
        chosen: Which robots sense, ``[N]``; the others' observations stay.
        ranges: Range of each ray [m], ``[N, rays]``.
        median: Whether a sector reports the median of its rays and not the nearest.
        scales: Range with closeness one [m]; fastest speed of a wheel [m/s], fastest turn [rad/s].
        ways: Direction (x, y) and length [m] of the ways that the robots' maps leave, ``[N, 3]``;
            without rows where there are no maps.
        sectors: Number of sectors of the lidar.
        history: Number of earlier scans in the observations.
        observations: Where the observations go, ``[N, O]``.
    """
    count = ranges.shape[1] // sectors
    near, fastest, fastest_turn = scales
    for robot in range(observations.shape[0]):
        if not chosen[robot]:
            continue
        seen = observations[robot]
        start = seen.shape[0] - sectors * history
        # The last scan moves to the first place of the earlier ones, and these one place on.
        for index in range(seen.shape[0] - 1, start - 1, -1):
            seen[index] = seen[index - sectors] if index >= start + sectors else seen[index - start]
        for sector in range(sectors):
            first = sector * count
            if median:
                nearest = _middle(ranges[robot, first : first + count])
            else:
                nearest = ranges[robot, first]
                for ray in range(first + 1, first + count):
                    nearest = min(nearest, ranges[robot, ray])
            seen[sector] = near / max(nearest, near)
        if fresh[robot]:
            for index in range(start, seen.shape[0]):
                seen[index] = seen[(index - start) % sectors]
        motion = motions[robot]
        speed, turn = motion[3] / fastest, motion[4] / fastest_turn
        distance = distances[robot]
        # A robot on the goal sees it ahead.
        bearing, closeness = 0.0, 1.0
        if distance > 0.0:
            goal = goals[robot]
            bearing = math.atan2(goal[1] - motion[1], goal[0] - motion[0]) - motion[2]
            closeness = min(GOAL_CLOSENESS_DISTANCE / distance, 1.0)
        seen[sectors], seen[sectors + 1] = math.cos(bearing), math.sin(bearing)
        seen[sectors + 2], seen[sectors + 3] = closeness, distance / DISTANCE_SCALE
        seen[sectors + 4] = min(max(speed, -SPEED_BOUND), SPEED_BOUND)
        seen[sectors + 5] = min(max(turn, -SPEED_BOUND), SPEED_BOUND)
        if ways.shape[0] > 0:
            seen[sectors + 6], seen[sectors + 7] = ways[robot, 0], ways[robot, 1]
            seen[sectors + 8] = min(ways[robot, 2] / DISTANCE_SCALE, WAY_BOUND)


@njit
def _middle(rays: NDArray[np.float64]) -> float:
    """Median of a sector's rays."""
    ordered = np.sort(rays)
    half = rays.shape[0] // 2
    if rays.shape[0] % 2 == 1:
        return ordered[half]
    return 0.5 * (ordered[half - 1] + ordered[half])
