"""The distance fields of many robots as arrays that compiled loops read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.paths.distance import DistanceField


class FieldArrays(NamedTuple):
    """Path lengths by robot; each field fills the first columns and rows of its table."""

    values: NDArray[np.float32]
    """Length of the path to the goal from each cell [m], ``[N, most columns, most rows]``."""
    shapes: NDArray[np.int64]
    """Numbers of columns and rows, ``[N, 2]``."""
    origins: NDArray[np.float64]
    """Center of the first cell (x, y) [m], ``[N, 2]``."""
    resolutions: NDArray[np.float64]
    """Side of a cell [m], ``[N]``."""


class FieldBatch:
    """A distance field for each of many robots."""

    def __init__(self, robots: int) -> None:
        self._fields = FieldArrays(
            np.zeros((robots, 0, 0), dtype=np.float32),
            np.zeros((robots, 2), dtype=np.int64),
            np.zeros((robots, 2)),
            np.ones(robots),
        )

    @property
    def arrays(self) -> FieldArrays:
        """Arrays for compiled loops; setting a larger field may replace them."""
        return self._fields

    def __setitem__(self, robot: int, field: DistanceField) -> None:
        nx, ny = field.filled.shape
        values = self._fields.values
        if nx > values.shape[1] or ny > values.shape[2]:
            most = max(nx, values.shape[1]), max(ny, values.shape[2])
            wider = np.zeros((len(values), *most), dtype=np.float32)
            wider[:, : values.shape[1], : values.shape[2]] = values
            self._fields = self._fields._replace(values=wider)
        self._fields.values[robot, :nx, :ny] = field.filled
        self._fields.shapes[robot] = nx, ny
        self._fields.origins[robot] = field.origin
        self._fields.resolutions[robot] = field.resolution
