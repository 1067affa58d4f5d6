"""Robots in YAML files, and numbers of theirs in files of ``diff_drive_controller`` and Nav2."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import yaml

from mpfa_envs.checks import MEANT
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.worlds.yaml_nodes import NodeReader

_ACCELERATIONS: Final = ("max_acceleration", "max_deceleration", "min_acceleration")
_PARAMETERS: Final = {
    "radius": ("robot_radius",),
    "wheel_base": ("wheel_separation",),
    "wheel_radius": ("wheel_radius",),
    "max_wheel_speed": ("linear.x.max_velocity", "max_vel_x"),
    "min_wheel_speed": ("linear.x.min_velocity", "min_vel_x"),
    "wheel_acceleration": ("linear.x.max_acceleration", "acc_lim_x"),
    "deceleration": ("linear.x.max_deceleration", "linear.x.min_acceleration", "decel_lim_x"),
    "turn_limit": ("angular.z.max_velocity", "max_vel_theta"),
    "turn_acceleration": (*(f"angular.z.{last}" for last in _ACCELERATIONS), "acc_lim_theta"),
}
"""Parameters of each field: the smallest number counts, and the greatest radius."""
_BRAKING: Final = (*_ACCELERATIONS[1:], "decel_lim_x")

Block = dict[str, yaml.Node]
Numbers = dict[str, tuple[float, str]]
"""Number of each field, with the file and line of its parameter."""


def read_controllers(readers: Sequence[NodeReader]) -> Numbers:
    """Read what files say about fields; the speed of reversing has no sign."""
    numbers: Numbers = {}
    for reader in readers:
        root = reader.read()
        entries = [entry for block in _blocks(reader, root) for entry in _numbers(reader, block)]
        if not entries:
            sought = "diff_drive_controller (wheel_separation, ...) or Nav2 (max_vel_x, ...)"
            raise reader.error(root, f"the file must have parameters of {sought}")
        for field, value, node in entries:
            number = value, f"{reader.path}:{node.start_mark.line + 1}"
            best = max if field == "radius" else min
            numbers[field] = best(number, numbers.get(field, number))
    return numbers


def fill_in(values: dict[str, Any], numbers: Numbers) -> None:
    """Add the fields that the file of a robot leaves out to those that it has."""
    for field in numbers.keys() - {"min_wheel_speed"}:
        values.setdefault(field, numbers[field][0])
    backwards, _ = numbers.get("min_wheel_speed", (math.inf, ""))
    if not values.setdefault("reverse", backwards > 0.0):
        backwards = values.get("turn_limit", math.nan) * values.get("wheel_base", math.nan) / 2
    elif backwards in (0.0, math.inf):
        backwards = values.get("max_wheel_speed", math.nan)
    if not math.isnan(backwards):
        values.setdefault("min_wheel_speed", -backwards)


def _blocks(reader: NodeReader, root: yaml.Node | None) -> Iterable[Block]:
    """Find the parameters of each node, plugin or costmap, nested or with dots in their names."""
    blocks: defaultdict[tuple[str, ...], Block] = defaultdict(dict)
    waiting: list[tuple[tuple[str, ...], yaml.Node]] = [((), root)] if root else []
    seen = set()
    for path, node in waiting:
        if isinstance(node, yaml.MappingNode):
            if node in seen:  # With aliases a file could stand for any number of mappings.
                raise reader.error(node, "must have no alias: write the mapping out")
            seen.add(node)
            for key, value in node.value:
                names = key.value.rsplit(".", 3) if isinstance(key, yaml.ScalarNode) else ("",)
                waiting.append(((*path, *names)[-16:], value))
        elif not (isinstance(node, yaml.ScalarNode) and node.value.lower() == ".nan"):
            size = 3 if path[-3:-1] in (("linear", "x"), ("angular", "z")) else 1
            blocks[path[:-size]][".".join(path[-size:])] = node
    return blocks.values()


def _numbers(reader: NodeReader, block: Block) -> Iterator[tuple[str, float, yaml.Node]]:
    """Read the fields that a block has."""
    if "wheel_separation" not in block:  # The wheels and limits of another controller.
        block = {name: block[name] for name in block if name != "wheel_radius" and "." not in name}
    if "footprint" in block and (corners := _corners(reader, block["footprint"])):
        block.pop("robot_radius", None)  # Nav2 does not use it beside corners.
        yield "radius", max(math.hypot(*corner) for corner in corners), block["footprint"]
    for field, name in ((field, name) for field, names in _PARAMETERS.items() for name in names):
        axis, _, last = name.rpartition(".")
        flag = block.get(f"{axis}.has_{last.partition('_')[2]}_limits".replace("dec", "acc"))
        if name not in block or getattr(flag, "value", None) in ("false", "False", "FALSE"):
            continue
        value = reader.number(block[name], name, f" in {MEANT[field][2]}")
        if field == "wheel_base" and (multiplier := block.get(f"{name}_multiplier")) is not None:
            value *= reader.number(multiplier, f"{name}_multiplier", "")
        elif field == "min_wheel_speed":
            value = max(-value, 0.0)
        yield field, abs(value) if last in _BRAKING else value, block[name]


def _corners(reader: NodeReader, node: yaml.Node) -> list[tuple[float, float]]:
    """Read the corners of a footprint, which for Nav2 is a text."""
    try:
        root = reader.parse(node.value.encode()) if isinstance(node, yaml.ScalarNode) else node
        corners = reader.items(root or node, "footprint")
        return [reader.pair(corner, "a corner", "[x, y]") for corner in corners]
    except reader.failure:
        raise reader.error(node, "footprint must be corners [[x, y], ...] in m") from None


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

    The key ``controller``, a path from the file's folder or a list of paths, names parameter files
    of ``diff_drive_controller`` and Nav2. Their numbers fill the fields that the file leaves out.

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
        if numbers := self._controllers(controller):
            fill_in(values, numbers)
        try:
            return RobotModel.from_fields(values)
        except ValueError as error:
            # Errors of a model begin with the name of a field.
            field = str(error).partition(" ")[0]
            node = entries.get(field, controller if controller and field in names else root)
            where = f"{numbers[field][1]}: " if node is controller and field in numbers else ""
            raise self.error(node, f"{where}{error}") from error

    def _controllers(self, node: yaml.Node | None) -> Numbers:
        """Read the files of the controller, if any; their paths begin at the folder of this one."""
        if node is None:
            return {}
        paths = self.items(node, "controller") if isinstance(node, yaml.SequenceNode) else [node]
        names = [self.text(path, "controller") for path in paths]
        try:
            return read_controllers([_Reader(self.path.parent / name) for name in names])
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
