"""Lengths of the cheapest paths on a robot's map, as far as the robot needs them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE, path_lengths
from mpfa_envs.sensing.map_loops import BLOCKED
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FACTORS: Final = np.array((5, 8, 150, 1000))
"""Cost of a step in a free cell, one near an obstacle, a tight and a blocked one."""
_STEP: Final = RESOLUTION * STEP_SCALE / 5
"""Length of a straight step over its cost [m]."""
_BUCKETS: Final = 2500
"""More than the costliest step costs."""
_RIM: Final = 3
"""Free cells around what is known: no path is shorter farther outside, where nothing is."""
_BEYOND: Final = 12.0
"""By how much longer paths may be than that of the robot to be told apart [m]."""


def cost_to_go(
    levels: NDArray[np.uint8],  # of the map, [columns, rows]
    raised: NDArray[np.int64],  # by how much cells cost more, [columns, rows]
    target: tuple[int, int],  # cell of the goal
    place: tuple[int, int],  # cell of the robot
    reach: int,  # cells around it whose lengths count
) -> NDArray[np.float64]:
    """Lengths of the cheapest paths to the goal [m], ``[columns, rows]``.

    Those of cells that are farther away than the robot by much, or that lie outside of all that is
    known, the goal and the robot's surroundings, are only known to be at least so long.
    """
    known = (levels > 0) | (raised > 0)
    across = _span(np.asarray(known.any(axis=1)), target[0], place[0], reach)
    up = _span(np.asarray(known.any(axis=0)), target[1], place[1], reach)
    area = slice(*across), slice(*up)
    found = path_lengths(
        np.minimum(_FACTORS[levels[area]] + raised[area], _FACTORS[BLOCKED]),
        np.array([(target[0] - across[0], target[1] - up[0])]),
        np.zeros(1),
        MOVES,
        _STEP,
        math.inf,
        (place[0] - across[0], place[1] - up[0]),
        _BUCKETS,
        _BEYOND / _STEP,
    )
    farthest = found[place[0] - across[0], place[1] - up[0]] + _BEYOND
    lengths = np.full(levels.shape, farthest)
    lengths[area] = np.minimum(found, farthest)
    return lengths


def _span(known: NDArray[np.bool_], target: int, place: int, reach: int) -> tuple[int, int]:
    """First column or row of the area, and the one after its last."""
    at = np.flatnonzero(known)
    ends = (at[0], at[-1]) if len(at) else (target, target)
    first = min(int(ends[0]), target, place - reach) - _RIM
    last = max(int(ends[1]), target, place + reach) + _RIM
    return max(first, 0), min(last + 1, len(known))
