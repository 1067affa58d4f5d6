"""From a laser scan of any field of view and resolution to the sectors that a policy senses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from mpfa_envs.checks import MEANT, check_choice, check_positive
from mpfa_envs.robots.model import check_mount
from mpfa_envs.sensing.observation import lidar_pose, look_from, observe_all
from mpfa_envs.sensing.scan import Scan, ScanError, in_numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card

Silent = Literal["reject", "far"]
"""Reading of a sector without a valid ray: the scan is rejected, or nothing is there."""
_EDGE = 1e-4
"""By how much the outermost rays may miss the field of view: messages are rounded [rad]."""
_OFF = 1.5
"""Increments by which ``angle_max`` may miss the last ray: some drivers count one more."""
_NEAR = 0.08
"""Returns up to this beyond the least valid range may be too near for the next scan [m]."""
_AROUND = np.radians(np.arange(-177.5, 180.0, 5.0))
"""Directions in which a scan is asked for rays [rad]."""
_HIDDEN = math.radians(2.5)
"""Angle at a side of a sector that may be hidden while the sector counts as seen [rad]."""
_INSIDE = 0.03
"""Rays that end so far within the robot's radius are not noise of an obstacle at its rim [m]."""
_SUDDEN = 0.8
"""What is nearer than this share of the greatest range does not leave it from scan to scan."""
_FARTHEST = MEANT["max_range"][1], 1e5
"""No planar lidar sees farther than the first [m]; drivers that write infinity as a number write
more than the second."""
_TURNS = 1.05
"""Turns that the rays may cover: those of some drivers overlap a little."""


