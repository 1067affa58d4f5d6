"""Walkers of many robots: how they move, and how near they come to the robots."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from mpfa_envs.compiled import njit
from mpfa_envs.worlds.arrays import clearance_at
from mpfa_envs.worlds.walker import HORIZON, PERSONAL_SPACE

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mpfa_envs.worlds.arrays import BatchArrays

STRAIGHT: Final = 0
WAYPOINTS: Final = 1
ORCA: Final = 2
_ARRIVED: Final = 0.3
"""A walker that avoids others has reached a waypoint at this distance [m]."""
_ROUNDING: Final = 1e-9
"""More than what rounding does to a slack [m]."""
_NUDGE: Final = 1e-3
"""Half the distance over which the slope of the clearance is measured [m]."""


class WalkerArrays(NamedTuple):
    """Walkers by robot; of each row only the first few count, and no others are looked at."""

    states: NDArray[np.float64]
    """(x, y) and the speeds in both directions [m, m/s], ``[N, most, 4]``; changed in place."""
    targets: NDArray[np.int64]
    """Index of the next waypoint, ``[N, most]``; changed in place."""
    slacks: NDArray[np.float64]
    """Distance that each can go before it may meet an obstacle [m], ``[N, most]``; changed in
    place. Zero is true of any walker, and makes it look around."""
    bodies: NDArray[np.float64]
    """Radius and speed [m, m/s], ``[N, most, 2]``."""
    behaviors: NDArray[np.int64]
    """:data:`STRAIGHT`, :data:`WAYPOINTS` or :data:`ORCA`, ``[N, most]``."""
    waypoints: NDArray[np.float64]
    """(x, y) [m], ``[N, most, most waypoints, 2]``."""
    waypoint_counts: NDArray[np.int64]
    """``[N, most]``."""
    counts: NDArray[np.int64]
    """Numbers of walkers, ``[N]``."""


@njit
def walk(
    walkers: WalkerArrays, worlds: BatchArrays, running: NDArray[np.bool_], time_step: float
) -> None:
    """Move the walkers of some robots for one time step."""
    states, circles = walkers.states, worlds.circles
    for robot in range(running.shape[0]):
        if not running[robot]:
            continue
        behind = worlds.counts[robot, 1]
        for index in range(walkers.counts[robot]):
            length = walkers.bodies[robot, index, 1] * time_step
            if walkers.behaviors[robot, index] == WAYPOINTS:
                target = walkers.targets[robot, index]
                across = walkers.waypoints[robot, index, target, 0] - states[robot, index, 0]
                up = walkers.waypoints[robot, index, target, 1] - states[robot, index, 1]
                is_free = across * across + up * up > length * length
            elif walkers.behaviors[robot, index] == ORCA:
                is_free = False
            else:
                is_free = walkers.slacks[robot, index] - length > _ROUNDING
                is_free &= length <= walkers.bodies[robot, index, 0]
                walkers.slacks[robot, index] -= length
                x = states[robot, index, 0] + states[robot, index, 2] * time_step
                y = states[robot, index, 1] + states[robot, index, 3] * time_step
                for other in range(walkers.counts[robot]):
                    across, up = x - states[robot, other, 0], y - states[robot, other, 1]
                    reach = walkers.bodies[robot, index, 0] + walkers.bodies[robot, other, 0]
                    near = other != index and across * across + up * up < reach * reach
                    is_free &= not near
            # Plain numbers for most: calling a function with all arrays costs more than the step.
            if is_free:
                states[robot, index, 0] += states[robot, index, 2] * time_step
                states[robot, index, 1] += states[robot, index, 3] * time_step
            elif walkers.behaviors[robot, index] == WAYPOINTS:
                _turn(walkers, robot, index, time_step)
            elif walkers.behaviors[robot, index] == ORCA:
                _glide(walkers, worlds, robot, index, time_step)
            else:
                _bounce(walkers, worlds, robot, index, time_step)
            circles[robot, behind + index, 0] = states[robot, index, 0]
            circles[robot, behind + index, 1] = states[robot, index, 1]


@njit
def _turn(walkers: WalkerArrays, robot: int, index: int, time_step: float) -> None:
    """Go to the next waypoint, and with what is left of the step to the one after it."""
    state, points = walkers.states[robot, index], walkers.waypoints[robot, index]
    speed = walkers.bodies[robot, index, 1]
    left = speed * time_step
    while True:
        target = walkers.targets[robot, index]
        across, up = points[target, 0] - state[0], points[target, 1] - state[1]
        gap = math.sqrt(across * across + up * up)
        if gap > left:
            break
        state[0], state[1] = points[target, 0], points[target, 1]
        walkers.targets[robot, index] = (target + 1) % walkers.waypoint_counts[robot, index]
        left -= gap
    state[2], state[3] = speed * across / gap, speed * up / gap
    state[0] += left * across / gap
    state[1] += left * up / gap


@njit
def _glide(
    walkers: WalkerArrays, worlds: BatchArrays, robot: int, index: int, time_step: float
) -> None:
    """Move at the chosen velocity, or stand still if that leads into an obstacle."""
    state, points = walkers.states[robot, index], walkers.waypoints[robot, index]
    x, y = state[0] + time_step * state[2], state[1] + time_step * state[3]
    room = clearance_at(worlds, robot, x, y)
    # A walker that is too near already may leave.
    enough = min(walkers.bodies[robot, index, 0], clearance_at(worlds, robot, state[0], state[1]))
    if room < enough:
        state[2], state[3] = 0.0, 0.0
        return
    state[0], state[1] = x, y
    target = walkers.targets[robot, index]
    across, up = points[target, 0] - x, points[target, 1] - y
    if across * across + up * up < _ARRIVED * _ARRIVED:
        walkers.targets[robot, index] = (target + 1) % walkers.waypoint_counts[robot, index]


@njit
def _bounce(
    walkers: WalkerArrays, worlds: BatchArrays, robot: int, index: int, time_step: float
) -> None:
    """Go straight ahead, bounce off obstacles and, where that leads nowhere, go back."""
    state, radius = walkers.states[robot, index], walkers.bodies[robot, index, 0]
    # A stride is no longer than the radius, lest it lead through a thin wall.
    strides = math.ceil(walkers.bodies[robot, index, 1] * time_step / radius)
    duration = time_step / strides
    for _ in range(strides):
        speed_x, speed_y = state[2], state[3]
        for attempt in range(2):
            x, y = state[0] + duration * state[2], state[1] + duration * state[3]
            across, up = _normal(walkers, worlds, robot, index, x, y)
            if across == 0.0 and up == 0.0:
                state[0], state[1] = x, y
                break
            if attempt == 0:
                into = 2.0 * (speed_x * across + speed_y * up)
                state[2] -= into * across
                state[3] -= into * up
            else:
                state[2], state[3] = -speed_x, -speed_y
    walkers.slacks[robot, index] = clearance_at(worlds, robot, state[0], state[1]) - radius


@njit
def _normal(
    walkers: WalkerArrays, worlds: BatchArrays, robot: int, index: int, x: float, y: float
) -> tuple[float, float]:
    """Direction away from what a walker would run into at a place; zero if there is nothing."""
    state, radius = walkers.states[robot, index], walkers.bodies[robot, index, 0]
    if clearance_at(worlds, robot, x, y) < radius:
        across = clearance_at(worlds, robot, x + _NUDGE, y) - clearance_at(
            worlds, robot, x - _NUDGE, y
        )
        up = clearance_at(worlds, robot, x, y + _NUDGE) - clearance_at(worlds, robot, x, y - _NUDGE)
        length = math.hypot(across, up)
        if state[2] * across + state[3] * up < 0.0:
            return across / length, up / length
        speed = walkers.bodies[robot, index, 1]
        return -state[2] / speed, -state[3] / speed
    for other in range(walkers.counts[robot]):
        across = x - walkers.states[robot, other, 0]
        up = y - walkers.states[robot, other, 1]
        reach = radius + walkers.bodies[robot, other, 0]
        square = across * across + up * up
        if other == index or square >= reach * reach:
            continue
        if state[2] * across + state[3] * up < 0.0:  # Two that overlap may part.
            length = math.sqrt(square)
            return across / length, up / length
    return 0.0, 0.0


@njit
def nearest_walker(walkers: WalkerArrays, robot: int, x: float, y: float) -> float:
    """Measure the distance from a point to the rim of the nearest walker [m]."""
    nearest = math.inf
    for index in range(walkers.counts[robot]):
        state = walkers.states[robot, index]
        across, up = state[0] - x, state[1] - y
        gap = math.sqrt(across * across + up * up) - walkers.bodies[robot, index, 0]
        nearest = min(nearest, gap)
    return nearest


@njit
def hide_walkers(
    walkers: WalkerArrays,
    motions: NDArray[np.float64],  # (x, y, heading) [N, 5] [m, m, rad]
    directions: NDArray[np.float64],
    margin: float,  # [m]
    max_range: float,  # [m]
    ranges: NDArray[np.float64],  # [N, rays] [m]
) -> None:
    """Have the rays that end at a walker report the maximum range."""
    for robot in range(ranges.shape[0]):
        if walkers.counts[robot] == 0:
            continue
        x, y, heading = motions[robot, 0], motions[robot, 1], motions[robot, 2]
        cosine, sine = math.cos(heading), math.sin(heading)
        for ray in range(ranges.shape[1]):
            across = directions[0, ray] * cosine - directions[1, ray] * sine
            up = directions[0, ray] * sine + directions[1, ray] * cosine
            reach = ranges[robot, ray]
            if nearest_walker(walkers, robot, x + reach * across, y + reach * up) < margin:
                ranges[robot, ray] = max_range


@njit
def count_encounters(
    walkers: WalkerArrays,
    motions: NDArray[np.float64],  # (x, y, heading, forward, turning) [N, 5]
    running: NDArray[np.bool_],  # [N]
    radius: float,  # [m]
    time_step: float,  # [s]
    counts: NDArray[np.float64],  # Least gap [m], time in personal space, to collision [s], [3, N]
) -> None:
    """Update the encounters of robots with their walkers."""
    for robot in range(running.shape[0]):
        if not running[robot] or walkers.counts[robot] == 0:
            continue
        x, y, heading, speed = (
            motions[robot, 0], motions[robot, 1], motions[robot, 2], motions[robot, 3]
        )  # fmt: skip
        speed_x, speed_y = speed * math.cos(heading), speed * math.sin(heading)
        gap = nearest_walker(walkers, robot, x, y) - radius
        counts[0, robot] = min(counts[0, robot], gap)
        if gap < PERSONAL_SPACE:
            counts[1, robot] += time_step
        for index in range(walkers.counts[robot]):
            state = walkers.states[robot, index]
            until = time_to_collision(
                state[0] - x,
                state[1] - y,
                state[2] - speed_x,
                state[3] - speed_y,
                radius + walkers.bodies[robot, index, 0],
            )
            counts[2, robot] = min(counts[2, robot], until)


@njit
def time_to_collision(x: float, y: float, speed_x: float, speed_y: float, reach: float) -> float:
    """Time until two discs touch [s], the least t >= 0 with |p + v t| = reach; at most 10."""
    beyond = x * x + y * y - reach * reach
    if beyond <= 0.0:
        return 0.0
    closing = -(x * speed_x + y * speed_y)
    square = speed_x * speed_x + speed_y * speed_y
    inner = closing * closing - square * beyond
    if closing <= 0.0 or inner < 0.0:
        return HORIZON
    # The smaller root, in the form that loses no digits.
    return min(beyond / (closing + math.sqrt(inner)), HORIZON)
