"""Maps that robots make of their lidar's hits, and the paths to the goal on them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.compiled import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

NEAR: Final = 1
"""A cell near an obstacle."""
TIGHT: Final = 2
"""A cell where the robot's rim would be within centimeters of an obstacle."""
BLOCKED: Final = 3
"""A cell where the robot's center cannot be."""
FACTORS: Final = np.array((1, 3, 30, 200), dtype=np.int64)
"""Cost of a step in a free cell, one near an obstacle, a tight and a blocked one. None is infinite:
a robot may stand where it should not, and where all paths are blocked it continues to look. But a
wall, some five blocked cells thick, must cost more than any path around it."""
STRAIGHT: Final = 10
"""Length of a straight step."""
DIAGONAL: Final = 14
"""Length of a diagonal step."""
UNKNOWN: Final = int(np.iinfo(np.int32).max)
"""Cost of a cell without a known path."""
_RING: Final = 4096
"""More than the costliest step."""
_NEXT_CELLS: Final = 20
"""Cells of the path that its direction depends on."""
_AROUND: Final = 8
"""By how many steps a path may be longer to be found in addition to the robot's own."""
_ACROSS: Final = np.array((1, 0, -1, 0, 1, -1, -1, 1), dtype=np.int64)
_UP: Final = np.array((0, 1, 0, -1, 1, 1, -1, -1), dtype=np.int64)
"""The steps: four straight ones, four diagonal ones."""


class MapArrays(NamedTuple):
    """Maps by robot, changed in place; of each only the first columns and rows count."""

    levels: NDArray[np.uint8]
    """0 where nothing was met, :data:`NEAR`, :data:`TIGHT` or :data:`BLOCKED`,
    ``[N, columns, rows]``."""
    costs: NDArray[np.int32]
    """Cost of the cheapest path to the goal, ``[N, columns, rows]``."""
    shapes: NDArray[np.int64]
    """Numbers of columns and rows, ``[N, 2]``."""
    origins: NDArray[np.float64]
    """Center of the first cell (x, y) [m], ``[N, 2]``."""


@njit
def enter_scans(
    motions: NDArray[np.float64],  # x, y, heading first [m, m, rad], [N, 5]
    taken: NDArray[np.float64],  # where the scans were taken, as motions
    goals: NDArray[np.float64],  # x, y [m], [N, 2]
    ranges: NDArray[np.float64],  # [m], [N, rays]
    chosen: NDArray[np.bool_],  # [N]; the others' rows stay
    directions: NDArray[np.float64],  # cosine and sine in the robot's frame, [2, rays]
    maps: MapArrays,
    # [m]: a cell, up to where cells are blocked, tight and near, max_range
    lengths: tuple[float, float, float, float, float],
    mount: tuple[float, float],  # of the lidar in the robot's frame [m]
    paths: NDArray[np.float64],  # direction (x, y) in the robot's frame and length [m], [N, 3]
) -> None:
    """Enter a scan of the chosen robots in their maps, and find the paths to their goals."""
    resolution, blocked, tight, near, max_range = lengths
    bounds = blocked / resolution, tight / resolution, near / resolution
    links = np.empty((3, maps.levels.shape[1] * maps.levels.shape[2]), dtype=np.int32)
    for robot in range(motions.shape[0]):
        if not chosen[robot]:
            continue
        nx, ny = maps.shapes[robot, 0], maps.shapes[robot, 1]
        levels, costs = maps.levels[robot, :nx, :ny], maps.costs[robot, :nx, :ny]
        # In cells from the center of the first.
        u = (taken[robot, 0] - maps.origins[robot, 0]) / resolution
        v = (taken[robot, 1] - maps.origins[robot, 1]) / resolution
        cosine, sine = math.cos(taken[robot, 2]), math.sin(taken[robot, 2])
        from_u = u + (mount[0] * cosine - mount[1] * sine) / resolution
        from_v = v + (mount[0] * sine + mount[1] * cosine) / resolution
        changed = False
        for ray in range(ranges.shape[1]):
            if ranges[robot, ray] < max_range:
                reach = ranges[robot, ray] / resolution
                across = directions[0, ray] * cosine - directions[1, ray] * sine
                up = directions[0, ray] * sine + directions[1, ray] * cosine
                changed |= enter_hit(levels, from_u + reach * across, from_v + reach * up, bounds)
        x, y, heading = motions[robot, 0], motions[robot, 1], motions[robot, 2]
        cosine, sine = math.cos(heading), math.sin(heading)
        u = (x - maps.origins[robot, 0]) / resolution
        v = (y - maps.origins[robot, 1]) / resolution
        i, j = cell_of(u, nx), cell_of(v, ny)
        if costs[i, j] == UNKNOWN or (changed and not _costs_the_same(levels, costs, i, j)):
            goal = (
                cell_of((goals[robot, 0] - maps.origins[robot, 0]) / resolution, nx),
                cell_of((goals[robot, 1] - maps.origins[robot, 1]) / resolution, ny),
            )
            _find_paths(levels, goal, (i, j), costs, links)
        ahead_i, ahead_j, ends = _look_ahead(levels, costs, i, j)
        across, up = ahead_i - u, ahead_j - v
        if ends:
            across, up = goals[robot, 0] - x, goals[robot, 1] - y
        length = math.hypot(across, up)
        if length > 0.0:
            paths[robot, 0] = (across * cosine + up * sine) / length
            paths[robot, 1] = (up * cosine - across * sine) / length
        paths[robot, 2] = costs[i, j] * resolution / STRAIGHT


