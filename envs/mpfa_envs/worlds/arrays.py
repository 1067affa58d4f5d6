"""The arrays that compiled loops read worlds from."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Scalar = TypeVar("_Scalar", bound=np.generic)
_Arrays = TypeVar("_Arrays", bound=NamedTuple)


class GridArrays(NamedTuple):
    """Maps of the robots' worlds; each fills the first columns and rows of its table."""

    left: NDArray[np.int16]
    """The nearest occupied column to the left, ``[maps, most columns, most rows]``."""
    right: NDArray[np.int16]
    """The nearest to the right."""
    gaps: NDArray[np.uint8]
    """Columns or rows to the nearest occupied cell."""
    shapes: NDArray[np.int64]
    """Numbers of columns and rows, ``[maps, 2]``."""
    resolutions: NDArray[np.float64]
    """Side of a cell [m], ``[maps]``."""


class BatchArrays(NamedTuple):
    """Shapes by robot; only the first ``counts`` of each row are read."""

    half_sizes: NDArray[np.float64]
    """Half the width and the depth of the rooms [m], ``[N, 2]``."""
    boxes: NDArray[np.float64]
    """(x_min, y_min, x_max, y_max) [m], ``[N, most boxes, 4]``."""
    circles: NDArray[np.float64]
    """(x, y, radius) [m], ``[N, most circles, 3]``; walkers come after the cylinders."""
    segments: NDArray[np.float64]
    """Edges of polygons (x0, y0, x1, y1) [m], ``[N, most edges, 4]``."""
    polygon_ends: NDArray[np.int64]
    """End of each polygon's edges in segments, ``[N, most polygons]``."""
    counts: NDArray[np.int64]
    """Numbers of boxes, circles, segments and polygons, ``[N, 4]``."""
    grids: GridArrays
    """Maps; robots in the same one share it."""
    grid_of: NDArray[np.int64]
    """Number of each robot's map, -1 without one, ``[N]``."""


def grown(table: NDArray[_Scalar], *sides: int) -> NDArray[_Scalar]:
    """The table, or a larger copy where its axes after the first are shorter than these sides."""
    shape = table.shape
    wanted = (shape[0], *map(max, shape[1:], sides), *shape[len(sides) + 1 :])
    if wanted == shape:
        return table
    wider: NDArray[Any] = np.zeros(wanted, dtype=table.dtype)
    wider[tuple(map(slice, shape))] = table
    return wider


def with_row(arrays: _Arrays, robot: int, **rows: ArrayLike) -> _Arrays:
    """The arrays with rows of a robot, each first in its row of a table that grows if it must."""
    for name, values in rows.items():
        row, before = np.asarray(values), getattr(arrays, name)
        table = grown(before, *row.shape)
        place: tuple[int | slice, ...] = (robot, *map(slice, row.shape))
        table[place] = row
        if table is not before:
            arrays = arrays._replace(**{name: table})
    return arrays
