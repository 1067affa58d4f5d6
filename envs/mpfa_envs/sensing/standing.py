"""What of a scan is a wall of a plan, which stays, and in which sectors there is nothing else."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.world import World

_OFF: Final = 0.05
"""A hit no farther than this from a wall of the plan is one on it [m]: scans have noise, and the
place of a robot has errors."""
_GAP: Final = 0.4
"""Between hits that are farther apart something may come through [m]."""
_BETWEEN: Final = np.array((0.25, 0.5, 0.75))
"""Shares of the gap between two hits at which the plan must have a wall."""


def standing_hits(
    plan: World,
    pose: tuple[float, float, float],  # of the plan's middle (x, y, heading) [m, m, rad]
    taken: NDArray[np.float64],  # pose from which the rays go, [3]
    angles: NDArray[np.float64],  # of the rays, in order [rad], [P]
    ranges: NDArray[np.float64],  # [m], [P]
    far: float,  # range of a ray that meets nothing [m]
) -> NDArray[np.bool_]:
    """Return True for hits on a wall of the plan that goes on to the hits on both sides, [P]."""
    around = angles + taken[2]
    x = taken[0] + ranges * np.cos(around) - pose[0]
    y = taken[1] + ranges * np.sin(around) - pose[1]
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    hits = np.stack((x * cosine + y * sine, y * cosine - x * sine), axis=1)
    to_next = np.roll(hits, -1, axis=0) - hits
    inner = hits[:, None] + _BETWEEN[:, None] * to_next[:, None]
    # Between two hits around a corner the line is within the wall.
    goes_on = (plan.clearances(inner.reshape(-1, 2)).reshape(-1, len(_BETWEEN)) <= _OFF).all(axis=1)
    on_wall = (ranges < far) & (np.abs(plan.clearances(hits)) <= _OFF)
    goes_on &= on_wall & np.roll(on_wall, -1) & (np.hypot(*to_next.T) <= _GAP)
    standing: NDArray[np.bool_] = goes_on & np.roll(goes_on, 1)
    return standing


def standing_sectors(
    standing: NDArray[np.bool_],  # of the rays, [P]
    taken: NDArray[np.float64],  # pose from which the rays went, [3]
    angles: NDArray[np.float64],  # [rad], [P]
    ranges: NDArray[np.float64],  # [m], [P]
    far: float,  # range of a ray that meets nothing [m]
    place: NDArray[np.float64],  # pose from which the sectors are seen, [3]
    view: float,  # of all sectors [rad]
    sectors: int,
) -> NDArray[np.bool_]:
    """Return True for sectors that hold hits on walls of the plan and nothing else, [sectors]."""
    around = angles + taken[2]
    x = taken[0] - place[0] + ranges * np.cos(around)
    y = taken[1] - place[1] + ranges * np.sin(around)
    around = np.where(ranges < far, np.arctan2(y, x), around) - place[2]
    around -= math.tau * np.round(around / math.tau)
    index = np.floor((0.5 - around / view) * sectors).astype(np.int64)
    if view > math.tau - 1e-9:
        index %= sectors
    inside = (index >= 0) & (index < sectors)
    known = np.zeros(sectors, dtype=np.bool_)
    known[index[inside]] = True
    known[index[inside & ~standing]] = False
    return known