@njit
def cell_of(place: float, count: int) -> int:
    """The column or row of a place, the nearest one for a place outside."""
    return min(max(math.floor(place + 0.5), 0), count - 1)


@njit
def enter_hit(
    levels: NDArray[np.uint8], u: float, v: float, bounds: tuple[float, float, float]
) -> bool:
    """Enter a point that the lidar hit; return True if the map has changed."""
    blocked, tight, near = bounds
    nx, ny = levels.shape
    changed = False
    outer, inner, core = near * near, tight * tight, blocked * blocked
    first, last = max(math.ceil(v - near), 0), min(math.floor(v + near), ny - 1)
    for i in range(max(math.ceil(u - near), 0), min(math.floor(u + near), nx - 1) + 1):
        across = (i - u) * (i - u)
        for j in range(first, last + 1):
            square = across + (j - v) * (j - v)
            # BLOCKED, TIGHT, NEAR or 0 without a branch, which would often be taken wrongly.
            level = (square <= outer) + (square <= inner) + (square <= core)
            if level > levels[i, j]:
                levels[i, j] = level
                changed = True
    return changed


@njit
def _step_cost(levels: NDArray[np.uint8], i: int, j: int, move: int) -> int:
    """Cost of a step from a cell, or of the same step back; negative if it leaves the map."""
    to_i, to_j = i + _ACROSS[move], j + _UP[move]
    if to_i < 0 or to_j < 0 or to_i >= levels.shape[0] or to_j >= levels.shape[1]:
        return -1
    length = STRAIGHT if move < 4 else DIAGONAL
    return length * max(FACTORS[levels[i, j]], FACTORS[levels[to_i, to_j]])


@njit
def _costs_the_same(levels: NDArray[np.uint8], costs: NDArray[np.int32], i: int, j: int) -> bool:
    """Return True if the path from a cell still has the cost at which it was found."""
    # It is still the cheapest then: new hits make paths costlier, never cheaper.
    cells = follow_path(levels, costs, i, j)
    if len(cells) > 0:
        i, j = cells[-1, 0], cells[-1, 1]
    return bool(costs[i, j] == 0)


@njit
def follow_path(
    levels: NDArray[np.uint8], costs: NDArray[np.int32], i: int, j: int
) -> NDArray[np.int64]:
    """Columns and rows, ``[cells, 2]``, of the path behind a cell, as far as it was found."""
    cells = np.empty((costs.size, 2), dtype=np.int64)
    count = 0
    while 0 < costs[i, j] < UNKNOWN:
        for move in range(8):
            cost = _step_cost(levels, i, j, move)
            if cost >= 0 and costs[i + _ACROSS[move], j + _UP[move]] == costs[i, j] - cost:
                i, j = i + _ACROSS[move], j + _UP[move]
                break
        else:
            break
        cells[count, 0], cells[count, 1] = i, j
        count += 1
    return cells[:count]


