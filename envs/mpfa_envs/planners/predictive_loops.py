"""Rollouts of wheel speeds, and the search for the sequence of them that takes the least time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.paths.grid_loops import interpolate
from mpfa_envs.robots.motion_loops import changed, limited
from mpfa_envs.safety.loops import Body, kept_distance, room_after
from mpfa_envs.sensing.map_loops import BLOCKED, FACTORS, cell_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

CELL: Final = 0.03
"""Side of a cell of the robot's surroundings [m]."""
ROOMY: Final = 0.09
"""Room over the clearance that is kept, above which more of it is worth nothing [m]."""
_WALL: Final = FACTORS[BLOCKED] / FACTORS[0]
"""Time in a blocked cell of the map counts so many times more, as a path does."""
_OFF: Final = 0.12
"""Distance to each side at which the slope of the time field is measured [m]."""
_SPREAD: Final = (0.45, 0.2, 0.08)
"""Spread of the sampled speeds in each round, over the fastest."""


class Scene(NamedTuple):
    """What a robot knows when it decides, in its own frame unless it says otherwise."""

    rooms: NDArray[np.float64]
    """Room of the robot's center over what it keeps from lidar hits, at most :data:`ROOMY` [m], in
    cells around it, ``[n, n]``."""
    points: NDArray[np.float64]
    """What the filter sees, ``[1, P, 3]``."""
    counts: NDArray[np.int64]
    """The number of these points, ``[1]``."""
    least: float
    """Room that the filter asks for [m]."""
    speeds: NDArray[np.float64]
    """Of the wheels [m/s], ``[1, 2]``."""
    levels: NDArray[np.uint8]
    """Its map, ``[columns, rows]``."""
    lengths: NDArray[np.float64]
    """Cost to go: length of the cheapest path from the cells of its map to the goal [m],
    ``[columns, rows]``."""
    farthest: float
    """Length that counts where there is none [m]."""
    resolution: float
    """Side of a cell of the map [m]."""
    pose: tuple[float, float, float]
    """Of the robot on its map (x, y, heading) [cells, cells, rad]."""
    goal: tuple[float, float, float]
    """Position (x, y) of the goal and the distance that reaches it [m]."""


class Effort(NamedTuple):
    """What a robot is good at."""

    turn: float
    """Time to turn by a radian [s]."""
    stand: float
    """Time that a plan must save to begin without moving [s]. Where a plan ends before something
    that only seems to close the path, to wait first would cost nothing, decision by decision."""
    either: bool
    """True if it drives backwards as well as forwards."""
    circle: int
    """Time steps of a whole turning circle of a robot that cannot stop; 0 for others."""


@njit
def room_around(
    ranges: NDArray[np.float64],  # [m], [R]
    directions: NDArray[np.float64],  # [2, R]
    origins: NDArray[np.float64],  # [m], [2, R]
    body: Body,
    rooms: NDArray[np.float64],  # [n, n]
) -> None:
    """Write the room of the robot's center in each cell around it, from what the lidar hit."""
    rooms[:] = ROOMY
    middle, last = rooms.shape[0] // 2, rooms.shape[0] - 1
    for ray in range(ranges.shape[0]):
        if ranges[ray] == math.inf:
            continue
        x = origins[0, ray] + ranges[ray] * directions[0, ray]
        y = origins[1, ray] + ranges[ray] * directions[1, ray]
        kept = kept_distance(math.hypot(x, y), body, 0.0)
        u, v, wide = middle + x / CELL, middle + y / CELL, (kept + ROOMY) / CELL
        for i in range(max(math.ceil(u - wide), 0), min(math.floor(u + wide), last) + 1):
            for j in range(max(math.ceil(v - wide), 0), min(math.floor(v + wide), last) + 1):
                away = CELL * math.sqrt((i - u) * (i - u) + (j - v) * (j - v))
                rooms[i, j] = min(rooms[i, j], away - kept)


