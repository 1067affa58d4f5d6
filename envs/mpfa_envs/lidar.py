"""A planar lidar that is computed exactly from the shapes of the world.

The rays are intersected with boxes, circles and segments in closed form, vectorized over rays and
shapes. It replaces PyBullet's ray test in both kinds of physics: for 54 rays it is several times
faster (``benchmarks/environment.py``), and a test holds the two to the same answers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from mpfa_envs.checks import check_count, check_number, check_positive, check_share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.occupancy import OccupancyGrid
    from mpfa_envs.worlds import World

Reduction = Literal["min", "median", "single"]
"""How the rays of a sector become one range."""


class Lidar:
    """Ranges over a field of view that the robot's front halves, left to right, one per sector.

    Args:
        world: What the rays hit.
        sectors: Number of equal sectors of the field of view.
        rays_per_sector: Rays in each sector, at the middles of its equal parts. One each, as the
            paper may have it, leaves gaps of 10 degrees, 17 cm at 1 m, that hide a table leg.
        reduction: ``"min"`` reports the nearest return of a sector, ``"median"`` the median, and
            ``"single"`` casts only the ray through the middle of the sector.
        max_range: A ray that meets nothing within this distance reports this distance [m]. The
            default is a side of the built-in rooms.
        noise: Standard deviation of Gaussian noise on each ray [m].
        field_of_view: Angle from the first edge of the first sector to the last of the last one
            [deg], at most 360: of sectors of 10 degrees a whole turn has 36.
        dropout: Chance that a ray reports the greatest range, whatever it meets.

    Raises:
        ValueError: If a number is out of its range or the reduction is unknown.

    Examples:
        >>> from mpfa_envs import WORLDS, Lidar
        >>> lidar = Lidar(WORLDS["A"], sectors=3, reduction="single")
        >>> lidar.scan(0.0, 0.0, 0.0).round(3)  # [m], at 60, 0 and -60 degrees
        array([5.774, 5.   , 5.774])
    """

    def __init__(
        self,
        world: World,
        *,
        sectors: int = 18,
        rays_per_sector: int = 3,
        reduction: Reduction = "min",
        max_range: float = 10.0,
        noise: float = 0.0,
        field_of_view: float = 180.0,
        dropout: float = 0.0,
    ) -> None:
        if reduction not in get_args(Reduction):
            raise ValueError(f"reduction must be one of {get_args(Reduction)}, got {reduction!r}")
        self.sectors = check_count("sectors", sectors)
        count = check_count("rays_per_sector", rays_per_sector)
        self.rays_per_sector = 1 if reduction == "single" else count
        self.reduction = reduction
        self.max_range = check_positive("max_range", max_range)
        self.noise = check_number("noise", noise)
        if self.noise < 0:
            raise ValueError(f"noise must not be negative, got {noise}")
        self.field_of_view = check_positive("field_of_view", field_of_view)
        if self.field_of_view > 360.0:
            raise ValueError(f"field_of_view must be at most 360 degrees, got {field_of_view}")
        self.dropout = check_share("dropout", dropout)
        rays = check_count("sectors * rays_per_sector", self.sectors * self.rays_per_sector)
        self.angles = math.radians(self.field_of_view) * (0.5 - (np.arange(rays) + 0.5) / rays)
        """Direction of each ray in the robot's frame, left to right [rad], shape ``[rays]``."""
        room = world.room
        shapes = [*world.boxes, room]
        # [side, axis, shape, ray]; the room is the last shape.
        self._bounds = np.array(
            [
                [[shape.x_min for shape in shapes], [shape.y_min for shape in shapes]],
                [[shape.x_max for shape in shapes], [shape.y_max for shape in shapes]],
            ]
        )[..., None]
        self._circles: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        if world.cylinders:
            centers = np.array([(c.x, c.y) for c in world.cylinders]).T[..., None]
            self._circles = centers, np.array([c.radius for c in world.cylinders])[:, None] ** 2
        self._polygons = world if world.polygons else None
        self._occupancy = world.occupancy
        count = len(shapes)
        # Buffers: allocating them anew would cost as much as the arithmetic.
        self._origin = np.empty((2, 1, 1))
        self._directions = np.empty((2, 1, rays))
        self._inverse = np.empty((2, 1, rays))
        self._offsets = np.empty_like(self._bounds)
        self._slabs = np.empty((2, 2, count, rays))
        self._near = np.empty((2, count, rays))
        self._far = np.empty((2, count, rays))
        self._enter = np.empty((count, rays))
        self._leave = np.empty((count, rays))
        self._missed = np.empty((count, rays), dtype=np.bool_)

    def cast(
        self,
        x: float,
        y: float,
        heading: float,
        *,
        moving: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Measure every ray without noise.

        Args:
            x: Position of the sensor [m].
            y: Position of the sensor [m].
            heading: Direction of the robot's front [rad].
            moving: Circles (x, y, radius) that are not of the world [m], shape ``[K, 3]``.

        Returns:
            Range of each ray [m], shape ``[rays]``; zero in an obstacle.
        """
        directions, enter, leave = self._directions, self._enter, self._leave
        origin = self._origin
        origin[0], origin[1] = x, y
        angles = self.angles + heading
        np.cos(angles, out=directions[0, 0])
        np.sin(angles, out=directions[1, 0])
        # A ray parallel to a wall: the tiny number turns 0 / 0 into 0 and changes no other value.
        directions += 1e-300
        np.divide(1.0, directions, out=self._inverse)
        np.subtract(self._bounds, origin, out=self._offsets)
        slabs = np.multiply(self._offsets, self._inverse, out=self._slabs)
        near = np.minimum(slabs[0], slabs[1], out=self._near)
        far = np.maximum(slabs[0], slabs[1], out=self._far)
        np.maximum(near[0], near[1], out=enter)
        np.minimum(far[0], far[1], out=leave)
        np.maximum(enter, 0.0, out=enter)
        np.greater(enter, leave, out=self._missed)
        np.copyto(enter, self.max_range, where=self._missed)
        # One is inside the room: its walls are met where the ray leaves it.
        enter[-1] = leave[-1]
        ranges: NDArray[np.float64] = enter.min(axis=0)
        if self._circles is not None:
            np.minimum(ranges, self._cast_at_circles(*self._circles), out=ranges)
        if moving is not None and len(moving):
            centers, squares = moving[:, :2].T[..., None], moving[:, 2:] ** 2
            np.minimum(ranges, self._cast_at_circles(centers, squares), out=ranges)
        if self._polygons is not None:
            np.minimum(ranges, self._cast_at_polygons(self._polygons), out=ranges)
        if self._occupancy is not None:
            self._cast_at_cells(self._occupancy, ranges)
        np.maximum(ranges, 0.0, out=ranges)
        return np.minimum(ranges, self.max_range, out=ranges)

    def _cast_at_circles(
        self, centers: NDArray[np.float64], squares: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Range of each ray to the nearest circle [m], shape ``[rays]``; infinite without one."""
        offsets = centers - self._origin
        along = (offsets * self._directions).sum(axis=0)
        half = along**2 + squares - (offsets * offsets).sum(axis=0)
        root = np.sqrt(np.maximum(half, 0.0))
        ranges = np.maximum(along - root, 0.0)
        ranges[(half < 0.0) | (along + root < 0.0)] = math.inf
        return np.asarray(ranges.min(axis=0))

    def _cast_at_polygons(self, world: World) -> NDArray[np.float64]:
        """Range of each ray to the nearest polygon [m], shape ``[rays]``; infinite without one."""
        if world.inside_polygons(self._origin.reshape(1, 2)).any():
            return np.zeros(len(self.angles))
        x0, y0, x1, y1 = world.arrays.segments.T[..., None]
        (x, y), (ray_x, ray_y) = self._origin, self._directions
        edge_x, edge_y, off_x, off_y = x1 - x0, y1 - y0, x0 - x, y0 - y
        # origin + t * ray = start + s * edge, solved by Cramer's rule; [edge, ray].
        turn = ray_x * edge_y - ray_y * edge_x
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = (off_x * edge_y - off_y * edge_x) / turn
            share = (off_x * ray_y - off_y * ray_x) / turn
        # A ray along an edge has no solution; the edges that it meets at the ends have one.
        ranges[~((share >= 0.0) & (share <= 1.0) & (ranges >= 0.0))] = math.inf
        return np.asarray(ranges.min(axis=0))

    def _cast_at_cells(self, grid: OccupancyGrid, ranges: NDArray[np.float64]) -> None:
        """Lower the range of each ray ``[rays]`` to that of the nearest occupied cell [m]."""
        # Imported here because it needs Numba, which takes half a second.
        from mpfa_envs.kernels.cells import cast_at_cells

        x, y = self._origin[:, 0, 0].tolist()
        beams = np.concatenate((self._directions[:, 0], self._inverse[:, 0]))
        if cast_at_cells(x, y, beams, grid.arrays.gaps, grid.resolution, self.max_range, ranges):
            ranges[:] = 0.0

    def scan(
        self, x: float, y: float, heading: float, *, rng: np.random.Generator | None = None
    ) -> NDArray[np.float64]:
        """Measure the range of every sector.

        Args:
            x: Position of the sensor [m].
            y: Position of the sensor [m].
            heading: Direction of the robot's front [rad].
            rng: Source of the noise; needed only if there is noise.

        Returns:
            Range of each sector, left to right [m], shape ``[sectors]``.

        Raises:
            ValueError: If there is noise and no generator.
        """
        return self.reduce(self.measure(x, y, heading, rng=rng))

    def measure(
        self,
        x: float,
        y: float,
        heading: float,
        *,
        rng: np.random.Generator | None = None,
        moving: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Measure the range of every ray, with noise.

        Args:
            x: Position of the sensor [m].
            y: Position of the sensor [m].
            heading: Direction of the robot's front [rad].
            rng: Source of the noise; needed only if there is noise.
            moving: As in :meth:`cast`.

        Returns:
            Range of each ray, left to right [m], shape ``[rays]``.

        Raises:
            ValueError: If there is noise and no generator.
        """
        ranges = self.cast(x, y, heading, moving=moving)
        if self.is_noisy:
            if rng is None:
                raise ValueError(f"rng must be a Generator when noise is {self.noise}, got None")
            self.disturb(ranges, rng)
        return ranges

    @property
    def is_noisy(self) -> bool:
        """Whether two scans from one place differ."""
        return self.noise > 0.0 or self.dropout > 0.0

    def disturb(self, ranges: NDArray[np.float64], rng: np.random.Generator) -> None:
        """Add the noise to a scan, and let rays drop out.

        A ray that meets nothing has no range to be wrong about: it stays at the maximum.

        Args:
            ranges: Range of each ray, changed in place [m], shape ``[rays]``.
            rng: Source of the noise.
        """
        if self.noise > 0.0:
            missed = ranges >= self.max_range
            ranges += self.noise * rng.standard_normal(ranges.size)
            np.clip(ranges, 0.0, self.max_range, out=ranges)
            ranges[missed] = self.max_range
        if self.dropout > 0.0:
            ranges[rng.random(ranges.size) < self.dropout] = self.max_range

    def reduce(self, ranges: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give the range of every sector.

        Args:
            ranges: Range of each ray [m], shape ``[rays]``.

        Returns:
            Range of each sector [m], shape ``[sectors]``.
        """
        if self.rays_per_sector == 1:
            return ranges
        rays = ranges.reshape(self.sectors, self.rays_per_sector)
        if self.reduction == "min":
            return np.asarray(rays.min(axis=1))
        # np.median costs as much as the whole scan.
        rays = np.sort(rays, axis=1)
        middle = self.rays_per_sector // 2
        if self.rays_per_sector % 2:
            return rays[:, middle].copy()
        return np.asarray((rays[:, middle - 1] + rays[:, middle]) / 2)
