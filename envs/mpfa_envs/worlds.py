"""A world: a rectangular room with boxes and cylinders on its floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_SIDE: Final = 1000.0
"""No room is wider or deeper than this [m]."""
MOST_OBSTACLES: Final = 200
"""No room has more obstacles: first paths among 200 take seconds, among 2,000 they take hours."""
_CHUNK: Final = 2_000_000
"""Distances between points and obstacles that are computed at once."""


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
        if not all(map(math.isfinite, (self.x_min, self.y_min, self.x_max, self.y_max))):
            raise ValueError(f"box must have finite edges, got {self}")
        if self.x_min >= self.x_max or self.y_min >= self.y_max:
            raise ValueError(f"box must have x_min < x_max and y_min < y_max, got {self}")

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
        if not all(map(math.isfinite, (self.x, self.y, self.radius))):
            raise ValueError(f"cylinder must have finite numbers, got {self}")
        if self.radius <= 0:
            raise ValueError(f"cylinder must have a positive radius, got {self}")

    @property
    def area(self) -> float:
        """Area of the footprint [m²]."""
        return math.pi * self.radius**2


@dataclass(frozen=True, kw_only=True)
class World:
    """A walled room around the origin, x to the right and y up, with obstacles.

    Args:
        name: What messages and pictures call it.
        size: Inner width and depth (x, y) [m], at most 1,000 each; the walls stand around it.
        boxes: Obstacles with straight sides.
        cylinders: Round obstacles; with the boxes at most 200.
        start_regions: Where an episode may start; empty: anywhere in the room.
        goal_regions: Where a goal may lie; empty: anywhere in the room.

    Raises:
        ValueError: If the size is out of its range, there are too many obstacles, or something does
            not lie in the room.

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
    start_regions: tuple[Box, ...] = ()
    goal_regions: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        if len(self.size) != 2 or not all(math.isfinite(side) and side > 0 for side in self.size):
            raise ValueError(f"size must be two positive lengths, got {self.size}")
        if max(self.size) > LARGEST_SIDE:
            raise ValueError(f"size must be at most {LARGEST_SIDE:g} m, got {self.size}")
        obstacles = len(self.boxes) + len(self.cylinders)
        if obstacles > MOST_OBSTACLES:
            raise ValueError(
                f"boxes and cylinders must be at most {MOST_OBSTACLES} in all, got {obstacles}"
            )
        for field in ("boxes", "start_regions", "goal_regions"):
            for box in getattr(self, field):
                if not self.holds(box):
                    raise ValueError(f"{field} must lie in the room {self.room}, got {box}")
        for cylinder in self.cylinders:
            if not self.holds(cylinder):
                raise ValueError(f"cylinders must lie in the room {self.room}, got {cylinder}")

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
    def covered_area(self) -> float:
        """Area under obstacles, overlaps counted twice [m²]."""
        boxes = sum(box.area for box in self.boxes)
        return boxes + sum(cylinder.area for cylinder in self.cylinders)

    def holds(self, shape: Box | Cylinder) -> bool:
        """Tell whether a shape lies in the room; it may touch the walls."""
        room = self.room
        if isinstance(shape, Cylinder):
            x, y, r = shape.x, shape.y, shape.radius
            return (
                room.x_min <= x - r
                and x + r <= room.x_max
                and room.y_min <= y - r
                and y + r <= room.y_max
            )
        return (
            room.x_min <= shape.x_min
            and shape.x_max <= room.x_max
            and room.y_min <= shape.y_min
            and shape.y_max <= room.y_max
        )

    @cached_property
    def _edges(self) -> tuple[tuple[float, float, float, float], ...]:
        """Edges of the boxes (x_min, y_min, x_max, y_max) [m]."""
        return tuple((box.x_min, box.y_min, box.x_max, box.y_max) for box in self.boxes)

    @cached_property
    def _cylinder_arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centers ``[2, cylinders]`` and radii ``[cylinders]`` [m]."""
        rows = np.array(
            [(cylinder.x, cylinder.y, cylinder.radius) for cylinder in self.cylinders],
            dtype=np.float64,
        ).reshape(-1, 3)
        return np.ascontiguousarray(rows[:, :2].T), np.ascontiguousarray(rows[:, 2])

    def clearance(self, x: float, y: float) -> float:
        """Measure the distance from a point to the nearest obstacle or wall.

        Args:
            x: Position [m].
            y: Position [m].

        Returns:
            Distance [m]; zero in a box, negative in a cylinder and behind a wall.
        """
        half_width, half_depth = self.size[0] / 2, self.size[1] / 2
        nearest = min(half_width - abs(x), half_depth - abs(y))
        # For a room's dozen boxes a plain loop takes a fifth of the time of NumPy calls.
        square = math.inf
        for x_min, y_min, x_max, y_max in self._edges:
            across = x_min - x if x < x_min else x - x_max if x > x_max else 0.0
            up = y_min - y if y < y_min else y - y_max if y > y_max else 0.0
            gap = across * across + up * up
            if gap < square:
                square = gap
        nearest = min(nearest, math.sqrt(square))
        if self.cylinders:
            centers, radii = self._cylinder_arrays
            nearest = min(nearest, float((np.hypot(*(centers - ((x,), (y,)))) - radii).min()))
        return nearest

    def clearances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measure the distance from many points to the nearest obstacle or wall.

        Args:
            points: Positions, shape ``[N, 2]`` [m].

        Returns:
            Distances, shape ``[N]`` [m], negative in an obstacle and behind a wall.
        """
        x, y = points[:, 0], points[:, 1]
        nearest = np.minimum(self.size[0] / 2 - np.abs(x), self.size[1] / 2 - np.abs(y))
        edges = np.array(self._edges).reshape(-1, 4).T
        (center_x, center_y), radii = self._cylinder_arrays
        rows = max(1, _CHUNK // max(1, len(self._edges) + len(radii)))
        for first in range(0, len(points), rows):
            part = slice(first, first + rows)
            px, py = x[part, None], y[part, None]
            # How far outside of each box; negative inside.
            across = np.maximum(edges[0] - px, px - edges[2])
            up = np.maximum(edges[1] - py, py - edges[3])
            outside = np.hypot(np.maximum(across, 0.0), np.maximum(up, 0.0))
            to_boxes = outside + np.minimum(np.maximum(across, up), 0.0)
            to_circles = np.hypot(center_x - px, center_y - py) - radii
            for gaps in (to_boxes, to_circles):
                if gaps.size:
                    nearest[part] = np.minimum(nearest[part], gaps.min(axis=1))
        return nearest
