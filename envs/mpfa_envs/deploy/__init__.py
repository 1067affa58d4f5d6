"""A trained policy on a robot: from scan, odometry and goal to wheel speeds.

It needs NumPy and onnxruntime, and for a policy with a map Numba; neither PyTorch nor gymnasium
nor PyBullet. ``examples/export.py`` writes the files that it reads.

    >>> from mpfa_envs.deploy import Pilot, Scan
    >>> pilot = Pilot.load("policy.onnx", robot="turtlebot4")  # doctest: +SKIP
    >>> pilot.begin(goal=(3.0, 1.0))  # doctest: +SKIP
    >>> scan = Scan(angle_min=-3.14, angle_increment=0.0175, ranges=ranges)  # doctest: +SKIP
    >>> pilot.decide(scan, pose=(0.0, 0.0, 0.0), speeds=(0.0, 0.0))  # doctest: +SKIP
    Command(left=0.21, right=0.25, linear=0.23, angular=0.17)
"""

from __future__ import annotations

from mpfa_envs.deploy.card import Card, CardError, Network, card_file, read_exported
from mpfa_envs.deploy.command import Command
from mpfa_envs.deploy.map_path import GoalError
from mpfa_envs.deploy.pilot import Pilot
from mpfa_envs.sensing.scan import Scan, ScanError
from mpfa_envs.sensing.sectors import Points, Sectors

__all__ = [
    "Card",
    "CardError",
    "Command",
    "GoalError",
    "Network",
    "Pilot",
    "Points",
    "Scan",
    "ScanError",
    "Sectors",
    "card_file",
    "read_exported",
]
