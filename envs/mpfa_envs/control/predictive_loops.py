"""Rollouts of wheel speeds, and the search for the sequence of them that takes the least time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.paths.grid_loops import interpolate
from mpfa_envs.robots.motion_loops import changed, limited
from mpfa_envs.safety.loops import AT_RIM, Body, room_after
from mpfa_envs.sensing.map_loops import BLOCKED, FACTORS, cell_of
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

CELL: Final = 0.03
"""Side of a cell of the robot's surroundings [m]."""
ROOMY: Final = 0.09
"""Room over the clearance that is kept, above which more of it is worth nothing [m]."""
_WALL: Final = FACTORS[BLOCKED] / FACTORS[0]
"""Time in a blocked cell of the map counts so many times more, as a path does."""
_OFF: Final = 0.12
"""Distance to each side at which the slope of the cost-to-go is measured [m]."""
_SPREAD: Final = (0.45, 0.2, 0.08)
"""Spread of the sampled speeds in each round, over the fastest."""


class PlanningState(NamedTuple):
    """What a robot knows when it decides; places are in meters from the first cell of its map."""

    pose: tuple[float, float, float]  # x, y, heading [m, m, rad]
    speeds: NDArray[np.float64]  # of the wheels in each state it may be in [m/s], [S, 2]
    points: NDArray[np.float64]  # what the filter sees, [S, P, 4]
    counts: NDArray[np.int64]  # the number of these points, [S]
    kept: Body  # as the filter tests what begins a plan
    least: float  # room that the filter asks for [m]
    rooms: NDArray[np.float64]  # room in cells around the robot, at most ROOMY [m], [1, n, n]
    levels: NDArray[np.uint8]  # its map, [columns, rows]
    lengths: NDArray[np.float64]  # of the cheapest paths to the goal [m], [columns, rows]
    goal: tuple[float, float, float]  # x, y and the distance that reaches it [m]
    into: float  # how far a plan may lead into what it should keep off, but its first action [m]


class Effort(NamedTuple):
    """What costs a robot time besides its path."""

    turn: float  # time to turn by a radian [s]
    stand: float  # time that a plan must save to begin without moving [s]
    either: bool  # True if it drives backwards as well as forwards
    circle: int  # time steps of a full circle if it cannot stop, else 0
    blind: bool  # True if its lidar does not look behind, where the filter lets it not drive


@njit
def room_around(
    points: NDArray[np.float64],  # x, y and the squared distance to be kept from it [m], [P, 4]
    heading: float,  # of the robot [rad]
    rim: float,  # distance within which nothing is seen [m]
    rooms: NDArray[np.float64],  # [n, n]
) -> None:
    """Write how far the robot's center would be from what it must keep off, in cells around it."""
    rooms[:] = ROOMY
    middle, last = rooms.shape[0] // 2, rooms.shape[0] - 1
    cosine, sine = math.cos(heading) / CELL, math.sin(heading) / CELL
    for point in range(points.shape[0]):
        x, y, kept = points[point, 0], points[point, 1], math.sqrt(points[point, 2])
        # Nothing stands on a border. What is not seen begins at the rim: the filter keeps off it,
        # and after a turn it is seen.
        if kept == 0.0 or x * x + y * y <= rim * rim:
            continue
        u, v = middle + x * cosine - y * sine, middle + x * sine + y * cosine
        wide = (kept + ROOMY) / CELL
        for i in range(max(math.ceil(u - wide), 0), min(math.floor(u + wide), last) + 1):
            for j in range(max(math.ceil(v - wide), 0), min(math.floor(v + wide), last) + 1):
                away = CELL * math.sqrt((i - u) * (i - u) + (j - v) * (j - v))
                rooms[i, j] = min(rooms[i, j], away - kept)


@njit
def _room_at(state: PlanningState, x: float, y: float) -> float:
    """Room at a place [m]."""
    cells = state.rooms.shape[1]
    west, south = state.pose[0] - cells // 2 * CELL, state.pose[1] - cells // 2 * CELL
    return interpolate(state.rooms, 0, cells, cells, west, south, CELL, x, y)


