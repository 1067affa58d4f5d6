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

    def decide(
        self, scan: Scan, pose: Triple, speeds: Pair, *, scan_pose: Triple | None = None
    ) -> object:
        """Choose the speeds."""


def rehearse(pilot: Deciding) -> None:
    """Have a pilot that drives nothing decide, so that loops are compiled, which takes seconds."""
    card = pilot.card
    for view in (math.tau, math.radians(card.field_of_view)):
        angles = 0.5 * view * np.linspace(-1.0, 1.0, _RAYS, endpoint=view < math.tau)
        ranges = card.max_range * (0.6 + 0.3 * np.cos(3.0 * angles))
        step = float(angles[1] - angles[0])
        scan = Scan(float(angles[0]), step, ranges, 0.0, card.max_range)
        # What does not fit together is said in a drive, by its own scans and goals.
        with contextlib.suppress(ValueError):
            pilot.begin(goal=(1.0, 0.0))
            # It has driven and turned since the scan.
            pilot.decide(scan, (0.1, 0.0, 0.2), (0.1, 0.2), scan_pose=(0.0, 0.0, 0.0))
