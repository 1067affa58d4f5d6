"""Kinematic motion of many robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from mpfa_envs.compiled import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class WheelLimits(NamedTuple):
    """Speeds and acceleration that the wheels of a robot can have."""

    slow: float
    """Slowest speed of a wheel [m/s]."""
    fast: float
    """Fastest speed of a wheel [m/s]."""
    across: float
    """Greatest difference of a wheel's speed from the mean of both [m/s]."""
    acceleration: float
    """Acceleration of a wheel [m/s²]."""
    turning: float = math.inf
    """By how much that difference changes at most [m/s²]."""
    reverse: bool = True
    """False if the mean of both is never below 0."""


_ROUNDING = 1e-12
"""Speeds beyond a limit by this are on it [m/s]: what was limited once keeps its bits."""


@njit
def limited(left: float, right: float, limits: WheelLimits) -> tuple[float, float]:
    """The speeds that the wheels can have for wanted ones [m/s]; both 0: the motors are off."""
    if left == 0.0 and right == 0.0:
        return left, right
    across = 0.5 * (right - left)
    if abs(across) > limits.across + _ROUNDING:
        forward = 0.5 * (left + right)
        across = math.copysign(limits.across, across)
        left, right = forward - across, forward + across
    slow, fast = limits.slow - _ROUNDING, limits.fast + _ROUNDING
    left = left if slow <= left <= fast else min(max(left, limits.slow), limits.fast)
    right = right if slow <= right <= fast else min(max(right, limits.slow), limits.fast)
    if left + right < 0.0 and not limits.reverse:
        across = min(max(0.5 * (right - left), limits.slow), -limits.slow)
        across = min(max(across, -limits.fast), limits.fast)
        left, right = -across, across
    return left, right


@njit
def scale_actions(
    actions: NDArray[np.float64], limits: WheelLimits, speeds: NDArray[np.float64]
) -> bool:
    """Turn clipped actions into speeds [m/s], both ``[N, 2]``; return True if all are numbers."""
    middle, span = 0.5 * (limits.fast + limits.slow), 0.5 * (limits.fast - limits.slow)
    numbers = True
    for robot in range(actions.shape[0]):
        for wheel in range(2):
            action = actions[robot, wheel]
            numbers &= action == action  # NaN is not.
            speeds[robot, wheel] = middle + span * min(max(action, -1.0), 1.0)
        left, right = limited(speeds[robot, 0], speeds[robot, 1], limits)
        speeds[robot, 0], speeds[robot, 1] = left, right
    return numbers


@njit
def changed(
    now: tuple[float, float], wanted: tuple[float, float], limits: WheelLimits, time: float
) -> tuple[float, float]:
    """The speeds nearest to the wanted ones that the wheels can have after a time [m/s, s]."""
    left, right = now
    change, most = limits.acceleration * time, limits.turning * time
    to_left = min(max(wanted[0], left - change), left + change)
    to_right = min(max(wanted[1], right - change), right + change)
    across = 0.5 * ((to_right - right) - (to_left - left))
    # The forward speed changes as it would, and the turn as fast as it may.
    if abs(across) > most:
        forward = 0.5 * ((to_right - right) + (to_left - left))
        across = math.copysign(most, across)
        to_left, to_right = left + forward - across, right + forward + across
    return to_left, to_right


@njit
def accelerate(
    speeds: NDArray[np.float64],  # of the wheels now [m/s], [N, 2], changed in place
    wanted: NDArray[np.float64],  # [m/s], [N, 2]
    running: NDArray[np.bool_],  # [N]
    limits: WheelLimits,
    time_step: float,  # [s]
) -> None:
    """Bring the speeds of the wheels as near to the wanted ones as one time step allows."""
    for robot in range(speeds.shape[0]):
        if running[robot]:
            to = limited(wanted[robot, 0], wanted[robot, 1], limits)
            now = speeds[robot, 0], speeds[robot, 1]
            speeds[robot, 0], speeds[robot, 1] = changed(now, to, limits, time_step)


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
