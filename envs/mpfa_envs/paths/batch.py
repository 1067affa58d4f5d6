"""The distance fields of many robots as arrays that compiled loops read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.paths.distance import DistanceField
from mpfa_envs.worlds.arrays import with_row


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

    @classmethod
    def empty(cls, robots: int) -> FieldArrays:
        """Arrays of robots that have no field yet."""
        return cls(
            np.zeros((robots, 0, 0), dtype=np.float32),
            np.zeros((robots, 2), dtype=np.int64),
            np.zeros((robots, 2)),
            np.ones(robots),
        )

    def with_field(self, robot: int, field: DistanceField) -> FieldArrays:
        """The arrays with the field of a robot, written in place where there is room."""
        return with_row(
            self,
            robot,
            values=field.filled,
            shapes=field.filled.shape,
            origins=field.origin,
            resolutions=field.resolution,
        )
