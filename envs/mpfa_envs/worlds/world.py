"""A world: a rectangular room with obstacles on its floor and walkers; and a task in it."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import all_finite, check_positive, plain
from mpfa_envs.worlds.shapes import (
    LARGEST_SIDE,
    LONGEST_SIDE,
    MOST_CELLS,
    Box,
    Cylinder,
    OccupancyGrid,
    Point,
    Polygon,
    Shape,
)
from mpfa_envs.worlds.walker import MOST_WALKERS, Walker

__all__ = ["MOST_OBSTACLES", "Box", "Cylinder", "Polygon", "World", "WorldArrays"]

MOST_OBSTACLES: Final = 1000
"""Greatest number of obstacles in a room."""
_RESOLUTION: Final = 0.05
"""Side of a cell of the map of a world that has none [m]."""
_APART: Final = 0.05
"""Greatest distance between the points of a line whose clearance is measured [m]."""
_PARTS: Final[Mapping[str, type[Shape | Walker]]] = {
    "boxes": Box,
    "cylinders": Cylinder,
    "polygons": Polygon,
    "start_regions": Box,
    "goal_regions": Box,
    "walkers": Walker,
}
"""Types in the fields that are tuples."""


class WorldArrays(NamedTuple):
    """The numbers of a world in contiguous arrays of float64, for kernels."""

    half_size: NDArray[np.float64]
    """Half of the room's width and depth [m], shape ``[2]``."""
    boxes: NDArray[np.float64]
    """(x_min, y_min, x_max, y_max) [m], shape ``[boxes, 4]``."""
    circles: NDArray[np.float64]
    """(x, y, radius) [m], shape ``[cylinders, 3]``."""
    segments: NDArray[np.float64]
    """Edges of the polygons (x0, y0, x1, y1) [m], counter-clockwise, shape ``[edges, 4]``."""
    polygon_ends: NDArray[np.int64]
    """End of each polygon's edges in ``segments``, shape ``[polygons]``."""


