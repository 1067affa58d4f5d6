"""The search for admissible actions, robot by robot."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.robots.motion_loops import WheelLimits, changed, scale_actions

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Body(NamedTuple):
    """Sizes, limits and time steps of a robot, as the filter reads them."""

    limits: WheelLimits
    wheel_base: float
    """[m]"""
    radius: float
    """Of the footprint [m]."""
    clearance: float
    """Of the rim, to be kept from what the lidar hits [m]."""
    time_step: float
    """For which wheel speeds are held [s]."""
    repeat: int
    """Time steps from decision to decision."""
    braking: float
    """Share of its acceleration with which the robot slows down at least."""
    quick: WheelLimits
    """Limits of a robot that turns more quickly than it says; else the same as its limits."""
    approach: float
    """Speed at which what is seen, or hidden behind that, may come [m/s]."""
    age: float
    """Time from what is seen to the moment at which an action begins [s]."""
    unseen: int
    """Rays, the last ones, in directions where the lidar does not look."""


_PARTS = 2
"""Places in each time step that are tested: some 3 cm apart, a dip of under 1 mm between them."""
_SHARE = 0.25
"""Of the clearance that is left where it is below what is kept, how much a decision may take."""
_LEAST = 1 / 3
"""Share of the clearance that is kept in any case."""
_CREEP = 0.1
"""Share of the least clearance, or of one below, that may be taken where the robot comes away: one
that turns may have a millimeter per second of forward speed, too, and would stand for ever."""
_TURNS = 0.1
"""Weight of another turn relative to that of another forward speed. The robot steers clear rather
than stopping: with equal weights it stands before walls."""
_GAIN = 0.001
"""Clearance that a robot gains at least that is ordered away from what is too near [m]."""
_BORDER = 40
"""Places on the border between what is seen and what a nearer obstacle beside it hides."""
_APART = 0.05
"""Distance between such places at least [m]: the robot comes 2 mm nearer to the middle of two."""
_STANDS = 1e-6
"""Forward speed below which a robot stands, or turns on the spot [m/s]."""
_DIP = 0.003
"""By how much the distance may be below that of the tested places, in time and on borders [m]."""
_TOUCH = 1e-9
"""Rounding of distances [m]."""
AT_RIM = 1e-6
"""The same of what is at the rim, as what is not seen: speeds of an observation are rounded, and a
robot that turns could not stop for the nanometers that it drives then."""


@njit
def filter_actions(
    actions: NDArray[np.float64],  # wanted, in [-1, 1], [N, 2]
    # Of the rays, in each of the states that a robot may be in [m], [N, S, R]; infinite where they
    # hit nothing.
    ranges: NDArray[np.float64],
    directions: NDArray[np.float64],  # of the rays, cosine and sine, [2, R]
    origins: NDArray[np.float64],  # of the rays, x and y in the robot's frame [m], [2, R]
    speeds: NDArray[np.float64],  # of the wheels in each state [m/s], [N, S, 2]
    still: NDArray[np.bool_],  # True for rays that are known to hit what stays, [N, S, R]
    candidates: NDArray[np.float64],  # actions to choose among, [K, 2]; the last one is safe
    body: Body,
    chosen: NDArray[np.float64],  # [N, 2]
) -> None:
    """Write each wanted action that is admissible, else the nearest candidate that is."""
    commands = np.empty_like(candidates)
    scale_actions(candidates, body.limits, commands)
    wanted = np.empty_like(actions)
    scale_actions(actions, body.limits, wanted)
    states = ranges.shape[1]
    points = np.empty((states, room_for_points(ranges.shape[2], body.approach), 4))
    counts = np.empty(states, np.int64)
    last = candidates.shape[0] - 1
    for robot in range(actions.shape[0]):
        _choose(chosen, robot, actions, robot)
        seen = ranges[robot], directions, origins, speeds[robot], still[robot]
        see(seen, body, 0.0, points, counts)
        farther = _nearest(0.0, 0.0, points[0, : counts[0]], body.radius) + _GAIN
        wants = least_room(points[0, : counts[0]], body)
        room = room_after(wanted[robot], speeds[robot], points, counts, body)
        if room > wants:
            continue
        admissible = room > -1.0
        gaps = np.empty(last)
        for k in range(last):
            across = candidates[k, 0] - actions[robot, 0]
            along = candidates[k, 1] - actions[robot, 1]
            gaps[k] = (across + along) ** 2 + _TURNS * (across - along) ** 2
        if not admissible:
            _choose(chosen, robot, candidates, last)
        if not admissible and body.limits.slow > 0.0:
            # Sectors show less than the truth: the circle that was free before may seem to be
            # blocked now, and the freer one is the better guess.
            around = _turning_radius(body.limits, body.wheel_base)
            near = points[0, : counts[0]]
            to_left = _nearest(0.0, around, near, 0.0)
            side = 1.0 if to_left >= _nearest(0.0, -around, near, 0.0) else -1.0
            chosen[robot, 0], chosen[robot, 1] = -side, side
        order = np.argsort(gaps)
        for k in order:
            room = room_after(commands[k], speeds[robot], points, counts, body)
            if room > wants or (not admissible and room > -1.0):
                _choose(chosen, robot, candidates, k)
                admissible = True
            if room > wants:
                break
        if room > wants:
            continue
        see(seen, body, _CREEP, points, counts)
        for k in order:
            if room_after(commands[k], speeds[robot], points, counts, body) > farther:
                _choose(chosen, robot, candidates, k)
                break


@njit
def _choose(
    chosen: NDArray[np.float64], robot: int, actions: NDArray[np.float64], number: int
) -> None:
    """Write the action of a number as that of a robot."""
    chosen[robot, 0], chosen[robot, 1] = actions[number, 0], actions[number, 1]


@njit
def least_room(points: NDArray[np.float64], body: Body) -> float:
    """Distance of a point that an action must exceed once the robot stands [m]; -1 if any does."""
    # Real wheels creep while they are told to stand: what has come too near is left.
    farther = _nearest(0.0, 0.0, points, body.radius) + _GAIN
    return farther if farther - body.radius < _LEAST * body.clearance else -1.0


@njit
def room_for_points(rays: int, approach: float) -> int:
    """Number of points that :func:`see` may write for a state."""
    return rays * (3 + _BORDER) if approach > 0.0 else rays


@njit
def see(
    # Ranges [S, R], directions and origins [2, R], speeds [S, 2] and still [S, R], as above.
    seen: tuple[
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.bool_],
    ],
    body: Body,
    creep: float,
    points: NDArray[np.float64],  # [S, P, 4]
    counts: NDArray[np.int64],  # [S]
) -> None:
    """Write the near points of each state and their numbers."""
    ranges, directions, origins, speeds, still = seen
    for state in range(len(ranges)):
        one = ranges[state], directions, origins, still[state]
        counts[state] = _near_points(one, speeds[state], body, creep, points[state])


@njit
def _near_points(
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]],
    speeds: NDArray[np.float64],
    body: Body,
    creep: float,  # share that may be taken of a clearance below the least
    # x, y, the squared distance to be kept from it [m], and 1 if it may come, else 0, [P, 4]
    points: NDArray[np.float64],
) -> int:
    """Write the points that the robot may reach before it stands; their number."""
    ranges, directions, origins, still = rays
    fastest = max(abs(body.limits.slow), abs(body.limits.fast), abs(speeds[0]), abs(speeds[1]))
    reach = fastest * body.repeat * body.time_step
    if body.limits.slow > 0.0:
        reach += 2.0 * _turning_radius(body.limits, body.wheel_base)
    else:
        reach += 0.5 * fastest * fastest / (body.braking * body.limits.acceleration)
    kept = body.radius + body.clearance
    if body.approach > 0.0:
        stops = body.repeat * body.time_step + fastest / (body.braking * body.limits.acceleration)
        reach += body.approach * (body.age + stops) + _DIP
    count = 0
    for ray in range(ranges.shape[0]):
        x = origins[0, ray] + ranges[ray] * directions[0, ray]
        y = origins[1, ray] + ranges[ray] * directions[1, ray]
        away = ranges[ray]
        if origins[0, ray] != 0.0 or origins[1, ray] != 0.0:
            away = math.hypot(x, y)
        if away <= reach + kept:
            points[count, 0] = x
            points[count, 1] = y
            # What is nearer already may come nearer by a share of what is left, which lets the
            # robot pass by it, but not nearer than the least.
            room = away - body.radius
            left = min(_LEAST * body.clearance, (1.0 - creep) * room)
            left = max(left, (1.0 - _SHARE) * room)
            touch = _TOUCH if room > AT_RIM else AT_RIM
            distance = min(away, kept, body.radius + left) - touch
            points[count, 2] = distance * distance
            comes = body.approach > 0.0 and ray < ranges.shape[0] - body.unseen
            points[count, 3] = 1.0 if comes and not still[ray] else 0.0
            count += 1
    if body.approach > 0.0:
        count = _add_borders(rays, body.unseen, reach + kept, points, count)
    return count


@njit
def _add_borders(
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]],
    unseen: int,  # the number of the last rays, where the lidar does not look
    reach: float,  # within which places count [m]
    points: NDArray[np.float64],
    count: int,  # of points so far
) -> int:
    """Add places beside nearer obstacles, from where what they hide may come; all their number."""
    ranges, directions, origins, still = rays
    seen = ranges.shape[0] - unseen
    apart = max(_APART, 2.0 * reach / _BORDER)
    for ray in range(seen):
        far = min(ranges[ray], reach + math.hypot(origins[0, ray], origins[1, ray]))
        for side in (-1, 1):
            beside = (ray + side) % seen
            near = ranges[beside]
            if near >= far or (unseen > 0 and abs(ray - beside) != 1):
                continue
            if still[ray] and still[beside]:  # A wall that goes on hides nothing.
                continue
            # Hits that may come stand for the ends of the border; those that stay do not.
            steps = min(math.ceil((far - near) / apart), _BORDER // 2)
            for step in range(0 if still[beside] else 1, steps + (1 if still[ray] else 0)):
                away = min(near + step * apart, far)
                points[count, 0] = origins[0, ray] + away * directions[0, ray]
                points[count, 1] = origins[1, ray] + away * directions[1, ray]
                # Nothing stands there: only what moves has to be kept off.
                points[count, 2], points[count, 3] = 0.0, 1.0
                count += 1
    return count


@njit
def room_after(
    command: NDArray[np.float64],  # speeds of the wheels [m/s], [2]
    speeds: NDArray[np.float64],  # in each state [m/s], [S, 2]
    points: NDArray[np.float64],  # [S, P, 4]
    counts: NDArray[np.int64],  # of the points, [S]
    body: Body,
) -> float:
    """Least distance of a point once the robot stands [m]; -1 if the command is not admissible."""
    least = math.inf
    for state in range(counts.shape[0]):
        if counts[state] > 0:
            near = points[state, : counts[state]]
            least = min(least, _room_after_from(command, speeds[state], near, body, body.limits))
            if body.quick.turning != body.limits.turning:
                least = min(least, _room_after_from(command, speeds[state], near, body, body.quick))
    return least


@njit
def _room_after_from(
    command: NDArray[np.float64],  # speeds of the wheels [m/s], [2]
    speeds: NDArray[np.float64],  # now [m/s], [2]
    points: NDArray[np.float64],  # [P, 4]
    body: Body,
    limits: WheelLimits,
) -> float:
    """As above, in one state: the robot stays off the points, and can do so afterwards.

    It can if it stands still in time or, where it cannot stand still, if a full circle is free.
    """
    left, right = speeds[0], speeds[1]
    x, y, heading, passed = 0.0, 0.0, 0.0, body.age
    step = 0
    while step < body.repeat or (limits.slow <= 0.0 and (left != 0.0 or right != 0.0)):
        wanted = (command[0], command[1]) if step < body.repeat else (0.0, 0.0)
        left, right = changed((left, right), wanted, limits, body.braking, body.time_step)
        part = body.time_step / _PARTS
        turn = (right - left) / body.wheel_base * part
        along = 0.5 * (left + right) * part
        for _ in range(_PARTS):
            x += along * math.cos(heading + 0.5 * turn)
            y += along * math.sin(heading + 0.5 * turn)
            heading += turn
            passed += part
            # The square of the distance within which it could be touched while it drives.
            nearest = 0.0
            if body.approach > 0.0 and abs(left + right) > 2.0 * _STANDS:
                nearest = (body.radius + body.approach * passed + _DIP) ** 2
            for point in range(points.shape[0]):
                across, ahead = points[point, 1] - y, points[point, 0] - x
                if across * across + ahead * ahead < max(
                    points[point, 2], nearest * points[point, 3]
                ):
                    return -1.0
        step += 1
    if limits.slow <= 0.0:
        return _nearest(x, y, points, body.radius)
    radius = _turning_radius(limits, body.wheel_base)
    kept = radius + body.radius + body.clearance
    across, along = radius * math.sin(heading), radius * math.cos(heading)
    to_left = _nearest(x - across, y + along, points, 0.0)
    free = max(to_left, _nearest(x + across, y - along, points, 0.0))
    return free if free >= kept else -1.0


@njit
def _nearest(x: float, y: float, points: NDArray[np.float64], least: float) -> float:
    """Distance of a place (x, y) from the nearest point, of those to be kept off by least [m]."""
    nearest = math.inf
    for point in range(points.shape[0]):
        across, ahead = points[point, 1] - y, points[point, 0] - x
        if points[point, 2] >= least * least:
            nearest = min(nearest, across * across + ahead * ahead)
    return math.sqrt(nearest)


@njit
def _turning_radius(limits: WheelLimits, wheel_base: float) -> float:
    """Radius of the smallest circle of the robot's center [m]."""
    return 0.5 * wheel_base * (limits.fast + limits.slow) / (limits.fast - limits.slow)
