"""What a policy observes in the states that a robot may be in when its order acts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.sensing.observation_loops import lidar_pose, look_from, observe_all

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card
    from mpfa_envs.deploy.sectors import Points

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
                *points,
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