class _Rays(NamedTuple):
    """The rays of a scan, from the sensor but in directions of the robot's frame."""

    directions: NDArray[np.float64]
    """Directions in [-π, π) [rad], ``[R]``."""
    valid: NDArray[np.bool_]
    """True if they have measured something, ``[R]``."""
    step: float
    """Angle from ray to ray [rad]."""
    middle: float
    """Middle of the angle that they cover [rad]."""
    ends: tuple[float, float]
    """Directions, from there, where it ends, as they are from the place of the sectors [rad]."""

    def cover(self, angles: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True for directions between the outermost rays."""
        right, left = self.ends
        off = _wrapped(angles - self.middle)
        return np.asarray((off >= right - _EDGE) & (off <= left + _EDGE))


class Points(NamedTuple):
    """Measured points around the robot's center."""

    angles: NDArray[np.float64]
    """Directions in the robot's frame, in [-π, π] [rad], ``[P]``."""
    ranges: NDArray[np.float64]
    """Distances from the robot's center [m], ``[P]``; the card's ``max_range`` where nothing was
    met."""
    sensor: tuple[float, float] = (0.0, 0.0)
    """Place of the sensor (x, y) in the robot's frame [m]."""
    reach: float = math.inf
    """How far a ray that met nothing has looked [m]."""


class Sectors:
    """Reads scans as a policy does.

    The sectors are around the place of the lidar that the policy learned with, the ``lidar_mount``
    of its robot. All valid rays of a sector count: with ``min`` the nearest return,
    with ``median`` the median, with ``single`` the ray nearest to the middle. A sector between two
    rays of a coarse scan has the nearer one. To the policy, what is too near to be measured is at
    the scan's ``range_min``; for whether the robot may drive, :meth:`around`, it is at 0 m.

    Args:
        card: Of the policy.
        mount: Position (x, y) of the sensor and direction of its x axis in the robot's frame
            [m, m, rad], and its roll around that axis, if it has one: 0, or ±π upside down [rad].
        unseen: Range to report to the policy for sectors outside of the scan's field of view, as it
            is from there [m]; None rejects such a scan.
        silent: Reading of a sector without a valid ray: ``"reject"`` rejects the scan, ``"far"``
            holds that nothing is there, for a lidar that reports 0 or NaN for it. As such a lidar
            may report the same for what is too near, a return within 0.08 m of ``range_min`` then
            stays where it was until its ray is valid again. A scan without any valid ray is a hall
            wider than the lidar sees, unless the scan before met something well within its range.
        radius: Of the robot that carries the sensor, which is within it [m]; None: that of the
            robot in training.

    Raises:
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        card: Card,
        *,
        mount: tuple[float, ...] = (0.0, 0.0, 0.0),
        unseen: float | None = None,
        silent: Silent = "reject",
        radius: float | None = None,
    ) -> None:
        self.card = card
        self._rim = card.robot.radius if radius is None else check_positive("radius", radius)
        self.mount_at(mount)
        self.unseen = None if unseen is None else check_positive("unseen", unseen)
        self.silent: Silent = check_choice("silent", silent, Silent)
        self._edge = 0.5 * math.radians(card.field_of_view)
        width = 2.0 * self._edge / card.sectors
        self._width = width
        self._middles = self._edge - width * (np.arange(card.sectors) + 0.5)
        self._near: tuple[NDArray[np.float64], NDArray[np.float64]] = np.empty(0), np.empty(0)
        self._met = False

    def mount_at(self, mount: tuple[float, ...]) -> None:
        """Change the position of the sensor; arguments and errors as for the class."""
        *place, roll = (*check_mount("mount", mount, self._rim), 0.0)[:4]
        self.mount = tuple(place)
        self._side = 1.0 if abs(roll) < 1.0 else -1.0

    def read(self, scan: Scan) -> tuple[NDArray[np.float64], Points]:
        """Read a scan.

        Args:
            scan: What the lidar has measured.

        Returns:
            Range of each sector, left to right [m], ``[sectors]``, and the points in view.

        Raises:
            ScanError: If it is no scan, or lacks the range of a sector.
        """
        rays, around, points, _ = self._measured(scan)
        card = self.card
        view = np.abs(points.angles) <= self._edge + _EDGE
        around = around._replace(angles=around.angles[view], ranges=around.ranges[view])
        points = Points(points.angles[view], points.ranges[view])
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
            ranges[index] = self._beside(index, rays, points)
        return ranges, around

    def around(self, scan: Scan) -> Points:
        """Read a scan for whether a robot may drive on.

        Args:
            scan: What the lidar has measured.

        Returns:
            Points in all directions, in the policy's field of view or not: 0 m for an obstacle
            nearer than ``range_min``, and NaN for a ray that is not valid.

        Raises:
            ScanError: If it is no scan.
        """
        rays, points, _, distances = self._measured(scan)
        silent = rays.directions[~rays.valid]
        ranges = np.where(distances <= scan.range_min, 0.0, points.ranges)
        return Points(
            np.concatenate((points.angles, silent)),
            np.concatenate((ranges, np.full(silent.size, math.nan))),
        )

    def inside(self, scan: Scan) -> tuple[float, float] | None:
        """Find the ray that ends deepest inside the robot, which is no obstacle then.

        Args:
            scan: What the lidar has measured.

        Returns:
            Direction of the ray in the scan [rad], and how far within the robot's radius it ends
            [m]; None if none ends more than 3 cm within it.
        """
        rays, points, _, _ = self._measured(scan)
        measured = np.flatnonzero(rays.valid)
        depths = self._rim - points.ranges[: measured.size]
        if not measured.size or depths.max() <= _INSIDE:
            return None
        ray = int(measured[depths.argmax()])
        return float(scan.angle_min + ray * scan.angle_increment), float(depths.max())

    def blind(
        self, scan: Scan, turns: Sequence[float] | NDArray[np.float64] = (0.0,)
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Find the directions in which a scan does not look, ``unseen`` notwithstanding.

        Args:
            scan: What the lidar has measured.
            turns: Turns of the robot since, in each of the states it may be in [rad], ``[S]``.

        Returns:
            Directions in the robot's frame after the first turn, 5 degrees apart [rad], ``[D]``;
            and the sectors that are hidden after one of them, ``[sectors]``.
        """
        rays = self._measured(scan)[0]
        half = 0.5 * rays.step * rays.valid.size + _EDGE
        directions = _AROUND[np.abs(_wrapped(_AROUND + turns[0] - rays.middle)) > half]
        inner = max(0.5 * self._width - _HIDDEN, 0.0)
        asked = self._middles[:, None] + np.array([-inner, 0.0, inner])
        covered = rays.cover(asked + np.asarray(turns)[:, None, None])
        return directions, np.asarray(~covered.all(axis=(0, 2)))

    def _index(self, angles: NDArray[np.float64]) -> NDArray[np.int64]:
        """Number of the sector of each angle in view."""
        index = ((self._edge - angles) / self._width).astype(np.int64)
        return np.clip(index, 0, self.card.sectors - 1)

    def _measured(self, scan: Scan) -> tuple[_Rays, Points, Points, NDArray[np.float64]]:
        """All rays, the points from the robot's center and from the sectors' place, and how far.

        The last are the distances of the points from the sensor [m].
        """
        scan = in_numbers(scan)
        ranges = np.asarray(scan.ranges)
        start, step = scan.angle_min, scan.angle_increment
        least, most = scan.range_min, scan.range_max
        if ranges.ndim != 1 or not ranges.size:
            raise ScanError(f"ranges must have shape [R], got {ranges.shape}")
        if not (math.isfinite(start) and math.isfinite(step) and step):
            raise ScanError(f"a scan needs a first angle and a step, got {start} and {step}")
        if abs(step) * (ranges.size - 1) > _TURNS * math.tau:
            raise ScanError(
                f"the rays of a scan must go round once at most, got {ranges.size} in steps of "
                f"{step} rad"
            )
        met = ranges[np.isfinite(ranges) & (ranges > 0.0)]
        # Driven by, millimeters would be a hall wider than the lidar sees.
        nearest, farthest = (met.min(), met.max()) if met.size else (0.0, 0.0)
        beyond = self.card.max_range < nearest < farthest and farthest > _FARTHEST[0]
        if beyond or _FARTHEST[0] < most <= _FARTHEST[1]:
            raise ScanError(
                f"ranges and range_max must be in meters, as the lidar's {self.card.max_range:g} m "
                f"are, got {nearest:g} to {farthest:g} and {most:g}: millimeters or centimeters?"
            )
        last = start + step * (ranges.size - 1)
        if scan.angle_max is not None and not abs(scan.angle_max - last) <= _OFF * abs(step):
            raise ScanError(
                f"the {ranges.size} ranges of a scan must reach from angle_min to angle_max = "
                f"{scan.angle_max:.4g} rad in steps of angle_increment, got {last:.4g} rad"
            )
        if not 0.0 <= least < most:
            raise ScanError(
                f"range_min must be at least 0 and below range_max, got {least} and {most}"
            )
        along = self._side * (start + step * np.arange(ranges.size, dtype=np.float64))
        directions = _wrapped(self.mount[2] + along)
        valid = ranges >= least
        too_near = (ranges < least) & ((ranges > 0.0) | (ranges == -math.inf))
        if valid.any():
            self._met = bool((ranges[valid] < _SUDDEN * min(most, self.card.max_range)).any())
        # A lidar that breaks or is covered does not mean free space; a wide hall does.
        elif self.silent == "reject" or self._met or too_near.any():
            before = ", and the one before met something near" if self._met else ""
            raise ScanError(f"none of the scan's {ranges.size} rays is valid{before}")
        ranges = np.where(too_near, least, ranges)
        middle = self.mount[2] + 0.5 * float(along[0] + along[-1])
        rays = _Rays(directions, valid | too_near, abs(step), middle, (0.0, 0.0))
        here, there = self.mount[:2], self.card.robot.lidar_mount[:2]
        place = here[0] - there[0], here[1] - there[1]
        rays = rays._replace(
            ends=self._ends(rays, ranges, most, place, leftward=along[-1] >= along[0])
        )
        angles, distances = directions[rays.valid], ranges[rays.valid]
        if self.silent == "far":
            angles, distances = self._with_near(rays, angles, distances, least + _NEAR)
        missed = distances >= most
        around = self._seen_from(angles, distances, missed, *here)
        around = around._replace(sensor=(here[0], here[1]), reach=most)
        return rays, around, self._seen_from(angles, distances, missed, *place), distances

    def _ends(
        self,
        rays: _Rays,
        ranges: NDArray[np.float64],
        most: float,
        place: tuple[float, float],
        *,
        leftward: bool,
    ) -> tuple[float, float]:
        """Where the angle that the rays cover ends, from its middle, with the sensor at a place."""
        half = 0.5 * rays.step * rays.valid.size
        if half + 0.5 * rays.step > math.pi:
            return -math.pi, math.pi
        ends = [-half, half]
        # The rays of a sensor that turns to the right, or hangs upside down, begin at the left.
        outermost = (0, -1) if leftward else (-1, 0)
        for end, ray in enumerate(outermost if any(place) else ()):
            one = slice(ray, ray + 1 or None)
            if rays.valid[ray]:
                at = self._seen_from(rays.directions[one], ranges[one], ranges[one] >= most, *place)
                moved = _wrapped(at.angles - rays.directions[one])
                ends[end] += float(moved[0])
        return ends[0], ends[1]

    def _with_near(
        self,
        rays: _Rays,
        angles: NDArray[np.float64],
        distances: NDArray[np.float64],
        near: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Add near returns of earlier scans where a lidar has fallen silent since."""
        # They keep their directions, so that a scan that is read twice gives the same twice.
        held_angles, held = self._near
        if held.size:
            off = np.abs(_wrapped(rays.directions - held_angles[:, None]))
            nearest = off.argmin(axis=1)
            stays = ~rays.valid[nearest] & (off.min(axis=1) <= rays.step)
            held_angles, held = held_angles[stays], held[stays]
        angles = np.concatenate((angles, held_angles))
        distances = np.concatenate((distances, held))
        self._near = angles[distances <= near], distances[distances <= near]
        return angles, distances

    def _seen_from(
        self,
        angles: NDArray[np.float64],
        distances: NDArray[np.float64],
        missed: NDArray[np.bool_],
        across: float,
        up: float,
    ) -> Points:
        """The measurements of a sensor, seen from where it is at (across, up) [m]."""
        far = self.card.max_range
        distances = np.where(missed, far, distances)
        if across or up:
            met_x = across + distances * np.cos(angles)
            met_y = up + distances * np.sin(angles)
            # A ray that met nothing has the same direction from there.
            angles = np.where(missed, angles, np.arctan2(met_y, met_x))
            distances = np.where(missed, far, np.hypot(met_x, met_y))
        return Points(angles, np.minimum(distances, far))

    def _beside(self, index: int, rays: _Rays, points: Points) -> float:
        """Range of a sector in which no valid ray has met anything [m]."""
        middle, half = float(self._middles[index]), 0.5 * self._width
        if not rays.cover(self._middles[index]):
            return self._beyond_the_rays(middle, rays)
        within = np.abs(_wrapped(rays.directions - middle)) <= half + _EDGE
        valid = rays.valid[within][self._index(rays.directions[within]) == index]
        # A sensor that is elsewhere sees near points in other directions.
        moved = bool(valid.any())
        if points.angles.size and (moved or not valid.size):
            distances = np.abs(_wrapped(points.angles - middle))
            nearest = int(distances.argmin())
            if moved or distances[nearest] <= half + rays.step + _EDGE:
                return float(points.ranges[nearest])
        if self.silent == "reject":
            degrees = round(math.degrees(middle))
            raise ScanError(f"no ray of the sector at {degrees} degrees is valid")
        return self.card.max_range

    def _beyond_the_rays(self, middle: float, rays: _Rays) -> float:
        """Range of a sector that no ray reaches [m]."""
        if self.unseen is None:
            reach = 0.5 * rays.step * (rays.valid.size - 1)
            right, left = (math.degrees(rays.middle + end) for end in (-reach, reach))
            raise ScanError(
                f"the scan does not reach the sector at {round(math.degrees(middle))} degrees, "
                f"its rays are from {right:.0f} to {left:.0f} degrees"
            )
        return min(self.unseen, self.card.max_range)


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-π, π) [rad]."""
    wrapped: NDArray[np.float64] = (angles + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped


_REDUCED: Final = 3
"""Rays of a sector of a scan that is seen from another pose."""


def observations_from(
    ahead: NDArray[np.float64],  # states (x, y, heading, forward, turning), [S, 5]
    ranges: NDArray[np.float64],  # of the sectors where the scan was taken [m], [sectors]
    points: Points,
    taken: NDArray[np.float64],  # pose of the scan, [3]
    card: Card,
    last: NDArray[np.float32],  # the observation before, [1, O]
    goal: tuple[float, float],
    fresh: bool,  # True at the first decision of a drive
    path: NDArray[np.float64],  # direction and length of the path, [1, 3], or [0, 3]
    pace: float,
) -> NDArray[np.float32]:
    """The observation of each state, ``[S, O]``."""
    robot = card.robot
    rows = []
    for state in ahead:
        seen = ranges
        if (state[:3] != taken).any():
            seen = np.empty(card.sectors * (1 if card.reduction == "single" else _REDUCED))
            view = math.radians(card.field_of_view)
            look_from(
                lidar_pose(state, robot.lidar_mount[0], robot.lidar_mount[1]),
                points.angles,
                points.ranges,
                taken,
                card.max_range,
                view,
                seen,
            )
        observation = last.copy()
        observe_all(
            np.array([[*state[:3], *(state[3:] / pace)]]),
            np.array([goal]),
            np.array([math.dist(state[:2], goal)]),
            np.array([fresh]),
            np.ones(1, dtype=np.bool_),
            seen[None],
            card.reduction == "median",
            (card.closeness_distance, robot.max_wheel_speed, robot.max_angular_speed),
            path,
            card.sectors,
            card.history,
            observation,
        )
        rows.append(observation[0])
    return np.array(rows)
