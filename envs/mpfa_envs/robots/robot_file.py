"""Robots in YAML files: reading with errors that name the line."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mpfa_envs.checks import MEANT
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.worlds.yaml_nodes import NodeReader

if TYPE_CHECKING:
    import yaml

_ELSEWHERE: Final = {
    "wheel_separation": "wheel_base",
    "track_width": "wheel_base",
    **dict.fromkeys(("robot_radius", "diameter", "robot_diameter", "width"), "radius"),
    "max_vel_x": "max_wheel_speed",
    "min_vel_x": "min_wheel_speed",
    "max_velocity": "max_wheel_speed",
    "min_velocity": "min_wheel_speed",
    "max_range": "lidar_range",
    "range_max": "lidar_range",
    "max_angular_speed": "turn_limit",
    "max_vel_theta": "turn_limit",
    "acc_lim_x": "wheel_acceleration",
    "decel_lim_x": "deceleration",
    "acc_lim_theta": "turn_acceleration",
    "wheel_diameter": "wheel_radius",
    "lidar_fov": "field_of_view",
}
"""Keys that other tools have for the fields."""


class RobotFileError(ValueError):
    """A file does not describe a robot; the message names the file and the line."""


def load_robot(path: str | os.PathLike[str]) -> RobotModel:
    """Read a robot from a YAML file, whose keys are the fields of :class:`~mpfa_envs.RobotModel`.

    Args:
        path: The file.

    Returns:
        The robot; without a name in the file, it has that of the file.

    Raises:
        RobotFileError: If the file cannot be read, is not YAML, or does not describe a robot.

    Examples:
        >>> from mpfa_envs import EXAMPLE_ROBOT, load_robot
        >>> robot = load_robot(EXAMPLE_ROBOT)
        >>> robot.name, robot.radius, robot.field_of_view
        ('cart', 0.28, 360.0)
    """
    reader = _Reader(Path(path))
    return reader.robot(reader.read())


class _Reader(NodeReader):
    """Turns the nodes of one file into a robot."""

    failure = RobotFileError
    elsewhere = _ELSEWHERE
    hint = "docs/howto/robot.md has a file to start from"

    def robot(self, root: yaml.Node | None) -> RobotModel:
        """Read the whole file."""
        entries = self.mapping(root, "the file", tuple(field.name for field in fields(RobotModel)))
        values = {"name": self.path.stem}
        values |= {key: self._value(key, node) for key, node in entries.items()}
        try:
            return RobotModel.from_fields(values)
        except ValueError as error:
            # Errors of a model begin with the name of a field.
            node = entries.get(str(error).partition(" ")[0], root)
            raise self.error(node, str(error)) from error

    def _value(self, key: str, node: yaml.Node) -> Any:
        """Read the value of a key."""
        if key == "name":
            return self.text(node, key)
        if key == "reverse":
            if (word := self.text(node, key).lower()) not in ("true", "false"):
                raise self.error(node, f"{key} must be true or false, got {word!r}")
            return word == "true"
        if key == "lidar_mount":
            return [self.number(each, key, "") for each in self.items(node, key)]
        value = self.number(node, key, "" if key == "lidar_rays" else f" in {MEANT[key][2]}")
        return int(value) if key == "lidar_rays" and value.is_integer() else value