@njit
def _cost_to_go(lengths: NDArray[np.float64], x: float, y: float) -> float:
    """Length of the path from a place [m], by the best cell around it."""
    u, v, best = x / RESOLUTION, y / RESOLUTION, math.inf
    left, low = cell_of(u - 0.5, lengths.shape[0]), cell_of(v - 0.5, lengths.shape[1])
    # Farther cells may be behind a wall: for a small robot one is two blocked cells thick.
    for i in range(left, min(left + 2, lengths.shape[0])):
        for j in range(low, min(low + 2, lengths.shape[1])):
            gap = RESOLUTION * math.sqrt((i - u) * (i - u) + (j - v) * (j - v))
            best = min(best, lengths[i, j] + gap)
    return best


@njit
def _terminal_cost(
    lengths: NDArray[np.float64],
    place: tuple[float, float, float],  # x, y, heading at a plan's end [m, m, rad]
    speed: float,  # forward there [m/s]
    tight: bool,  # True if the robot squeezes through
    body: Body,
    effort: Effort,
) -> float:
    """Time from the end of a plan to the goal [s]: along the path, to turn and to accelerate."""
    x, y, heading = place
    fast = body.limits.fast
    here = _cost_to_go(lengths, x, y)
    time = here / fast
    east, west = _cost_to_go(lengths, x + _OFF, y), _cost_to_go(lengths, x - _OFF, y)
    north, south = _cost_to_go(lengths, x, y + _OFF), _cost_to_go(lengths, x, y - _OFF)
    across, up = east - west, north - south
    if tight:
        # Upwind differences: in a corridor the path leads ahead, not away from the costlier wall.
        across = math.copysign(max(here - min(east, west), 0.0), across)
        up = math.copysign(max(here - min(north, south), 0.0), up)
    steep = math.hypot(across, up)
    if steep > 0.0:
        ahead = -(across * math.cos(heading) + up * math.sin(heading)) / steep
        beside = abs(up * math.cos(heading) - across * math.sin(heading)) / steep
        time += effort.turn * math.atan2(beside, abs(ahead) if effort.either else ahead)
        missing = fast - speed * ahead
        time += missing * missing / (2.0 * body.limits.acceleration * fast)
    return time


@njit
def rollout(
    plan: NDArray[np.float64],  # wheel speeds of each time step [m/s], [T, 2]
    state: PlanningState,
    body: Body,
    effort: Effort,
    most: float,  # [s]
) -> float:
    """Time to the goal by a plan [s]; infinite if it comes too near to something, or above most.

    The terminal constraint: after the plan the robot stands still in time or, where it cannot stand
    still, drives a full circle.
    """
    limits, parts = body.limits, math.ceil(body.limits.fast * body.time_step / (1.2 * CELL))
    part = body.time_step / parts
    left, right = state.speeds[0, 0], state.speeds[0, 1]
    x, y, heading = state.pose
    # Between the cells, the room of the place where it stands may seem to be below zero.
    needed, time = min(_room_at(state, x, y), 0.0) - state.into - 1e-9, 0.0
    step, last = 0, plan.shape[0]
    while True:
        if step == last:
            place = x, y, heading
            speed = 0.5 * (left + right)
            time += _terminal_cost(state.lengths, place, speed, state.into > 0.0, body, effort)
        if time >= most:
            return math.inf
        if step < last:
            wanted = limited(plan[step, 0], plan[step, 1], limits)
        elif effort.circle > 0:
            to_left = plan[last - 1, 1] >= plan[last - 1, 0]
            wanted = (limits.slow, limits.fast) if to_left else (limits.fast, limits.slow)
        else:
            wanted = (0.0, 0.0)
        if step >= last + effort.circle and (effort.circle > 0 or (left == 0.0 and right == 0.0)):
            return time
        left, right = changed((left, right), wanted, limits, 1.0, body.time_step)
        turn, along = (right - left) / body.wheel_base * part, 0.5 * (left + right) * part
        room = ROOMY
        for _ in range(parts):
            x += along * math.cos(heading + 0.5 * turn)
            y += along * math.sin(heading + 0.5 * turn)
            heading += turn
            room = _room_at(state, x, y)
            if room < needed:
                return math.inf
        if step < last:
            near = 1.0 - max(room, -state.into) / ROOMY
            time += body.time_step * (1.0 + near * near)
            column = cell_of(x / RESOLUTION, state.levels.shape[0])
            # A wall that the lidar does not see from here: the sectors show what is before it.
            level = state.levels[column, cell_of(y / RESOLUTION, state.levels.shape[1])]
            if level == BLOCKED or (effort.blind and left + right < -AT_RIM):
                time += _WALL * body.time_step
            if math.hypot(x - state.goal[0], y - state.goal[1]) <= state.goal[2]:
                return time
        step += 1


