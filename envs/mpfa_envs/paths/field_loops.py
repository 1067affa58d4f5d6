"""Lengths of the shortest paths from one place over the cells of a grid."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.compiled import njit

_BEYOND: Final = 3.0
"""Steps by which the last cell that is needed is exceeded: more than a move is long."""
_BUCKETS: Final = 8
"""Number of buckets; a move over free cells leads three ahead at most."""


@njit
def _twice(entries: NDArray[np.int64]) -> NDArray[np.int64]:
    """The entries in an array that has room for as many more."""
    longer = np.empty(2 * len(entries), np.int64)
    for k in range(len(entries)):
        longer[k] = entries[k]
    return longer


@njit
def path_lengths(
    # True, or by how much longer a move counts there; 0 where none leads, [nx, ny].
    free: NDArray[np.bool_] | NDArray[np.int64],
    seeds: NDArray[np.int64],  # [seeds, 2]
    gaps: NDArray[np.float64],  # [m] [seeds]
    moves: NDArray[np.int64],
    step: float,  # [m]
    limit: float,  # [m]
    last: tuple[int, int] = (-1, -1),  # Cells much farther than this one are left out.
    buckets: int = _BUCKETS,  # More than the longest move has steps.
) -> NDArray[np.float64]:
    """Lengths of the shortest paths to all cells within the limit [m], ``[nx, ny]``."""
    # They are those of Dijkstra's algorithm to the bit. Cells wait in buckets as wide as the
    # shortest move: no cell of a bucket is reached by a shorter path through another one of it, so
    # that they need not be sorted (Dial 1969).
    nx, ny = free.shape
    lengths_to = np.empty((nx, ny))
    lengths_to[:, :] = math.inf
    settled = np.zeros((nx, ny), np.bool_)
    lengths = np.sqrt((moves[:, 0] ** 2 + moves[:, 1] ** 2).astype(np.float64)) * step
    # Lists of cells: the first of each bucket, and behind each entry the next.
    heads = np.empty(buckets, np.int64)
    heads[:] = -1
    cells, nexts = np.empty(1024, np.int64), np.empty(1024, np.int64)
    entries, waiting = 0, 0
    for k in range(len(seeds)):
        i, j = seeds[k]
        if gaps[k] <= limit and gaps[k] < lengths_to[i, j]:
            lengths_to[i, j] = gaps[k]
            bucket = int(gaps[k] / step) % buckets
            cells[entries], nexts[entries] = i * ny + j, heads[bucket]
            heads[bucket] = entries
            entries += 1
            waiting += 1
    bucket = 0
    while waiting > 0:
        at = heads[bucket % buckets]
        if at < 0:
            bucket += 1
            continue
        heads[bucket % buckets] = nexts[at]
        waiting -= 1
        i, j = cells[at] // ny, cells[at] % ny
        if settled[i, j] or lengths_to[i, j] > limit:
            continue
        settled[i, j] = True
        if i == last[0] and j == last[1]:
            limit = min(limit, lengths_to[i, j] + _BEYOND * step)
        if entries + len(moves) > len(cells):
            cells, nexts = _twice(cells), _twice(nexts)
        for k in range(len(moves)):
            to_i, to_j = i + moves[k, 0], j + moves[k, 1]
            if to_i < 0 or to_j < 0 or to_i >= nx or to_j >= ny or not free[to_i, to_j]:
                continue
            length = lengths_to[i, j] + lengths[k]
            if length > limit or length >= lengths_to[to_i, to_j]:
                continue
            length = lengths_to[i, j] + _factor(free, i, j, moves[k]) * lengths[k]
            if length > limit or length >= lengths_to[to_i, to_j]:
                continue
            lengths_to[to_i, to_j] = length
            later = int(length / step) % buckets
            cells[entries], nexts[entries] = to_i * ny + to_j, heads[later]
            heads[later] = entries
            entries += 1
            waiting += 1
    return lengths_to


@njit
def _factor(
    free: NDArray[np.bool_] | NDArray[np.int64], i: int, j: int, move: NDArray[np.int64]
) -> float:
    """By how much longer a move from a cell counts; infinite if it cuts a corner."""
    over, under = free[i + move[2], j + move[3]], free[i + move[4], j + move[5]]
    if not (over and under):
        return math.inf
    return float(max(int(free[i, j]), int(free[i + move[0], j + move[1]]), int(over), int(under)))
