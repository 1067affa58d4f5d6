"""What earlier scans have seen around the robot, where the last one did not look."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.sensing.observation import lidar_pose

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card
    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.sensing.sectors import Points

_KEPT: Final = 8
"""Scans that are kept."""
_APART: Final = 0.1, math.radians(15.0)
"""Distance [m], or turn [rad], between scans that are kept, at least."""
_OLD: Final = 4.0
"""Time for which they are kept [s]."""
_FAR: Final = 1.5
"""Distance of a place from where a scan was taken beyond which that does not count, and of that
from the robot [m]: rays are farther apart there, and odometry drifts."""
_LATER: Final = 0.05
"""Time by which a scan may be newer than the last one, over that between their decisions [s]."""
_DIRECTIONS: Final = 240
"""Directions from a sensor in which the nearest hit of a scan is kept, at most."""
_RAYS: Final = 5
"""Rays of a sector along which it is asked how far earlier scans have looked."""
_STEP: Final = 0.01
"""Distance between places on such a ray [m]."""


class Glances:
    """How far earlier scans have looked in sectors that the last one has not seen.

    A robot that turns while its orders are late looks, when the next order acts, where its last
    scan did not. What an earlier one saw there is still so if nothing moves.

    Args:
        card: Of the policy, whose lidar has the sectors.
        robot: What drives.
        moves: True if something may come, so that earlier scans count for nothing.
    """

    def __init__(self, card: Card, robot: RobotModel, *, moves: bool) -> None:
        self._card, self._robot = card, robot
        # A lidar that looks all round looks so after each turn.
        self._keeps = card.field_of_view < 360.0 and not moves
        self._last, self._time = np.full(3, math.nan), 0.0
        self._times, self._places = np.zeros(0), np.zeros((0, 3))
        self._ranges = np.zeros((0, _DIRECTIONS))
        self._hits: list[NDArray[np.float64]] = []
        self._view = math.radians(card.field_of_view)
        self._width = self._view / card.sectors
        middles = 0.5 * self._view - self._width * (np.arange(card.sectors) + 0.5)
        self._rays = middles[:, None] + self._width * np.linspace(-0.5, 0.5, _RAYS)

    def begin(self) -> None:
        """Forget all scans."""
        self._keep(np.zeros(len(self._times), np.bool_))

    def add(self, taken: NDArray[np.float64], points: Points, time: float) -> None:
        """Keep a scan.

        Args:
            taken: Pose at which it was taken (x, y, heading) [m, m, rad], ``[3]``.
            points: What it met.
            time: When a decision is made by it [s].
        """
        if not self._keeps:
            return
        robot, passed = self._robot, max(time - self._time, 0.0) + _LATER
        away, turned = _between(self._last, taken)
        # What odometry jumps by is not driven. Before the first scan it is NaN, which is not more.
        if away > robot.max_wheel_speed * passed or turned > robot.max_angular_speed * passed:
            self.begin()
        self._last, self._time = taken.copy(), time
        place = lidar_pose(taken, *points.sensor)
        kept = (time - self._times >= 0.0) & (time - self._times <= _OLD)
        if len(kept) > 1:
            # The last one may have been kept as the newest alone.
            away, turned = _between(self._places[-2], self._places[-1])
            kept[-1] &= away >= _APART[0] or turned >= _APART[1]
        kept[: -_KEPT + 1] = False
        self._keep(kept)
        met = points.ranges < min(self._card.max_range, points.reach)
        x = points.ranges * np.cos(points.angles) - points.sensor[0]
        y = points.ranges * np.sin(points.angles) - points.sensor[1]
        angles, ranges = np.arctan2(y, x), np.minimum(np.hypot(x, y), points.reach)
        self._times = np.append(self._times, time)
        self._places = np.concatenate((self._places, place[None]))
        self._ranges = np.concatenate((self._ranges, nearest_hits(angles, ranges)[None]))
        cosine, sine = math.cos(place[2]), math.sin(place[2])
        hits = np.stack((x * cosine - y * sine, x * sine + y * cosine), axis=1) + place[:2]
        self._hits.append(hits[met])

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        """Forget all scans but some."""
        self._times, self._places = self._times[kept], self._places[kept]
        self._ranges = self._ranges[kept]
        self._hits = [hits for hits, stays in zip(self._hits, kept, strict=True) if stays]

    def closeness(
        self, states: NDArray[np.float64], hidden: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Closeness of hidden sectors, ``[S, H]``, as far as they were seen; 1 at the rim.

        Args:
            states: Poses (x, y, heading, ...) at which they are hidden [m, m, rad], ``[S, 5]``.
            hidden: True for these sectors, ``[sectors]``.
        """
        far = np.zeros((len(states), np.count_nonzero(hidden)))
        if far.size and self._hits:
            mount_x, mount_y = self._card.robot.lidar_mount[:2]
            hits = np.concatenate(self._hits)
            for state, row in zip(states, far, strict=True):
                away = np.hypot(*(self._places[:, :2] - state[:2]).T) <= _FAR
                place, rim = lidar_pose(state, mount_x, mount_y), self._robot.radius
                earlier = self._places[away], self._ranges[away]
                look_back(place, (mount_x, mount_y), self._rays[hidden], rim, *earlier, row)
                np.minimum(row, self._nearest(place, hits)[hidden], out=row)
        near = self._card.closeness_distance
        return np.where(far > 0.0, near / np.maximum(far, near), 1.0)

    def _nearest(
        self, lidar: NDArray[np.float64], hits: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance of the nearest hit in each sector [m], ``[sectors]``; infinite without."""
        across, up = (hits - lidar[:2]).T
        near = across * across + up * up <= _FAR * _FAR
        across, up = across[near], up[near]
        angles = (np.arctan2(up, across) - lidar[2] + math.pi) % math.tau - math.pi
        sectors = np.floor((0.5 * self._view - angles) / self._width).astype(np.int64)
        within = (sectors >= 0) & (sectors < self._card.sectors)
        nearest = np.full(self._card.sectors, math.inf)
        np.minimum.at(nearest, sectors[within], np.hypot(across, up)[within])
        return nearest


def nearest_hits(angles: NDArray[np.float64], ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance up to which nothing was hit around each direction [m]; 0 where no ray looks."""
    # So few directions that each has a ray, and what lies between two is hidden by one.
    count = min(_DIRECTIONS, max(int(0.7 * len(angles)), 1))
    turns = (angles / math.tau + 0.5) * count
    nearest = np.full(count, math.inf)
    for off in (-1e-6, 1e-6):  # On the border of two it is in both.
        bins = np.floor(turns + off).astype(np.int64) % count
        np.minimum.at(nearest, bins, ranges)
    empty = np.isinf(nearest)
    nearest[empty | np.roll(empty, 1) | np.roll(empty, -1)] = 0.0
    # One of all directions may lie in two of these.
    number = np.arange(_DIRECTIONS)
    first, last = number * count // _DIRECTIONS, ((number + 1) * count - 1) // _DIRECTIONS
    return np.minimum(np.minimum(nearest[first], nearest[last]), _FAR)


def _between(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[float, float]:
    """Distance [m] and turn [rad] between two poses."""
    across, up, turned = (second - first).tolist()
    return math.hypot(across, up), abs((turned + math.pi) % math.tau - math.pi)


@njit
def look_back(
    lidar: NDArray[np.float64],  # its pose (x, y, heading) [m, m, rad], [3]
    mount: tuple[float, float],  # where it is in the robot's frame (x, y) [m]
    rays: NDArray[np.float64],  # directions of the rays of the sectors [rad], [H, K]
    rim: float,  # radius of the robot, which is free [m]
    places: NDArray[np.float64],  # poses of the sensor in earlier scans [m, m, rad], [N, 3]
    ranges: NDArray[np.float64],  # of their nearest hits in each direction [m], [N, D]
    seen: NDArray[np.float64],  # [H]
) -> None:
    """Write how far from the lidar all of a sector was seen [m]; 0 if not beyond the rim."""
    count = ranges.shape[1]
    for sector in range(rays.shape[0]):
        seen[sector] = _FAR
        for angle in rays[sector]:
            along = mount[0] * math.cos(angle) + mount[1] * math.sin(angle)
            square = along * along + rim * rim - mount[0] * mount[0] - mount[1] * mount[1]
            begin = math.sqrt(max(square, 0.0)) - along
            cosine, sine = math.cos(lidar[2] + angle), math.sin(lidar[2] + angle)
            away = begin + _STEP
            while away <= seen[sector]:
                x, y = lidar[0] + away * cosine, lidar[1] + away * sine
                known = False
                for scan in range(places.shape[0]):
                    across, up = x - places[scan, 0], y - places[scan, 1]
                    turn = (math.atan2(up, across) - places[scan, 2]) / math.tau + 0.5
                    direction = int((turn - math.floor(turn)) * count) % count
                    if math.hypot(across, up) < ranges[scan, direction]:
                        known = True
                        break
                if not known:
                    break
                away += _STEP
            farthest = away - _STEP
            seen[sector] = min(seen[sector], farthest if farthest > begin else 0.0)
