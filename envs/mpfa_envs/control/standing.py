"""What it means that a robot stands still."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

STANDING_TIME: Final = 10.0
"""A robot stands still that has not left a small square for this long [s]."""
STANDING_SIDE: Final = 0.1
"""Side of the square [m]."""


def stands_still(places: Sequence[Sequence[float]] | NDArray[np.float64], period: float) -> bool:
    """Return True if a robot has come nowhere of late, whether or not it turns.

    Args:
        places: Positions (x, y) so far, ``[T, 2]`` [m].
        period: Time from one to the next [s].
    """
    count = math.ceil(STANDING_TIME / period) + 1
    last = places[-count:]
    return len(last) == count and bool((np.ptp(last, axis=0) <= STANDING_SIDE).all())