@njit
def _room_at(rooms: NDArray[np.float64], x: float, y: float) -> float:
    """Room at a place in the robot's frame [m]."""
    first = -(rooms.shape[0] // 2) * CELL
    return interpolate(rooms, first, first, CELL, x, y)


@njit
def _length_from(scene: Scene, u: float, v: float) -> float:
    """Length of the path from a place on the map (column, row), by the best cell around it [m]."""
    lengths = scene.lengths
    best = scene.farthest
    left, low = math.floor(u), math.floor(v)
    for i in range(max(left - 1, 0), min(left + 3, lengths.shape[0])):
        for j in range(max(low - 1, 0), min(low + 3, lengths.shape[1])):
            if lengths[i, j] < best:
                gap = math.sqrt((i - u) * (i - u) + (j - v) * (j - v))
                best = min(best, lengths[i, j] + scene.resolution * gap)
    return best


@njit
def slope_at(scene: Scene, u: float, v: float) -> tuple[float, float]:
    """Slope of the path's length across and up the map at a place (column, row)."""
    off = _OFF / scene.resolution
    across = _length_from(scene, u + off, v) - _length_from(scene, u - off, v)
    return across, _length_from(scene, u, v + off) - _length_from(scene, u, v - off)


@njit
def _on_map(scene: Scene, x: float, y: float) -> tuple[float, float]:
    """Column and row of a place in the robot's frame [m]."""
    cosine, sine = math.cos(scene.pose[2]), math.sin(scene.pose[2])
    u = scene.pose[0] + (x * cosine - y * sine) / scene.resolution
    return u, scene.pose[1] + (x * sine + y * cosine) / scene.resolution


@njit
def _time_left(
    scene: Scene,
    place: tuple[float, float, float],  # x, y, heading at a plan's end [m, m, rad]
    speed: float,  # forward there [m/s]
    body: Body,
    effort: Effort,
) -> float:
    """Time from the end of a plan to the goal [s]: along the path, to turn and to accelerate."""
    u, v = _on_map(scene, place[0], place[1])
    fast = body.limits.fast
    time = _length_from(scene, u, v) / fast
    across, up = slope_at(scene, u, v)
    steep = math.hypot(across, up)
    if steep > 0.0:
        heading = scene.pose[2] + place[2]
        ahead = -(across * math.cos(heading) + up * math.sin(heading)) / steep
        beside = abs(up * math.cos(heading) - across * math.sin(heading)) / steep
        time += effort.turn * math.atan2(beside, abs(ahead) if effort.either else ahead)
        missing = fast - speed * ahead
        time += missing * missing / (2.0 * body.limits.acceleration * fast)
    return time


@njit
def plan_time(
    plan: NDArray[np.float64],  # wheel speeds of each time step [m/s], [T, 2]
    scene: Scene,
    body: Body,
    effort: Effort,
    most: float,  # [s]
) -> float:
    """Time to the goal by a plan [s]; infinite if it comes too near to something, or above most.

    The last state must be safe: the robot stands still in time or, where it cannot stand still,
    drives a full circle.
    """
    limits, parts = body.limits, math.ceil(body.limits.fast * body.time_step / (1.2 * CELL))
    part = body.time_step / parts
    left, right = scene.speeds[0, 0], scene.speeds[0, 1]
    x, y, heading, time = 0.0, 0.0, 0.0, 0.0
    # Between the cells, the room of the place where it stands may seem to be below zero.
    needed = min(_room_at(scene.rooms, 0.0, 0.0), 0.0) - 1e-9
    step, last = 0, plan.shape[0]
    while True:
        if step == last:
            time += _time_left(scene, (x, y, heading), 0.5 * (left + right), body, effort)
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
            room = _room_at(scene.rooms, x, y)
            if room < needed:
                return math.inf
        if step < last:
            near = 1.0 - max(room, 0.0) / ROOMY
            time += body.time_step * (1.0 + near * near)
            u, v = _on_map(scene, x, y)
            columns, rows = scene.levels.shape
            # A wall that the lidar does not see from here: the sectors show what is before it.
            if scene.levels[cell_of(u, columns), cell_of(v, rows)] == BLOCKED:
                time += _WALL * body.time_step
            if math.hypot(x - scene.goal[0], y - scene.goal[1]) <= scene.goal[2]:
                return time
        step += 1


@njit
def best_plan(
    plan: NDArray[np.float64],  # the last one; the best one is written here, [T, 2]
    firsts: NDArray[np.float64],  # speeds that are tried alone [m/s], [A, 2]
    pairs: NDArray[np.float64],  # speeds that are tried after one another [m/s], [B, 2]
    noise: NDArray[np.float64],  # [rounds, samples, 4, 2]
    scene: Scene,
    body: Body,
    effort: Effort,
) -> float:
    """Find the plan that takes the least time [s]; infinite if the filter lets none pass."""
    limits, steps, best, repeat = body.limits, plan.shape[0], math.inf, body.repeat
    trial, chosen = np.empty_like(plan), np.empty_like(plan)
    # What was planned, from now on, and to stand.
    trial[: steps - repeat], trial[steps - repeat :] = plan[repeat:], plan[-1]
    trial[:repeat] = trial[0]
    best = _better(trial, chosen, best, scene, body, effort)
    trial[:] = max(limits.slow, 0.0)
    best = _better(trial, chosen, best, scene, body, effort)
    for first in range(firsts.shape[0]):
        trial[:] = firsts[first]
        best = _better(trial, chosen, best, scene, body, effort)
    turn = max(steps // 4, repeat)
    for first in range(pairs.shape[0]):
        for second in range(pairs.shape[0]):
            if first != second:
                trial[:turn], trial[turn:] = pairs[first], pairs[second]
                best = _better(trial, chosen, best, scene, body, effort)
    if best == math.inf:
        return best
    ends = max(steps // 8, repeat), 3 * steps // 8, 5 * steps // 8, steps
    for spread in range(noise.shape[0]):
        plan[:] = chosen
        wide = _SPREAD[spread] * limits.fast
        for sample in range(noise.shape[1]):
            begin = 0
            for knot in range(4):
                for step in range(begin, ends[knot]):
                    for wheel in range(2):
                        speed = plan[step, wheel] + wide * noise[spread, sample, knot, wheel]
                        trial[step, wheel] = min(max(speed, limits.slow), limits.fast)
                begin = max(begin, ends[knot])
            best = _better(trial, chosen, best, scene, body, effort)
    plan[:] = chosen
    return best


@njit
def _better(
    trial: NDArray[np.float64],
    chosen: NDArray[np.float64],
    best: float,
    scene: Scene,
    body: Body,
    effort: Effort,
) -> float:
    """Choose a plan if it is better than the best so far, and the filter lets it begin so [s]."""
    slow = 1.0 - min(max(abs(trial[0, 0]), abs(trial[0, 1])) / body.limits.fast, 1.0)
    waits = effort.stand * slow * slow
    time = plan_time(trial, scene, body, effort, best - waits) + waits
    if time >= best:
        return best
    first = np.array(limited(trial[0, 0], trial[0, 1], body.limits))
    if room_after(first, scene.speeds, scene.points, scene.counts, body) <= scene.least:
        return best
    chosen[:] = trial
    return time