@njit
def best_plan(
    plan: NDArray[np.float64],  # the last one; the best one is written here, [T, 2]
    pairs: NDArray[np.float64],  # speeds that are tried after one another [m/s], [K, 2]
    noise: NDArray[np.float64],  # [rounds, samples, 4, 2]
    state: PlanningState,
    body: Body,
    effort: Effort,
) -> float:
    """Find the plan that takes the least time [s]; infinite if the filter lets none pass."""
    limits, steps, repeat = body.limits, plan.shape[0], body.repeat
    trial, chosen = np.empty_like(plan), np.empty_like(plan)
    # What was planned, from now on.
    for step in range(steps):
        _hold(trial, step, step + 1, plan[min(step + repeat, steps - 1)])
    _hold(trial, 1, repeat, trial[0])
    best = _better(trial, chosen, math.inf, state, body, effort)
    turn = max(steps // 4, repeat)
    for first in range(pairs.shape[0]):
        for second in range(pairs.shape[0]):
            _hold(trial, 0, turn, pairs[first])
            _hold(trial, turn, steps, pairs[second])
            best = _better(trial, chosen, best, state, body, effort)
    if best == math.inf:
        return best
    ends = max(steps // 8, repeat), 3 * steps // 8, 5 * steps // 8, steps
    for spread in range(noise.shape[0]):
        _copy(chosen, plan)
        wide = _SPREAD[spread] * limits.fast
        for sample in range(noise.shape[1]):
            begin = 0
            for knot in range(4):
                for step in range(begin, ends[knot]):
                    for wheel in range(2):
                        speed = plan[step, wheel] + wide * noise[spread, sample, knot, wheel]
                        trial[step, wheel] = min(max(speed, limits.slow), limits.fast)
                begin = max(begin, ends[knot])
            best = _better(trial, chosen, best, state, body, effort)
    _copy(chosen, plan)
    return best


# Assignments of slices would do, but Numba compiles their errors, too, for two seconds.
@njit
def _hold(plan: NDArray[np.float64], first: int, last: int, pair: NDArray[np.float64]) -> None:
    """Write a pair of speeds to some steps of a plan."""
    for step in range(first, last):
        plan[step, 0], plan[step, 1] = pair[0], pair[1]


@njit
def _copy(source: NDArray[np.float64], plan: NDArray[np.float64]) -> None:
    """Write a plan over another."""
    for step in range(plan.shape[0]):
        _hold(plan, step, step + 1, source[step])


@njit
def _better(
    trial: NDArray[np.float64],
    chosen: NDArray[np.float64],
    best: float,
    state: PlanningState,
    body: Body,
    effort: Effort,
) -> float:
    """Choose a plan if it is better than the best so far, and the filter lets it begin so [s]."""
    for attempt in range(2):
        if attempt == 1:
            # It may turn where it may not drive: a sampled plan hardly ever begins with just that.
            turn = 0.5 * (trial[0, 1] - trial[0, 0])
            _hold(trial, 0, body.repeat, np.array((-turn, turn)))
        waits = _cost_of_waiting(trial, body, effort)
        time = rollout(trial, state, body, effort, best - waits) + waits
        if time >= best:
            return best
        first = np.array(limited(trial[0, 0], trial[0, 1], body.limits))
        if room_after(first, state.speeds, state.points, state.counts, state.kept) > state.least:
            _copy(trial, chosen)
            return time
        if not effort.blind:
            return best
    return best


@njit
def _cost_of_waiting(trial: NDArray[np.float64], body: Body, effort: Effort) -> float:
    """What a plan costs that begins without moving [s]."""
    # A robot that stands sees the same again: to wait for a better plan must not be free.
    fastest = max(abs(trial[0, 0]), abs(trial[0, 1]))
    if effort.blind:  # While it turns it sees less beside it; but a turn is more than to stand.
        fastest = 0.5 * fastest + 0.25 * abs(trial[0, 0] + trial[0, 1])
    slow = 1.0 - min(fastest / body.limits.fast, 1.0)
    return effort.stand * slow * slow
