"""Occupied cells of a map, as a lidar's SLAM or a floor plan gives them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_number, check_positive

MOST_CELLS: Final = 16_000_000
"""Most cells of a map, 4,000 x 4,000."""
LONGEST_SIDE: Final = 30_000
"""Most columns or rows: their numbers have 16 bits."""
_FARTHEST: Final = 255
"""Greatest distance to an occupied cell in the tables [cells]."""


class CellArrays(NamedTuple):
    """Tables of a map for loops over rays and distances, each ``[columns, rows]``."""

    left: NDArray[np.int16]
    """The nearest occupied column in a cell's row, from it to the left; -32,768 if none is."""
    right: NDArray[np.int16]
    """The same to the right; 32,767 if none is."""
    gaps: NDArray[np.uint8]
    """Columns or rows to the nearest occupied cell, whichever are more, up to 255: no cell of the
    square with fewer to each side is occupied."""


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Square cells over a whole room; neither a robot nor a ray gets into an occupied one.

    Two grids are equal if all their numbers are.

    Args:
        occupied: True for an occupied cell, shape ``[columns, rows]``, the first column at the left
            and the first row at the bottom.
        resolution: Side of a cell [m].
        origin: Position of the lower left corner on the map (x, y) [m]; the origin of the world is
            the middle of the room.

    Raises:
        ValueError: If there is no cell or there are too many, or a number is out of its range.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs.worlds.occupancy import OccupancyGrid
        >>> from mpfa_envs import World
        >>> cells = np.zeros((200, 100), dtype=bool)
        >>> cells[100, 20:] = True
        >>> grid = OccupancyGrid(cells, 0.05, origin=(-2.0, -1.0))
        >>> world = World(name="two halls", size=grid.size, occupancy=grid)
        >>> world.size, round(world.clearance(-1.0, 0.0), 3), grid.center
        ((10.0, 5.0), 1.0, (3.0, 1.5))
    """

    occupied: NDArray[np.bool_]
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        cells = np.array(self.occupied)  # A copy, which stays as it is.
        if cells.ndim != 2 or cells.dtype != np.bool_ or not cells.size:
            raise ValueError(
                "occupied must be an array [columns, rows] of bool, got shape "
                f"{cells.shape} of {cells.dtype}"
            )
        if cells.size > MOST_CELLS or max(cells.shape) > LONGEST_SIDE:
            raise ValueError(
                f"occupied must have at most {MOST_CELLS} cells and {LONGEST_SIDE} a side, got "
                f"{cells.shape}"
            )
        cells.flags.writeable = False
        origin = tuple(check_number("origin", value) for value in self.origin)
        if len(origin) != 2:
            raise ValueError(f"origin must be two numbers, got {self.origin}")
        # The dataclass is frozen; these are its only changes, before it is used.
        object.__setattr__(self, "occupied", cells)
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "resolution", check_positive("resolution", self.resolution))

    def __repr__(self) -> str:
        columns, rows = self.occupied.shape
        return f"OccupancyGrid({columns} x {rows} cells of {self.resolution} m)"

    @property
    def size(self) -> tuple[float, float]:
        """Width and depth of all cells [m]."""
        columns, rows = self.occupied.shape
        return columns * self.resolution, rows * self.resolution

    @property
    def center(self) -> tuple[float, float]:
        """Position of the world's (0, 0) in the frame of the map (x, y) [m]."""
        width, depth = self.size
        return self.origin[0] + width / 2, self.origin[1] + depth / 2

    @property
    def area(self) -> float:
        """Area of the occupied cells [m²]."""
        return float(np.count_nonzero(self.occupied)) * self.resolution**2

    @cached_property
    def arrays(self) -> CellArrays:
        """Tables for loops over rays and distances."""
        columns = np.arange(len(self.occupied), dtype=np.int16)[:, None]
        left = np.where(self.occupied, columns, np.int16(-32768))
        right = np.where(self.occupied, columns, np.int16(32767))
        np.maximum.accumulate(left, axis=0, out=left)
        np.minimum.accumulate(right[::-1], axis=0, out=right[::-1])
        gaps = np.full(self.occupied.shape, _FARTHEST, dtype=np.uint8)
        if self.occupied.any():
            # Imported here because few worlds are maps.
            from scipy.ndimage import distance_transform_cdt

            steps = distance_transform_cdt(~self.occupied, metric="chessboard")
            np.minimum(steps, _FARTHEST, out=gaps, casting="unsafe")
        return CellArrays(left, right, gaps)

    @cached_property
    def digest(self) -> bytes:
        """Hash of the grid, 256 bits."""
        numbers = repr((self.occupied.shape, self.resolution, self.origin)).encode()
        return hashlib.sha256(numbers + np.packbits(self.occupied).tobytes()).digest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyGrid):
            return NotImplemented
        return self is other or self.digest == other.digest

    def __hash__(self) -> int:
        """The same in every process."""
        return int.from_bytes(self.digest[:7], "big")
