"""A policy on a robot that may not be the one of its training: its pace, and its filter."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.checks import check_share
from mpfa_envs.deploy.card import CardError
from mpfa_envs.robots.drives import STRENGTH
from mpfa_envs.robots.motion_loops import changed
from mpfa_envs.safety.filter import SafetyFilter, check_view
from mpfa_envs.sensing.lidar import ray_angles
from mpfa_envs.sensing.scan import ScanError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card
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


_BESIDE: Final = 0.01
"""Cosine above which a direction is ahead."""
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
    card: Card,
    robot: RobotModel,
    body: RobotModel,
    clearance: float | None,  # [m]
    approach: float = 0.0,  # of what may come, in the policy's units of time [m/s]
) -> SafetyFilter | None:
    """The filter of the task that a policy learned, for the robot that drives; None: no filter."""
    learned = card.robot
    if clearance is None:
        if approach:
            raise ValueError(
                f"approach must be 0 without a filter (clearance=None), got {approach}"
            )
        return None
    if not learned.can_stop:
        raise ValueError(
            f"clearance must be None for a policy of {learned.name}, whose wheels turn at "
            f"{learned.min_wheel_speed} m/s at least: no filter can promise that it touches "
            f"nothing, got {clearance}"
        )
    check_view(robot, robot.field_of_view)
    repeat = card.action_repeat * _PARTS
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
        approach=approach,
    )


def reject_blind_front(blind: NDArray[np.float64]) -> None:
    """Reject a scan that does not look at directions [rad] beside which a filter lets it drive.

    They are from ahead when it was taken: what a turn since then hides is at the rim for a filter.
    """
    if (np.cos(blind) > _BESIDE).any():
        raise ScanError(
            "the scan must look at all directions up to 90 degrees from ahead for the "
            "filter (clearance), which does not drive beside what is not seen"
        )


def on_the_spot(
    robot: RobotModel, learned: RobotModel, left: float, right: float
) -> tuple[float, float]:
    """Speeds of the wheels that turn on the spot in place of others [m/s]."""
    most = min(learned.max_wheel_speed, -learned.min_wheel_speed)
    if most <= 0.0:
        raise cannot_turn(robot)
    turn = min(max(0.5 * (right - left), -most), most)
    return -turn, turn


def nearest_admissible(
    keep: SafetyFilter,
    robot: RobotModel,  # of the policy
    # Observations that the filter allows for, [S, O], their sectors of known walls, [S, sectors],
    # or None, and the sectors that are not seen, [sectors]
    seen: tuple[NDArray[np.float32], NDArray[np.bool_] | None, NDArray[np.bool_]],
    wheels: tuple[float, float],  # speeds [m/s]
    age: float,  # of what is seen when the speeds are ordered [s]
) -> tuple[float, float]:
    """Speeds of the wheels nearest to those wanted that the filter allows [m/s]."""
    states, still, hidden = seen
    still = None if still is None else still & ~hidden
    slow, fast = robot.min_wheel_speed, robot.max_wheel_speed
    action = (2.0 * np.array(wheels, np.float32) - slow - fast) / (fast - slow)
    return robot.wheel_speeds(keep.among(states, action, age=age, still=still))


def cannot_turn(robot: RobotModel) -> ScanError:
    """The error of a robot that would drive where it does not see, and cannot look there."""
    return ScanError(
        "the scan must reach 45 degrees to both sides of where the robot drives, as with "
        f"min_wheel_speed = {robot.min_wheel_speed} it cannot turn on the spot"
    )


def ramped(
    body: RobotModel,
    wheel_base: float,  # [m]
    last: tuple[float, float],  # forward and turning speed [m/s, rad/s]
    wanted: tuple[float, float],
    passed: float,  # [s]
) -> tuple[float, float]:
    """Speeds on the way to those wanted that a body reaches within a time."""
    limits, half = body.wheel_limits, 0.5 * wheel_base
    if math.isinf(min(limits.acceleration, limits.turning)):
        return wanted
    now, to = ((v - half * turn, v + half * turn) for v, turn in (last, wanted))
    left, right = changed(now, to, limits, 1.0, passed)
    return 0.5 * (left + right), 0.5 * (right - left) / half
