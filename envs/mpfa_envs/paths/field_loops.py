"""Shortest ways over the cells of a grid from one place, as far as they are asked for."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.compiled import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BUCKETS: Final = 8
"""More than a move can lead ahead, which is three."""


@njit
def ways_from(
    free: NDArray[np.bool_],
    seeds: NDArray[np.int64],
    gaps: NDArray[np.float64],
    moves: NDArray[np.int64],
    step: float,
    limit: float,
) -> NDArray[np.float64]:
    """Measure the shortest ways from a place to all cells that are near enough.

    They are those of Dijkstra's algorithm to the bit. Cells wait in buckets as wide as the shortest
    move: no cell of a bucket is reached by a shorter way through another one of it, so that they
    need not be sorted (Dial 1969).

    Args:
        free: Which cells are free, ``[nx, ny]``.
        seeds: Columns and rows of the cells around the place, ``[seeds, 2]``.
        gaps: How far they are from it [m], ``[seeds]``.
        moves: Steps to the neighbors and the cells that they pass, ``[16, 6]``.
        step: Length of a straight step [m].
        limit: Longest way [m].

    Returns:
        Lengths [m], infinite where there is no way or only a longer one, ``[nx, ny]``.
    """
    nx, ny = free.shape
    ways = np.full((nx, ny), math.inf)
    settled = np.zeros((nx, ny), np.bool_)
    lengths = np.sqrt((moves[:, 0] ** 2 + moves[:, 1] ** 2).astype(np.float64)) * step
    # Lists of cells: the first of each bucket, and behind each entry the next.
    heads = np.full(_BUCKETS, -1)
    cells, nexts = np.empty(1024, np.int64), np.empty(1024, np.int64)
    entries, waiting = 0, 0
    for k in range(len(seeds)):
        i, j = seeds[k]
        if gaps[k] <= limit and gaps[k] < ways[i, j]:
            ways[i, j] = gaps[k]
            bucket = int(gaps[k] / step) % _BUCKETS
            cells[entries], nexts[entries] = i * ny + j, heads[bucket]
            heads[bucket] = entries
            entries += 1
            waiting += 1
    bucket = 0
    while waiting > 0:
        at = heads[bucket % _BUCKETS]
        if at < 0:
            bucket += 1
            continue
        heads[bucket % _BUCKETS] = nexts[at]
        waiting -= 1
        i, j = cells[at] // ny, cells[at] % ny
        if settled[i, j]:
            continue
        settled[i, j] = True
        if entries + len(moves) > len(cells):
            cells = np.concatenate((cells, cells))
            nexts = np.concatenate((nexts, nexts))
        for k in range(len(moves)):
            to_i, to_j = i + moves[k, 0], j + moves[k, 1]
            if to_i < 0 or to_j < 0 or to_i >= nx or to_j >= ny or not free[to_i, to_j]:
                continue
            way = ways[i, j] + lengths[k]
            if way > limit or way >= ways[to_i, to_j]:
                continue
            if not free[i + moves[k, 2], j + moves[k, 3]]:
                continue
            if not free[i + moves[k, 4], j + moves[k, 5]]:
                continue
            ways[to_i, to_j] = way
            later = int(way / step) % _BUCKETS
            cells[entries], nexts[entries] = to_i * ny + to_j, heads[later]
            heads[later] = entries
            entries += 1
            waiting += 1
    return ways