@dataclass(frozen=True, kw_only=True)
class World:
    """A walled room around the origin, x to the right and y up, with obstacles.

    Args:
        name: Name in messages and pictures.
        size: Inner width and depth (x, y) [m], at most 1,000 each; the walls stand around it.
        boxes: Obstacles with sides parallel to the walls.
        cylinders: Round obstacles.
        polygons: Obstacles with straight sides in any direction. All obstacles may overlap; there
            are at most 1,000.
        start_regions: Where an episode may start; empty: anywhere in the room.
        goal_regions: Where a goal may lie; empty: anywhere in the room.
        walkers: Moving obstacles, at most 100; clearance, paths and tasks of a world do not count
            them.
        occupancy: Cells of a map, as large as the room, the occupied ones of which are obstacles
            too, any number of them.

    Raises:
        ValueError: If a field is of another kind, the size is out of its range, there are too many
            obstacles or walkers, or something does not lie in the room or a walker cannot go
            between its waypoints.

    Examples:
        >>> from mpfa_envs import Box, World
        >>> world = World(name="pillar", boxes=(Box(-0.5, -0.5, 0.5, 0.5),))
        >>> world.clearance(2.0, 0.0)  # [m]
        1.5
    """

    name: str
    size: tuple[float, float] = (10.0, 10.0)
    boxes: tuple[Box, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    polygons: tuple[Polygon, ...] = ()
    start_regions: tuple[Box, ...] = ()
    goal_regions: tuple[Box, ...] = ()
    walkers: tuple[Walker, ...] = ()
    occupancy: OccupancyGrid | None = None

    def __post_init__(self) -> None:
        self._check_kinds()
        if len(self.size) != 2 or not all(side > 0 for side in self.size):
            raise ValueError(f"size must be two positive lengths, got {self.size}")
        if max(self.size) > LARGEST_SIDE:
            raise ValueError(f"size must be at most {LARGEST_SIDE:g} m, got {self.size}")
        if self.obstacle_count > MOST_OBSTACLES:
            raise ValueError(
                f"boxes, cylinders and polygons must be at most {MOST_OBSTACLES} in all, got "
                f"{self.obstacle_count}"
            )
        for field in ("boxes", "cylinders", "polygons", "start_regions", "goal_regions"):
            for shape in getattr(self, field):
                if not self.holds(shape):
                    raise ValueError(f"{field} must lie in the room {self.room}, got {shape}")
        grid = self.occupancy
        if grid is not None and not np.allclose(grid.size, self.size, rtol=1e-9, atol=0.0):
            raise ValueError(f"size must be that of the occupancy, {grid.size}, got {self.size}")
        self._check_walkers()

    def _check_kinds(self) -> None:
        """Reject fields of other types, and turn lists into tuples, which can be hashed."""
        if not isinstance(self.name, str):
            raise ValueError(f"name must be text, got {self.name!r}")
        size = tuple(self.size) if isinstance(self.size, Iterable) else ()
        if not all_finite(size or (math.nan,)):
            raise ValueError(f"size must be two positive lengths, got {self.size}")
        # The dataclass is frozen; these are its only changes, before it is used.
        object.__setattr__(self, "size", tuple(map(plain, size)))
        for field, kind in _PARTS.items():
            given = getattr(self, field)
            parts = tuple(given) if isinstance(given, Iterable) else (given,)
            for part in parts:
                if not isinstance(part, kind) or part is given:
                    raise ValueError(f"{field} must be a tuple of {kind.__name__}, got {given!r}")
            object.__setattr__(self, field, parts)
        if not isinstance(self.occupancy, OccupancyGrid | None):
            raise ValueError(f"occupancy must be an OccupancyGrid, got {self.occupancy!r}")

    def _check_walkers(self) -> None:
        """Reject walkers that have no room."""
        if len(self.walkers) > MOST_WALKERS:
            raise ValueError(f"walkers must be at most {MOST_WALKERS}, got {len(self.walkers)}")
        for walker in self.walkers:
            if 2 * walker.radius >= min(self.size):
                raise ValueError(f"walkers must fit in the room {self.room}, got {walker}")
            for leg in walker.legs:
                if self.clearance_along(*leg) < walker.radius:
                    raise ValueError(
                        "walkers must keep their radius from obstacles and walls between their "
                        f"waypoints, which {walker} does not from {leg[0]} to {leg[1]}"
                    )

    @staticmethod
    def from_map(
        path: str | os.PathLike[str], *, unknown: Literal["occupied", "free"] = "occupied"
    ) -> World:
        """Read a map of ROS as a world, whose room is the known part of the map.

        The room ends one cell beyond the outermost free cells.

        Args:
            path: The YAML file; the path of the image in it is relative to its folder.
            unknown: Reading of unknown cells, ``"occupied"`` or ``"free"``.

        Returns:
            The world, with the name of the file. ``world.occupancy.center`` is the position of its
            (0, 0) on the map.

        Raises:
            WorldFileError: If a file cannot be read or is no map; the message names the line.
            ValueError: If unknown is neither.
        """
        # Imported here because it needs Pillow and PyYAML, and most worlds come from elsewhere.
        from mpfa_envs.worlds.ros_map import read_map

        path = Path(path)
        grid = read_map(path, unknown=unknown)
        return World(name=path.stem, size=grid.size, occupancy=grid)

    def to_map(self, path: str | os.PathLike[str], *, resolution: float | None = None) -> None:
        """Write the obstacles as a map for ROS's map_server.

        The cells of a map are written unchanged, and :meth:`from_map` reads an equal world. A cell
        of other worlds is occupied if its middle is within half a cell of an obstacle, and walls
        are one cell thick. Walkers and regions are left out.

        Args:
            path: The YAML file; an image with the ending .pgm is written next to it.
            resolution: Side of a cell [m]; None: that of the world's own map, or 0.05 m.

        Raises:
            ValueError: If the map would have too many cells, or the path does not end in .yaml.
        """
        from mpfa_envs.worlds.ros_map import write_map

        own = self.occupancy
        if own is not None and not self.obstacles and resolution in (None, own.resolution):
            grid = own
        else:
            grid = self._cells(resolution or (own.resolution if own else _RESOLUTION))
        write_map(grid, path)

    def _cells(self, resolution: float) -> OccupancyGrid:
        """Cover the room and its walls with cells, and find the occupied ones."""
        check_positive("resolution", resolution)
        sides = [int(np.ceil(round(side / resolution, 6))) + 2 for side in self.size]
        if sides[0] * sides[1] > MOST_CELLS or max(sides) > LONGEST_SIDE:
            raise ValueError(
                f"resolution must leave at most {MOST_CELLS} cells in {self.size} m, got "
                f"{resolution}"
            )
        xs, ys = (resolution * (np.arange(count) - (count - 1) / 2) for count in sides)
        points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
        near = self.clearances(points).reshape(sides[0], sides[1]) < resolution / 2 - 1e-9
        center = self.occupancy.center if self.occupancy else (0.0, 0.0)
        corner = tuple(at - side * resolution / 2 for at, side in zip(center, sides, strict=True))
        return OccupancyGrid(near, resolution, (corner[0], corner[1]))

    def __hash__(self) -> int:
        """Hash once: worlds are keys of caches and may have hundreds of obstacles."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Hash of all but the name."""
        regions = self.start_regions, self.goal_regions
        return hash((self.size, self.obstacles, *regions, self.walkers, self.occupancy))

    def __getstate__(self) -> dict[str, Any]:
        """Fields without the hash, which differs between processes."""
        return {name: value for name, value in self.__dict__.items() if name != "_hash"}

    def renamed(self, name: str) -> World:
        """Copy the world under another name, with all that has been computed of it."""
        world = copy.copy(self)
        # The dataclass is frozen; this is the copy's only change, before it is used.
        object.__setattr__(world, "name", name)
        return world

    @cached_property
    def room(self) -> Box:
        """The floor between the walls [m]."""
        width, depth = self.size
        return Box(-width / 2, -depth / 2, width / 2, depth / 2)

    @property
    def diagonal(self) -> float:
        """Longest distance in the room [m]."""
        return math.hypot(*self.size)

    @property
    def obstacles(self) -> tuple[Shape, ...]:
        """Boxes, cylinders and polygons, in this order."""
        return (*self.boxes, *self.cylinders, *self.polygons)

    @property
    def obstacle_count(self) -> int:
        """Number of obstacles."""
        return len(self.boxes) + len(self.cylinders) + len(self.polygons)

    @property
    def covered_area(self) -> float:
        """Area under obstacles, overlaps counted twice [m²]."""
        cells = 0.0 if self.occupancy is None else self.occupancy.area
        return sum(obstacle.area for obstacle in self.obstacles) + cells

    def holds(self, shape: Shape) -> bool:
        """Return True if a shape lies in the room; it may touch the walls."""
        left, low, right, high = self.room.bounds
        x_min, y_min, x_max, y_max = shape.bounds
        return left <= x_min and x_max <= right and low <= y_min and y_max <= high

    @cached_property
    def arrays(self) -> WorldArrays:
        """All numbers of the world in arrays, for kernels."""
        boxes = [box.bounds for box in self.boxes]
        circles = [(cylinder.x, cylinder.y, cylinder.radius) for cylinder in self.cylinders]
        edges = [edge for polygon in self.polygons for edge in polygon.edges]
        counts = [len(polygon.vertices) for polygon in self.polygons]
        return WorldArrays(
            np.array(self.size, dtype=np.float64) / 2,
            np.array(boxes, dtype=np.float64).reshape(-1, 4),
            np.array(circles, dtype=np.float64).reshape(-1, 3),
            np.array(edges, dtype=np.float64).reshape(-1, 4),
            np.cumsum(counts, dtype=np.int64),
        )

    def clearance(self, x: float, y: float) -> float:
        """Measure the distance from a point to the nearest obstacle or wall.

        Args:
            x: Position [m].
            y: Position [m].

        Returns:
            Distance [m]; zero in a box or an occupied cell, negative in a cylinder, in a polygon
            and behind a wall.
        """
        # Imported here, and below, because they need Numba, which takes half a second.
        from mpfa_envs.worlds.arrays import clearance_of_cells, clearance_of_shapes

        x, y = float(x), float(y)
        nearest = clearance_of_shapes(*self.arrays, x, y)
        if self.occupancy is not None:
            left, right, _ = self.occupancy.arrays
            nearest = clearance_of_cells(left, right, self.occupancy.resolution, x, y, nearest)
        return nearest

    def clearances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measure the distance from many points to the nearest obstacle or wall.

        Args:
            points: Positions, shape ``[N, 2]`` [m].

        Returns:
            Distances, shape ``[N]`` [m], negative in an obstacle and behind a wall; zero in an
            occupied cell.
        """
        from mpfa_envs.worlds.arrays import clearances_of_cells, clearances_of_shapes

        points = np.ascontiguousarray(points, dtype=np.float64)
        nearest = clearances_of_shapes(*self.arrays, points)
        if self.occupancy is not None:
            left, right, _ = self.occupancy.arrays
            clearances_of_cells(left, right, self.occupancy.resolution, points, nearest)
        return nearest

    def clearance_along(self, start: Point, end: Point) -> float:
        """Measure the least clearance on the line between two points.

        Args:
            start: Position (x, y) [m].
            end: Position (x, y) [m].

        Returns:
            Distance [m], the least of places 0.05 m apart.
        """
        steps = math.ceil(math.dist(start, end) / _APART) + 1
        return float(self.clearances(np.linspace(start, end, steps)).min())


START_SLACK = 0.15
"""Clearance of a start beyond that of a collision [m]."""


class Task(NamedTuple):
    """One episode to drive; ``task._asdict()`` is what ``reset(options=...)`` takes."""

    start: tuple[float, float, float]
    """Pose (x, y, heading) [m, m, rad]."""
    goal: tuple[float, float]
    """Position (x, y) [m]."""
