"""Kinematic motion of many robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mpfa_envs.kernels import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@njit
def drive_arcs(
    motions: NDArray[np.float64],
    running: NDArray[np.bool_],
    speeds: NDArray[np.float64],
    wheel_base: float,
    time_step: float,
) -> None:
    """Move robots on exact arcs, as :class:`mpfa_envs.drives.KinematicDrive` moves one.

    Args:
        motions: Poses and speeds (x, y, heading, forward, turning), ``[N, 5]``; changed in place.
        running: Which robots move, ``[N]``.
        speeds: Speeds of the left and the right wheel [m/s], ``[N, 2]``.
        wheel_base: Distance between the wheels [m].
        time_step: How long the speeds are held [s].
    """
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
