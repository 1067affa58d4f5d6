"""A decision before the first one is due."""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from mpfa_envs.sensing.scan import Scan

if TYPE_CHECKING:
    from mpfa_envs.deploy.card import Card

_RAYS = 360
Triple = tuple[float, float, float]
Pair = tuple[float, float]


class Deciding(Protocol):
    """A pilot, for which loops are compiled."""

    card: Card

    def begin(self, goal: Pair) -> None:
        """Set out for a goal."""

    def decide(self, scan: Scan, pose: Triple, speeds: Pair) -> object:
        """Choose the speeds."""


def rehearse(pilot: Deciding) -> None:
    """Have a pilot that drives nothing decide, so that loops are compiled, which takes seconds."""
    angles = -math.pi + np.arange(_RAYS) * math.tau / _RAYS
    ranges = pilot.card.max_range * (0.6 + 0.3 * np.cos(3.0 * angles))
    scan = Scan(-math.pi, math.tau / _RAYS, ranges, 0.0, pilot.card.max_range)
    # What does not fit together is said in a drive, by its own scans and goals.
    with contextlib.suppress(ValueError):
        pilot.begin(goal=(1.0, 0.0))
        pilot.decide(scan, (0.0, 0.0, 0.0), (0.0, 0.0))
