"""A planar lidar that is computed exactly from the shapes of the world.

The rays are intersected with boxes, circles and segments in closed form. It replaces PyBullet's ray
test in both kinds of physics: for 54 rays it is many times faster
(``benchmarks/speed/environment.py``), and a test holds the two to the same answers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from mpfa_envs.checks import (
    check_choice,
    check_count,
    check_not_negative,
    check_number,
    check_positive,
    check_share,
)
from mpfa_envs.sensing.lidar_loops import cast_rays
from mpfa_envs.sensing.observation import sector_ranges
from mpfa_envs.worlds.batch import WorldBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.arrays import BatchArrays
    from mpfa_envs.worlds.world import World

Reduction = Literal["min", "median", "single"]
"""The range of a sector: its nearest ray, the median, or its only one."""


def ray_angles(field_of_view: float, rays: int) -> NDArray[np.float64]:
    """Directions of the rays of a field of view [deg], left to right [rad], ``[rays]``."""
    return math.radians(field_of_view) * (0.5 - (np.arange(rays) + 0.5) / rays)


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
            default is a side of the built-in worlds.
        noise: Standard deviation of Gaussian noise on each ray [m].
        field_of_view: Angle from the first edge of the first sector to the last of the last one
            [deg], at most 360: of sectors of 10 degrees a whole turn has 36.
        dropout: Chance that a ray reports the greatest range.
        mount: Position (x, y) of the sensor in the robot's frame, where rays begin [m].

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
        mount: tuple[float, ...] = (0.0, 0.0),
    ) -> None:
        self.sectors = check_count("sectors", sectors)
        count = check_count("rays_per_sector", rays_per_sector)
        self.rays_per_sector = 1 if reduction == "single" else count
        self.reduction: Reduction = check_choice("reduction", reduction, Reduction)
        self.max_range = check_positive("max_range", max_range)
        self.noise = check_not_negative("noise", noise)
        self.field_of_view = check_positive("field_of_view", field_of_view)
        self.dropout = check_share("dropout", dropout)
        self.mount = check_number("mount", mount[0]), check_number("mount", mount[1])
        rays = check_count("sectors * rays_per_sector", self.sectors * self.rays_per_sector)
        self.angles = ray_angles(self.field_of_view, rays)
        """Direction of each ray in the robot's frame, left to right [rad], shape ``[rays]``."""
        self._directions = np.stack((np.cos(self.angles), np.sin(self.angles)))
        self._world = WorldBatch([replace(world, walkers=())])

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
            x: Position of the robot's center [m].
            y: Position of the robot's center [m].
            heading: Direction of the robot's front [rad].
            moving: Circles (x, y, radius) that are not of the world [m], shape ``[K, 3]``.

        Returns:
            Range of each ray [m], shape ``[rays]``; zero in an obstacle.
        """
        worlds = self._world.arrays
        if moving is not None and len(moving):
            standing = worlds.circles[:, : worlds.counts[0, 1]]
            worlds = worlds._replace(
                circles=np.concatenate((standing, moving[None]), axis=1),
                counts=np.add(worlds.counts, (0, len(moving), 0, 0)),
            )
        ranges = np.empty((1, self.angles.size))
        self.cast_all(
            np.array([[x, y, heading]], float), np.ones(1, dtype=np.bool_), worlds, ranges
        )
        return ranges[0]

    def cast_all(
        self,
        motions: NDArray[np.float64],
        chosen: NDArray[np.bool_],
        worlds: BatchArrays,
        ranges: NDArray[np.float64],
    ) -> None:
        """Measure every ray of many robots, without noise.

        Args:
            motions: Poses (x, y, heading) in the first three columns [m, m, rad], ``[N, 5]``.
            chosen: Which robots look around, ``[N]``; the others' ranges stay.
            worlds: That of each robot.
            ranges: Where the ranges go [m], ``[N, rays]``; zero in an obstacle.
        """
        view, motions = math.radians(self.field_of_view), self.sensor_motions(motions)
        cast_rays(motions, chosen, worlds, self._directions, view, self.max_range, ranges)

    def sensor_motions(self, motions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the poses of all sensors, in the first three columns as those of robots."""
        x, y = self.mount
        if not (x or y):
            return motions
        sensors, cosine, sine = motions.copy(), np.cos(motions[:, 2]), np.sin(motions[:, 2])
        sensors[:, 0] += x * cosine - y * sine
        sensors[:, 1] += x * sine + y * cosine
        return sensors

    def around_center(
        self, ranges: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angles [rad] and distances [m] of the ends of rays, ``[rays]``, from the center."""
        x, y = self.mount
        if not (x or y):
            return self.angles, ranges
        across, up = self._directions * ranges
        return np.arctan2(y + up, x + across), np.hypot(x + across, y + up)

    def scan(
        self, x: float, y: float, heading: float, *, rng: np.random.Generator | None = None
    ) -> NDArray[np.float64]:
        """Measure the range of every sector.

        Args:
            x: Position of the robot's center [m].
            y: Position of the robot's center [m].
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
            x: Position of the robot's center [m].
            y: Position of the robot's center [m].
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
        """True if two scans from one place differ."""
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
        return sector_ranges(ranges, self.sectors, self.reduction == "median")
