"""The speed of a robot that drives the arcs of another one, with which a policy has learned."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from mpfa_envs.checks import check_share
from mpfa_envs.deploy.card import CardError

if TYPE_CHECKING:
    from mpfa_envs.robots.model import RobotModel

_WIDER: Final = 0.01
"""A robot's radius may exceed that in training by this [m]."""
_BEYOND: Final = 0.02
"""Share of its speed range by which a wheel's command may exceed it."""


def pace_of(robot: RobotModel, learned: RobotModel, pace: float | None) -> float:
    """Check that a robot fits a policy of another one; its pace, by default as fast as it can."""
    if robot.radius > learned.radius + _WIDER:
        raise CardError(
            f"the policy learned with a robot of radius {learned.radius} m, "
            f"{robot.name} has {robot.radius} m"
        )
    most = fastest_pace(robot, learned)
    chosen = most if pace is None else check_share("pace", pace)
    if not 0.0 < chosen <= most:
        raise ValueError(
            f"pace must be above 0 and at most {most:.3g}, as {robot.name} drives "
            f"{robot.max_wheel_speed} m/s, turns by {robot.max_angular_speed:.3g} "
            f"rad/s and changes its wheels' speed by {robot.wheel_limits.acceleration} "
            f"m/s², got {pace}"
        )
    least = chosen * wheel_range(robot, learned)[0]
    if least < robot.min_wheel_speed - tolerance(robot):
        raise CardError(
            f"on the sharpest arcs of the policy a wheel of {robot.name} would turn at "
            f"{least:.3g} m/s, its min_wheel_speed is {robot.min_wheel_speed}: train a "
            "policy with it, or give a lower min_wheel_speed if its wheels can do that"
        )
    return chosen


def widening(robot: RobotModel, learned: RobotModel) -> float:
    """Ratio of wheel speed differences to another robot's on the same arc, at least 1."""
    return max(1.0, robot.wheel_base / learned.wheel_base)


def wheel_range(robot: RobotModel, learned: RobotModel) -> tuple[float, float]:
    """Least and greatest speed of its wheels on the arcs of another robot, at its pace [m/s]."""
    middle = 0.5 * (learned.max_wheel_speed + learned.min_wheel_speed)
    span = 0.5 * (learned.max_wheel_speed - learned.min_wheel_speed)
    span *= widening(robot, learned)
    return middle - span, middle + span


def tolerance(robot: RobotModel) -> float:
    """Excess of commanded wheel speeds over their range [m/s]."""
    return _BEYOND * (robot.max_wheel_speed - robot.min_wheel_speed)


def fastest_pace(robot: RobotModel, learned: RobotModel) -> float:
    """The greatest share of the other robot's speed with which it can drive the same arcs."""
    wheels = (robot.max_wheel_speed + tolerance(robot)) / wheel_range(robot, learned)[1]
    pace = min(1.0, robot.max_wheel_speed / learned.max_wheel_speed, wheels)
    if robot.turn_limit is not None:
        pace = min(pace, robot.turn_limit / learned.max_angular_speed)
    changes = learned.wheel_limits.acceleration * widening(robot, learned)
    for can, does in (
        (robot.wheel_limits.acceleration, changes),
        (turning(robot), turning(learned)),
    ):
        if math.isfinite(can) and math.isfinite(does):
            pace = min(pace, math.sqrt(can / does))
    return pace


def turning(robot: RobotModel) -> float:
    """Fastest change of its turn by the controller [rad/s²]."""
    return math.inf if robot.turn_acceleration is None else robot.turn_acceleration
