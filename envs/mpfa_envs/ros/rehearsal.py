"""A rehearsal of decisions, so that no drive waits for loops that are compiled."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.sensing.scan import Scan

if TYPE_CHECKING:
    from mpfa_envs.deploy.pilot import Pilot

_POSES = (0.0, 0.0, 0.0), (0.02, 0.0, 0.05)
"""Where it decides; the second scan was taken at the first pose."""


def rehearse(pilot: Pilot) -> None:
    """Decide twice on a made-up scan; the pilot is of no use for a drive then."""
    scan = Scan(-math.pi, math.pi / 180.0, np.full(360, 3.0), 0.05, 10.0)
    pilot.begin((2.0, 0.0))
    for number, pose in enumerate(_POSES):
        pilot.decide(scan, pose, (0.1, 0.2), scan_pose=_POSES[0], time=0.2 * number, age=0.05)
