"""Robots by name, file, fields or model."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from mpfa_envs.checks import got
from mpfa_envs.robots.model import ROBOTS, RobotModel

RobotChoice = str | os.PathLike[str] | Mapping[str, Any] | RobotModel
"""A robot: a name in :data:`~mpfa_envs.ROBOTS`, the path of a YAML file, the fields of a
:class:`~mpfa_envs.RobotModel` by name, or one."""


def is_robot_file(robot: object) -> bool:
    """Return True if a choice is the path of a file."""
    return isinstance(robot, os.PathLike) or (
        isinstance(robot, str) and robot.lower().endswith((".yaml", ".yml"))
    )


def resolve_robot(robot: RobotChoice) -> RobotModel:
    """Find a robot by its name, file or fields; a :class:`RobotModel` is returned as it is."""
    if isinstance(robot, RobotModel):
        return robot
    if isinstance(robot, Mapping):
        return RobotModel.from_fields(robot)
    if isinstance(robot, str) and robot in ROBOTS:
        return ROBOTS[robot]
    if isinstance(robot, str | os.PathLike) and is_robot_file(robot):
        # Imported here because it needs PyYAML, which a robot that drives need not have.
        from mpfa_envs.robots.robot_file import load_robot

        return load_robot(robot)
    raise ValueError(
        "robot must be a RobotModel, its fields, the path of a .yaml file or one of "
        f"{sorted(ROBOTS)}, {got(robot, ROBOTS)}"
    )
