"""What stands in a world: boxes, cylinders and polygons, or the occupied cells of a map."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import all_finite, check_number, check_positive, keep

Point = tuple[float, float]
"""A position (x, y) [m]."""

LARGEST_SIDE: Final = 1000.0
"""Greatest width and depth of a room [m]."""
MOST_VERTICES: Final = 100
"""Most vertices of a polygon, whose edges are compared in pairs."""


class Bounds(NamedTuple):
    """The smallest upright rectangle around a shape [m]."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float


@dataclass(frozen=True)
class Box:
    """An upright box or a rectangular region, sides parallel to the walls.

    Args:
        x_min: Left edge [m].
        y_min: Lower edge [m].
        x_max: Right edge [m].
        y_max: Upper edge [m].

    Raises:
        ValueError: If an edge is not finite or the box has no area.
    """

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    def __post_init__(self) -> None:
        if not all_finite((self.x_min, self.y_min, self.x_max, self.y_max)):
            raise ValueError(f"box must have finite edges, got {self}")
        keep(self, "x_min", "y_min", "x_max", "y_max")
        if self.x_min >= self.x_max or self.y_min >= self.y_max:
            raise ValueError(f"box must have x_min < x_max and y_min < y_max, got {self}")

    @property
    def bounds(self) -> Bounds:
        """The box itself [m]."""
        return Bounds(self.x_min, self.y_min, self.x_max, self.y_max)

    @property
    def area(self) -> float:
        """Area of the footprint [m²]."""
        return (self.x_max - self.x_min) * (self.y_max - self.y_min)


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder.

    Args:
        x: Center [m].
        y: Center [m].
        radius: Radius [m].

    Raises:
        ValueError: If a number is not finite or the radius is not positive.
    """

    x: float
    y: float
    radius: float

    def __post_init__(self) -> None:
        if not all_finite((self.x, self.y, self.radius)):
            raise ValueError(f"cylinder must have finite numbers, got {self}")
        keep(self, "x", "y", "radius")
        if self.radius <= 0:
            raise ValueError(f"cylinder must have a positive radius, got {self}")

    @property
    def bounds(self) -> Bounds:
        """The square around the footprint [m]."""
        x, y, radius = self.x, self.y, self.radius
        return Bounds(x - radius, y - radius, x + radius, y + radius)

    @property
    def area(self) -> float:
        """Area of the footprint [m²]."""
        return math.pi * self.radius**2


@dataclass(frozen=True)
class Polygon:
    """An upright prism; its footprint may have dents, but not cross or touch itself.

    Args:
        vertices: Corners (x, y) in order [m], 3 to 100 of them; given clockwise, they are
            kept counter-clockwise.

    Raises:
        ValueError: If a number is not finite, there are too few or too many vertices, or the
            outline has no area, or crosses or touches itself.

    Examples:
        >>> from mpfa_envs import Polygon
        >>> Polygon(((0, 0), (0, 1), (2, 0)))
        Polygon(vertices=((2.0, 0.0), (0.0, 1.0), (0.0, 0.0)))
    """

    vertices: tuple[Point, ...]

    def __post_init__(self) -> None:
        try:
            given = [tuple(vertex) for vertex in self.vertices]
        except TypeError:
            raise ValueError(f"polygon must have a list of vertices, got {self.vertices}") from None
        if not 3 <= len(given) <= MOST_VERTICES:
            raise ValueError(f"polygon must have 3 to {MOST_VERTICES} vertices, got {len(given)}")
        if not all(len(vertex) == 2 and all_finite(vertex) for vertex in given):
            raise ValueError(f"polygon must have two finite numbers a vertex, got {self.vertices}")
        vertices = tuple((float(x), float(y)) for x, y in given)
        area = _signed_area(vertices)
        # The dataclass is frozen; this is its only change, before it is used.
        object.__setattr__(self, "vertices", vertices if area > 0 else vertices[::-1])
        if area == 0.0 or not (_is_convex(self.vertices) or _is_simple(self.edges)):
            raise ValueError(
                "polygon must have an area, and an outline that does not cross or touch itself, "
                f"got {vertices}"
            )

    @property
    def edges(self) -> list[tuple[float, float, float, float]]:
        """Edges (x0, y0, x1, y1) [m], counter-clockwise: the inside is left of each."""
        following = (*self.vertices[1:], self.vertices[0])
        return [(*one, *other) for one, other in zip(self.vertices, following, strict=True)]

    @property
    def corners(self) -> list[tuple[Point, Point, Point]]:
        """Each vertex between the one before and the one after it [m]."""
        count = len(self.vertices)
        return [
            (self.vertices[i - 1], vertex, self.vertices[(i + 1) % count])
            for i, vertex in enumerate(self.vertices)
        ]

    @property
    def bounds(self) -> Bounds:
        """The smallest upright rectangle around the footprint [m]."""
        xs, ys = zip(*self.vertices, strict=True)
        return Bounds(min(xs), min(ys), max(xs), max(ys))

    @property
    def area(self) -> float:
        """Area of the footprint [m²]."""
        return _signed_area(self.vertices)

    @property
    def is_convex(self) -> bool:
        """True if the footprint has no dents."""
        return _is_convex(self.vertices)


Shape = Box | Cylinder | Polygon
"""Any obstacle but a map."""


def _signed_area(vertices: tuple[Point, ...]) -> float:
    """Area [m²]; positive if the vertices run counter-clockwise."""
    x, y = vertices[0]
    # From the first vertex, not from the origin: a small polygon far out keeps its digits.
    rays = [(a - x, b - y) for a, b in vertices[1:]]
    return sum(a * d - b * c for (a, b), (c, d) in pairwise(rays)) / 2


def _is_convex(vertices: tuple[Point, ...]) -> bool:
    """Return True if counter-clockwise vertices turn left everywhere, once around in all."""
    count, turned = len(vertices), 0.0
    for i in range(count):
        (x0, y0), (x1, y1), (x2, y2) = vertices[i - 2], vertices[i - 1], vertices[i]
        across = (x1 - x0) * (y2 - y1) - (y1 - y0) * (x2 - x1)
        along = (x1 - x0) * (x2 - x1) + (y1 - y0) * (y2 - y1)
        if across <= 0.0:
            return False
        turned += math.atan2(across, along)
    return turned < 3 * math.pi


def _is_simple(edges: list[tuple[float, float, float, float]]) -> bool:
    """Return True if edges meet only where one follows the other."""
    count = len(edges)
    for i, (ax, ay, bx, by) in enumerate(edges):
        if (ax, ay) == (bx, by):
            return False
        for j in range(i + 1, count):
            cx, cy, dx, dy = edges[j]
            if j == i + 1 or (i == 0 and j == count - 1):
                # Neighbors share a vertex; they overlap if one turns back on the other.
                across = (bx - ax) * (dy - cy) - (by - ay) * (dx - cx)
                if across == 0.0 and (bx - ax) * (dx - cx) + (by - ay) * (dy - cy) < 0.0:
                    return False
            elif _meet(edges[i], edges[j]):
                return False
    return True


def _meet(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    """Return True if two closed segments have a point in common."""
    ax, ay, bx, by = one
    cx, cy, dx, dy = other
    if (
        max(ax, bx) < min(cx, dx)
        or max(cx, dx) < min(ax, bx)
        or max(ay, by) < min(cy, dy)
        or max(cy, dy) < min(ay, by)
    ):
        return False
    c_side = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    d_side = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
    a_side = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
    b_side = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
    return c_side * d_side <= 0.0 and a_side * b_side <= 0.0


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
        >>> from mpfa_envs.worlds.shapes import OccupancyGrid
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