@njit
def _find_paths(
    levels: NDArray[np.uint8],
    goal: tuple[int, int],
    start: tuple[int, int],
    costs: NDArray[np.int32],
    links: NDArray[np.int32],
) -> None:
    """Find the cheapest paths to the goal from the start and from around it."""
    # A* from the goal to the start, with Dial's ring of buckets: as costs are small integers, the
    # cells that wait are kept in a list for each cost, and no heap is needed.
    nx, ny = levels.shape
    costs[:, :] = UNKNOWN
    heads = np.empty(_RING, dtype=np.int64)
    heads[:] = -1
    after, before, found = links[0], links[1], links[2]
    found[: levels.size] = UNKNOWN
    cell = goal[0] * ny + goal[1]
    found[cell] = 0
    total, last, waiting = _least_cost(goal[0], goal[1], start), UNKNOWN, 1
    _put_in_front(heads, after, before, total % _RING, cell)
    while waiting > 0 and total <= last:
        cell = heads[total % _RING]
        if cell < 0:
            total += 1
            continue
        _take_out(heads, after, before, total % _RING, cell)
        waiting -= 1
        i, j, cost = cell // ny, cell % ny, found[cell]
        costs[i, j] = cost
        if i == start[0] and j == start[1]:
            last = total + _AROUND * STRAIGHT
        own = FACTORS[levels[i, j]]
        for move in range(8):
            to_i, to_j = i + _ACROSS[move], j + _UP[move]
            if to_i < 0 or to_j < 0 or to_i >= nx or to_j >= ny:
                continue
            to, length = to_i * ny + to_j, STRAIGHT if move < 4 else DIAGONAL
            # Most are found already, and cheaper than by any step from here.
            if cost + length * own >= found[to]:
                continue
            step = length * max(own, FACTORS[levels[to_i, to_j]])
            if cost + step >= found[to]:
                continue
            rest = _least_cost(to_i, to_j, start)
            if found[to] == UNKNOWN:
                waiting += 1
            else:
                _take_out(heads, after, before, (found[to] + rest) % _RING, to)
            found[to] = cost + step
            _put_in_front(heads, after, before, (cost + step + rest) % _RING, to)


@njit
def _least_cost(i: int, j: int, start: tuple[int, int]) -> int:
    """Cost of the path between two cells if all were free."""
    across, up = abs(i - start[0]), abs(j - start[1])
    return STRAIGHT * max(across, up) + (DIAGONAL - STRAIGHT) * min(across, up)


@njit
def _put_in_front(
    heads: NDArray[np.int64],
    after: NDArray[np.int32],
    before: NDArray[np.int32],
    bucket: int,
    cell: int,
) -> None:
    """Put a cell at the head of a bucket's list."""
    after[cell], before[cell] = heads[bucket], -1
    if heads[bucket] >= 0:
        before[heads[bucket]] = cell
    heads[bucket] = cell


@njit
def _take_out(
    heads: NDArray[np.int64],
    after: NDArray[np.int32],
    before: NDArray[np.int32],
    bucket: int,
    cell: int,
) -> None:
    """Take a cell out of a bucket's list."""
    if before[cell] >= 0:
        after[before[cell]] = after[cell]
    else:
        heads[bucket] = after[cell]
    if after[cell] >= 0:
        before[after[cell]] = before[cell]


@njit
def _look_ahead(
    levels: NDArray[np.uint8], costs: NDArray[np.int32], i: int, j: int
) -> tuple[int, int, bool]:
    """Farthest cell of the path in an open straight line, and whether it is the goal's."""
    ahead_i, ahead_j, at_i, at_j = i, j, i, j
    for _ in range(_NEXT_CELLS):
        least = costs[at_i, at_j]
        to_i, to_j = at_i, at_j
        for move in range(8):
            next_i, next_j = at_i + _ACROSS[move], at_j + _UP[move]
            if _step_cost(levels, at_i, at_j, move) >= 0 and costs[next_i, next_j] < least:
                least, to_i, to_j = costs[next_i, next_j], next_i, next_j
        at_i, at_j = to_i, to_j
        if not _is_open(levels, i, j, at_i, at_j):
            break
        ahead_i, ahead_j = at_i, at_j
    return ahead_i, ahead_j, costs[ahead_i, ahead_j] == 0


@njit
def _is_open(levels: NDArray[np.uint8], i: int, j: int, to_i: int, to_j: int) -> bool:
    """Return True if the line between two cells is no narrower than its ends."""
    # From a blocked cell every line would be open, through walls too.
    widest = min(max(levels[i, j], levels[to_i, to_j]), TIGHT)
    steps = max(abs(to_i - i), abs(to_j - j))
    for step in range(1, steps):
        at_i = math.floor(i + (to_i - i) * step / steps + 0.5)
        at_j = math.floor(j + (to_j - j) * step / steps + 0.5)
        if levels[at_i, at_j] > widest:
            return False
    return True
