"""From a laser scan of any field of view and resolution to the sectors that a policy senses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np

from mpfa_envs.checks import check_positive
from mpfa_envs.deploy.card import check_finite

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from mpfa_envs.deploy.card import Card

Silent = Literal["refuse", "far"]
"""What to make of a sector whose rays have all measured nothing valid."""
_EDGE = 1e-4
"""By how much the outermost rays may miss the field of view: messages are rounded [rad]."""


class ScanError(ValueError):
    """A scan does not tell what the policy must know; the message says what is missing."""


class Scan(NamedTuple):
    """What a planar lidar has measured, as ``sensor_msgs/LaserScan`` puts it.

    A range of ``range_max`` or more, infinity too, has met nothing. One below ``range_min``, and
    NaN, is not valid.
    """

    angle_min: float
    """Direction of the first ray, from the sensor's x axis to the left [rad]."""
    angle_increment: float
    """From ray to ray; negative for a sensor that turns to the right [rad]."""
    ranges: ArrayLike
    """Shape ``[R]`` [m]."""
    range_min: float = 0.0
    """The least valid range [m]."""
    range_max: float = math.inf
    """The range up to which it sees [m]."""


class Points(NamedTuple):
    """What was measured in the policy's field of view, around the robot's center."""

    angles: NDArray[np.float64]
    """Directions in the robot's frame, in [-π, π] [rad], ``[P]``."""
    ranges: NDArray[np.float64]
    """Distances from the robot's center [m], ``[P]``; the card's ``max_range`` where nothing was
    met."""


class Sectors:
    """Reads scans as a policy does.

    All valid rays of a sector count, whatever their number: with ``min`` the nearest return,
    with ``median`` the median, with ``single`` the ray nearest to the middle. A sector between two
    rays of a coarse scan has the nearer one.

    Args:
        card: Of the policy.
        mount: Position (x, y) of the sensor and direction of its x axis in the robot's frame
            [m, m, rad].
        unseen: Range to report for sectors outside of the scan's field of view [m]; None refuses
            such a scan.
        silent: What to do where no ray of a sector is valid: ``"refuse"`` the scan, or hold that
            nothing is there, ``"far"``, for a lidar that reports 0 or NaN for it. A scan without
            any valid ray is refused in both.

    Raises:
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        card: Card,
        *,
        mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
        unseen: float | None = None,
        silent: Silent = "refuse",
    ) -> None:
        if silent not in get_args(Silent):
            raise ValueError(f"silent must be one of {get_args(Silent)}, got {silent!r}")
        self.card = card
        self.mount = check_finite("mount", mount, 3)
        self.unseen = None if unseen is None else check_positive("unseen", unseen)
        self.silent = silent
        self._edge = 0.5 * math.radians(card.field_of_view)
        width = 2.0 * self._edge / card.sectors
        self._width = width
        self._middles = self._edge - width * (np.arange(card.sectors) + 0.5)

    def read(self, scan: Scan) -> tuple[NDArray[np.float64], Points]:
        """Read a scan.

        Args:
            scan: What the lidar has measured.

        Returns:
            Range of each sector, left to right [m], ``[sectors]``, and the points in view.

        Raises:
            ScanError: If it is no scan, or does not tell the range of every sector.
        """
        directions, points = self._measured(scan)
        card = self.card
        sector = self._index(points.angles)
        key = points.ranges
        if card.reduction == "single":
            key = np.abs(points.angles - self._middles[sector])
        order = np.lexsort((key, sector))
        first = np.searchsorted(sector[order], np.arange(card.sectors + 1))
        counts, ordered = np.diff(first), points.ranges[order]
        ranges = np.full(card.sectors, card.max_range)
        full = counts > 0
        start = first[:-1][full]
        if card.reduction == "median":
            # The two in the middle, which are one and the same where the count is odd.
            low, high = (counts[full] - 1) // 2, counts[full] // 2
            ranges[full] = (ordered[start + low] + ordered[start + high]) / 2
        else:
            ranges[full] = ordered[start]
        for index in np.flatnonzero(~full).tolist():
            ranges[index] = self._beside(index, scan, directions, points)
        return ranges, points

    def _index(self, angles: NDArray[np.float64]) -> NDArray[np.int64]:
        """Number of the sector of each angle in view."""
        index = ((self._edge - angles) / self._width).astype(np.int64)
        return np.clip(index, 0, self.card.sectors - 1)

    def _measured(self, scan: Scan) -> tuple[NDArray[np.float64], Points]:
        """Directions of all rays in the robot's frame, ``[R]``, and the points in view."""
        ranges = np.asarray(scan.ranges, dtype=np.float64)
        start, step = scan.angle_min, scan.angle_increment
        if ranges.ndim != 1 or not ranges.size:
            raise ScanError(f"ranges must have shape [R], got {ranges.shape}")
        if not (math.isfinite(start) and math.isfinite(step) and step):
            raise ScanError(f"a scan needs a first angle and a step, got {start} and {step}")
        across, up, turn = self.mount
        directions = _wrapped(start + turn + step * np.arange(ranges.size, dtype=np.float64))
        far = self.card.max_range
        missed = ranges >= scan.range_max
        valid = missed | (ranges >= scan.range_min) & (ranges >= 0.0)
        # A lidar that is broken is not one that meets nothing, whatever that reports.
        if not valid.any():
            raise ScanError(f"none of the scan's {ranges.size} rays is valid")
        angles, distances = directions, np.where(missed, far, ranges)
        if across or up:
            met_x = across + distances * np.cos(directions)
            met_y = up + distances * np.sin(directions)
            # What met nothing is too far away to be seen in another direction from the center.
            angles = np.where(missed, directions, np.arctan2(met_y, met_x))
            distances = np.where(missed, far, np.hypot(met_x, met_y))
        with np.errstate(invalid="ignore"):
            front = valid & (np.abs(angles) <= self._edge + _EDGE)
        return directions, Points(angles[front], np.minimum(distances[front], far))

    def _beside(
        self, index: int, scan: Scan, directions: NDArray[np.float64], points: Points
    ) -> float:
        """Range of a sector in which no valid ray lies [m]."""
        middle, half = float(self._middles[index]), 0.5 * self._width
        off = np.abs(_wrapped(directions - middle))
        # A sensor that is not at the center sees near points in other directions.
        reach = half + abs(scan.angle_increment)
        degrees = round(math.degrees(middle))
        if off.min() > reach + _EDGE:
            if self.unseen is None:
                raise ScanError(f"the scan does not reach the sector at {degrees} degrees")
            return min(self.unseen, self.card.max_range)
        inside = bool((self._index(directions[off <= half + _EDGE]) == index).any())
        shifted = bool(self.mount[0] or self.mount[1])
        if points.angles.size and (shifted or not inside):
            beside = np.abs(_wrapped(points.angles - middle))
            nearest = int(beside.argmin())
            if beside[nearest] <= reach + shifted * half + _EDGE:
                return float(points.ranges[nearest])
        if self.silent == "refuse":
            raise ScanError(f"no ray of the sector at {degrees} degrees is valid")
        return self.card.max_range


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-π, π) [rad]."""
    found: NDArray[np.float64] = (angles + math.pi) % (2.0 * math.pi) - math.pi
    return found
