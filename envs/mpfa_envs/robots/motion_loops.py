"""Kinematic motion of many robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mpfa_envs.compiled import njit

if TYPE_CHECKING:
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
    """By how much that difference changes at most [m/s²], and apart from the mean of both."""
    reverse: bool = True
    """False if the mean of both is never below 0."""


def pairs_within(limits: WheelLimits, speeds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pairs of some speeds that the left and the right wheel can have [m/s], ``[K, 2]``."""
    pairs: NDArray[np.float64] = np.stack(np.meshgrid(speeds, speeds), axis=-1).reshape(-1, 2)
    can = 0.5 * np.abs(pairs[:, 1] - pairs[:, 0]) <= limits.across + 1e-9
    return pairs[can & (limits.reverse | (pairs.sum(axis=1) >= 0.0))]


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
def _changed(speed: float, wanted: float, faster: float, slower: float) -> float:
    """The speed of a wheel that changes by so much at most [m/s]."""
    change = slower if abs(wanted) < abs(speed) or wanted * speed < 0.0 else faster
    return min(max(wanted, speed - change), speed + change)


@njit
def changed(
    now: tuple[float, float],  # [m/s]
    wanted: tuple[float, float],  # [m/s]
    limits: WheelLimits,
    share: float,  # of the acceleration, with which it slows down
    time: float,  # [s]
) -> tuple[float, float]:
    """The speeds nearest to the wanted ones that the wheels can have after a time [m/s]."""
    left, right = now
    faster, slower = limits.acceleration * time, share * limits.acceleration * time
    if limits.turning == math.inf:
        return _changed(left, wanted[0], faster, slower), _changed(right, wanted[1], faster, slower)
    # A controller that limits the turn limits the forward speed, too, and each by itself.
    forward = _changed(0.5 * (left + right), 0.5 * (wanted[0] + wanted[1]), faster, slower)
    faster, slower = min(faster, limits.turning * time), min(slower, share * limits.turning * time)
    across = _changed(0.5 * (right - left), 0.5 * (wanted[1] - wanted[0]), faster, slower)
    return forward - across, forward + across


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
            speeds[robot, 0], speeds[robot, 1] = changed(now, to, limits, 1.0, time_step)


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


@njit
def drive_orders(
    motion: NDArray[np.float64],  # (x, y, heading, forward, turning), [5]
    times: NDArray[np.float64],  # for which each order holds [s], [K]
    orders: NDArray[np.float64],  # speeds of the wheels [m/s], [K, 2]
    limits: WheelLimits,
    wheel_base: float,  # [m]
    time_step: float,  # longest time for which speeds are held [s]
) -> NDArray[np.float64]:
    """The motion, ``[5]``, of a robot that has carried out the orders under way to its wheels."""
    x, y, heading = motion[0], motion[1], motion[2]
    across = 0.5 * wheel_base * motion[4]
    left, right = motion[3] - across, motion[3] + across
    for order in range(times.shape[0]):
        if times[order] <= 0.0:
            continue
        to = limited(orders[order, 0], orders[order, 1], limits)
        parts = math.ceil(times[order] / time_step - 1e-9)
        part = times[order] / parts
        for _ in range(parts):
            left, right = changed((left, right), to, limits, 1.0, part)
            turn, along = (right - left) / wheel_base * part, 0.5 * (left + right) * part
            x += along * math.cos(heading + 0.5 * turn)
            y += along * math.sin(heading + 0.5 * turn)
            heading += turn
    heading -= math.tau * round(heading / math.tau)
    return np.array((x, y, heading, 0.5 * (left + right), (right - left) / wheel_base))
