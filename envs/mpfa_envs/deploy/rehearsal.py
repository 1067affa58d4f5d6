"""A decision before the first one is due."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.sensing.scan import Scan

if TYPE_CHECKING:
    from mpfa_envs.deploy.pilot import Pilot

_RAYS = 360


def rehearse(pilot: Pilot) -> None:
    """Have a pilot that drives nothing decide, so that loops are compiled, which takes seconds."""
    view, far = math.radians(pilot.card.field_of_view), 0.9 * pilot.card.max_range
    angles = np.linspace(-0.5 * view, 0.5 * view, _RAYS)
    ranges = far * (0.6 + 0.3 * np.cos(3.0 * angles))
    scan = Scan(float(angles[0]), float(angles[1] - angles[0]), ranges, 0.0, pilot.card.max_range)
    pilot.begin(goal=(1.0, 0.0))
    pilot.decide(scan, (0.0, 0.0, 0.0), (0.0, 0.0))
