"""Robots in YAML files."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import yaml

from mpfa_envs.checks import MEANT
from mpfa_envs.robots.controller_files import PARAMETERS, Numbers, fill_in, read_controllers
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.worlds.yaml_nodes import NodeReader

_ELSEWHERE: Final = {
    **{name: field for field, names in PARAMETERS.items() for name in names},
    "track_width": "wheel_base",
    **dict.fromkeys(("diameter", "robot_diameter", "width"), "radius"),
    "max_velocity": "max_wheel_speed",
    "min_velocity": "min_wheel_speed",
    **dict.fromkeys(("max_range", "range_max"), "lidar_range"),
    **dict.fromkeys(("allow_reversing", "allow_backward"), "reverse"),
    "wheel_diameter": "wheel_radius",
    "lidar_fov": "field_of_view",
}
"""Keys that other tools have for the fields."""


class RobotFileError(ValueError):
    """A file does not describe a robot; the message names the file and the line."""


def load_robot(path: str | os.PathLike[str]) -> RobotModel:
    """Read a robot from a YAML file, whose keys are the fields of :class:`~mpfa_envs.RobotModel`.

    The key ``controller``, a path from the file's folder or a list of paths, names parameter files
    of ``diff_drive_controller``, Nav2 and ROS 1's planners. Their numbers fill the fields that the
    file leaves out.

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
        names = *(field.name for field in fields(RobotModel)), "controller"
        entries = self.mapping(root, "the file", names)
        controller = entries.pop("controller", None)
        values = {"name": self.path.stem}
        values |= {key: self._value(key, node) for key, node in entries.items()}
        if numbers := self._controllers(controller, entries):
            fill_in(values, numbers)
        try:
            return RobotModel.from_fields(values)
        except ValueError as error:
            # Errors of a model begin with the name of a field.
            field = str(error).partition(" ")[0]
            node = entries.get(field, controller if controller and field in names else root)
            where = f"{numbers[field][1]}: " if node is controller and field in numbers else ""
            raise self.error(node, f"{where}{error}") from error

    def _controllers(self, node: yaml.Node | None, given: Collection[str]) -> Numbers:
        """Read the files of the controller, if any; their paths begin at the folder of this one."""
        if node is None:
            return {}
        paths = self.items(node, "controller") if isinstance(node, yaml.SequenceNode) else [node]
        names = [self.text(path, "controller") for path in paths]
        try:
            return read_controllers([_Reader(self.path.parent / name) for name in names], given)
        except RobotFileError as error:
            raise self.error(node, f"controller: {error}") from error

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
