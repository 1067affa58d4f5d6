"""Kinematic motion of many robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mpfa_envs.compiled import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@njit
def scale_actions(
    actions: NDArray[np.float64], slow: float, fast: float, speeds: NDArray[np.float64]
) -> bool:
    """Turn clipped actions into speeds [m/s], both ``[N, 2]``; tell whether all are numbers."""
    middle, span = 0.5 * (fast + slow), 0.5 * (fast - slow)
    numbers = True
    for robot in range(actions.shape[0]):
        for wheel in range(2):
            action = actions[robot, wheel]
            numbers &= action == action  # NaN is not.
            speeds[robot, wheel] = middle + span * min(max(action, -1.0), 1.0)
    return numbers


@njit
def drive_arcs(
    motions: NDArray[np.float64],  # (x, y, heading, forward, turning) [N, 5]
    running: NDArray[np.bool_],  # [N]
    speeds: NDArray[np.float64],  # [N, 2] [m/s]
    wheel_base: float,  # [m]
    time_step: float,  # [s]
) -> None:
    """Move robots on exact arcs, in place."""
    for robot in range(motions.shape[0]):
        if not running[robot]:
            continue
        left, right = speeds[robot, 0], speeds[robot, 1]
        speed, turn = 0.5 * (left + right), (right - left) / wheel_base
        # Along a chord of the arc: its direction is halfway between the two headings, and
        # sin(half) / half is its length over the arc's.
        half = 0.5 * turn * time_step
        chord = speed * time_step * (math.sin(half) / half if half != 0.0 else 1.0)
        heading = motions[robot, 2]
        motions[robot, 0] += chord * math.cos(heading + half)
        motions[robot, 1] += chord * math.sin(heading + half)
        heading += 2.0 * half
        motions[robot, 2] = heading - math.tau * round(heading / math.tau)
        motions[robot, 3], motions[robot, 4] = speed, turn
