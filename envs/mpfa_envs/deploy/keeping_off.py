"""The filter of a pilot, for a robot that may not be the one of the training."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from mpfa_envs.deploy.pace import turning, widening
from mpfa_envs.robots.orders import STRENGTH
from mpfa_envs.safety.filter import SafetyFilter, check_view
from mpfa_envs.sensing.lidar import ray_angles

if TYPE_CHECKING:
    from mpfa_envs.deploy.card import Card
    from mpfa_envs.robots.model import RobotModel

_RAYS: Final = 5
"""Directions of a sector, any of which may be the one of the range that it reports."""
_PARTS: Final = 5
"""Parts of a time step in the filter: speeds of real wheels change all the time, not in steps."""


def body_of(learned: RobotModel, robot: RobotModel, pace: float) -> RobotModel:
    """The robot of the training, with what the robot that drives it at a pace cannot do."""
    braking = robot.wheel_limits.acceleration / widening(robot, learned)
    braking = min(learned.wheel_limits.acceleration, braking / pace**2)
    turns = min(turning(learned), turning(robot) / pace**2)
    return replace(
        learned,
        radius=max(robot.radius, 0.5 * learned.wheel_base),
        wheel_acceleration=None if math.isinf(braking) else braking,
        deceleration=None,
        turn_acceleration=None if math.isinf(turns) else turns,
        reverse=learned.reverse and robot.reverse,
    )


def filter_of(
    card: Card, robot: RobotModel, body: RobotModel, clearance: float | None
) -> SafetyFilter | None:
    """The filter of the task that a policy learned, for the robot that drives; None: no filter."""
    learned = card.robot
    if clearance is None:
        return None
    if not learned.can_stop:
        raise ValueError(
            f"clearance must be None for a policy of {learned.name}, whose wheels turn at "
            f"{learned.min_wheel_speed} m/s at least: no filter can promise that it touches "
            f"nothing, got {clearance}"
        )
    check_view(robot, robot.field_of_view)
    repeat = int(card.env_arguments.get("action_repeat", 2)) * _PARTS
    rays = card.sectors * (1 if card.reduction == "single" else _RAYS)
    return SafetyFilter(
        body,
        angles=ray_angles(card.field_of_view, rays),
        sectors=card.sectors,
        max_range=card.max_range,
        closeness_distance=card.closeness_distance,
        memory=card.memory,  # type: ignore[arg-type]
        history=card.history,
        time_step=card.period / repeat,
        action_repeat=repeat,
        clearance=clearance,
        braking=STRENGTH,
    )
