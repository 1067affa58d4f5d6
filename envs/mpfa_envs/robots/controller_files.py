"""Numbers of a robot in parameter files of ``diff_drive_controller``, Nav2 and ROS 1's planners."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

import yaml

from mpfa_envs.checks import MEANT
from mpfa_envs.worlds.yaml_nodes import NodeReader, read_number

_ACCELERATIONS: Final = ("max_acceleration", "max_deceleration", "min_acceleration")
_REVERSE: Final = ("max_acceleration_reverse", "max_deceleration_reverse")
PARAMETERS: Final[Mapping[str, tuple[str, ...]]] = {
    "radius": ("robot_radius",),
    "wheel_base": ("wheel_separation",),
    "wheel_radius": ("wheel_radius",),
    "max_wheel_speed": (
        *("linear.x.max_velocity", "max_velocity[0]", "max_vel_x", "vx_max", "v_linear_max"),
        *("desired_linear_vel", "max_linear_vel", "max_linear_velocity", "max_linear_speed"),
        *("max_speed_xy", "max_vel_trans", "max_trans_vel", "speed_lim_v"),
    ),
    "min_wheel_speed": (
        *("linear.x.min_velocity", "min_velocity[0]", "min_vel_x", "vx_min", "min_linear_vel"),
        *("max_vel_x_backwards", "allow_reversing", "allow_backward"),
    ),
    "wheel_acceleration": (
        *("linear.x.max_acceleration", "linear.x.max_acceleration_reverse", "max_accel[0]"),
        *("acc_lim_x", "acc_limit_x", "acc_lim_trans", "acc_limit_trans", "ax_max"),
        *("max_linear_accel", "max_linear_acceleration", "accel_lim_v"),
    ),
    "deceleration": (
        *("linear.x.max_deceleration", "linear.x.min_acceleration", "max_decel[0]"),
        *("linear.x.max_deceleration_reverse", "decel_lim_x", "dec_lim_x", "ax_min"),
        *("max_linear_decel", "max_linear_deceleration", "deceleration_max"),
    ),
    "turn_limit": (
        *("angular.z.max_velocity", "angular.z.min_velocity", "max_velocity[-1]"),
        *("min_velocity[-1]", "max_vel_theta", "min_vel_theta", "wz_max", "v_angular_max"),
        *("max_angular_vel", "min_angular_vel", "rotate_to_heading_angular_vel", "max_rot_vel"),
        *(
            "min_rot_vel",
            "max_rotational_vel",
            "max_angular_velocity",
            "max_angular_speed",
            "speed_lim_w",
        ),
    ),
    "turn_acceleration": (
        *(f"angular.z.{last}" for last in (*_ACCELERATIONS, *_REVERSE)),
        *("max_accel[-1]", "max_decel[-1]", "acc_lim_theta", "acc_lim_th", "acc_limit_th"),
        *("decel_lim_theta", "az_max", "max_angular_accel", "max_angular_decel", "accel_lim_w"),
        *("max_angular_acceleration", "max_angular_deceleration", "rotational_acc_lim"),
    ),
}
"""Parameters of each field: the smallest number counts, and the greatest radius. ``[0]`` and
``[-1]`` are x and theta in a list of the velocity smoother."""
_FIELDS: Final = {name: field for field, names in PARAMETERS.items() for name in names}
_CHANGES: Final = ("wheel_acceleration", "deceleration", "turn_acceleration")
"""Fields whose parameters count without their sign."""
_ZERO_IS_NONE: Final = ("max_speed_xy", "max_vel_trans", "max_trans_vel")
"""Parameters that limit nothing unless they are above zero."""
_SMOOTHER: Final = ("max_velocity", "min_velocity", "max_accel", "max_decel")
_OTHERS: Final = re.compile(
    r"(?:^|[_/])(?:behavior_server|recover(?:y|ies)|collision_(?:monitor|detector)|(?:un)?dock"
    r"(?:ing)?|following_server|route_server|[a-z]*teleop|joy|[eu]kf)(?:[_/]|$)"
)
"""Nodes and plugins that do not drive to a goal: their limits hold at a dock, near an obstacle, for
a recovery, or for a person at a joystick."""
_LIMIT: Final = {
    "max",
    "maximum",
    "lim",
    "limit",
    "limits",
    "desired",
    "target",
    "cruise",
    "nominal",
    "top",
}
_LEAST: Final = {"min", "minimum"}
_SIZE: Final = {"trans", "xy"}
_SPEED: Final = {"vel", "velocity", "velocities", "speed", "speeds", "vx", "wz"}
_BRAKE: Final = {"dec", "decel", "deceleration"}
_CHANGE: Final = _BRAKE | {"acc", "accel", "acceleration", "ax", "az"}
_TURN: Final = {
    "theta",
    "th",
    "angular",
    "rot",
    "rotation",
    "rotational",
    "turn",
    "turning",
    "yaw",
    "w",
    "wz",
    "az",
    "z",
}
_BACK: Final = {"reverse", "backward", "backwards"}
_NO_LIMIT: Final = {
    *("y", "vy", "ay", "jerk", "threshold", "tolerance", "stopped", "deadband", "weight", "ratio"),
    *("scale", "scaling", "factor", "timeout", "window", "time", "dist", "distance"),
}
"""Words of names, by which a limit that has no place in the table is recognized."""

Path = tuple[str, ...]
Block = dict[str, yaml.Node]
Numbers = dict[str, tuple[float, str]]
"""Number of each field, with the file and line of its parameter."""


def read_controllers(readers: Sequence[NodeReader], given: Collection[str]) -> Numbers:
    """Read what files say about fields; a limit not understood is an error unless it is given.

    The speed of reversing has no sign.
    """
    numbers: Numbers = {}
    for reader in readers:
        root = reader.read()
        blocks = _driving(_blocks(reader, root))
        entries = [entry for block in blocks.values() for entry in _numbers(reader, block)]
        if not entries:
            sought = "diff_drive_controller (wheel_separation, ...) or Nav2 (max_vel_x, ...)"
            raise reader.error(root, f"the file must have parameters of {sought}")
        for path, block in blocks.items():
            _reject_unread(reader, path, block, given)
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


def _blocks(reader: NodeReader, root: yaml.Node | None) -> Mapping[Path, Block]:
    """Find the parameters of each node, plugin or costmap, nested or with dots in their names."""
    blocks: defaultdict[Path, Block] = defaultdict(dict)
    waiting: list[tuple[Path, yaml.Node]] = [((), root)] if root else []
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
    return blocks


def _driving(blocks: Mapping[Path, Block]) -> Mapping[Path, Block]:
    """Leave out the parameters of what does not drive to a goal."""
    servers = {path: _plugins(block) for path, block in blocks.items()}

    def drives(path: Path) -> bool:
        if any(_OTHERS.search(_snake(name)) for name in path):
            return False
        for size, name in enumerate(path):
            plugins = servers.get(path[:size]) or ()
            is_plugin = name in plugins or "plugin" in blocks.get(path[: size + 1], ())
            # Nav2 loads the plugins of the list, and drives by this one unless it is told another.
            if plugins and is_plugin and name != "FollowPath":
                return name in plugins and "FollowPath" not in plugins
        return True

    return {path: block for path, block in blocks.items() if drives(path)}


def _plugins(block: Block) -> Sequence[str]:
    """Return the names of the controllers that a block lists."""
    node = block.get("controller_plugins")
    return [str(name.value) for name in node.value] if isinstance(node, yaml.SequenceNode) else []


def _numbers(reader: NodeReader, block: Block) -> Iterator[tuple[str, float, yaml.Node]]:
    """Read the fields that a block has."""
    if not _is_drive(block):  # The wheels and limits of another controller.
        block = {name: block[name] for name in block if name != "wheel_radius" and "." not in name}
    if "footprint" in block and (corners := _corners(reader, block["footprint"])):
        block.pop("robot_radius", None)  # Nav2 does not use it beside corners.
        yield "radius", max(math.hypot(*corner) for corner in corners), block["footprint"]
    block = block | dict(_smoothed(reader, block))
    for name in (name for name in block if name in _FIELDS):
        field, node = _FIELDS[name], block[name]
        if _is_off(block, name):
            continue
        if name.startswith("allow_"):
            if _is_false(node):
                yield field, 0.0, node
            continue
        value = reader.number(node, name, f" in {MEANT[field][2]}")
        if field == "wheel_base" and (multiplier := block.get(f"{name}_multiplier")) is not None:
            value *= reader.number(multiplier, f"{name}_multiplier", "")
        elif field == "min_wheel_speed":
            value = abs(value) if name == "max_vel_x_backwards" else max(-value, 0.0)
        elif field in _CHANGES or (field == "turn_limit" and "min_" in name and value < 0.0):
            value = abs(value)
        # The slowest turn that a planner orders, not the fastest.
        elif field == "turn_limit" and "min_" in name:
            continue
        if value > 0.0 or name not in _ZERO_IS_NONE:
            yield field, value, node


def _smoothed(reader: NodeReader, block: Block) -> Iterator[tuple[str, yaml.Node]]:
    """Read x and theta from the lists of a velocity smoother."""
    for name in _SMOOTHER:
        if isinstance(node := block.get(name), yaml.SequenceNode):
            entries = reader.items(node, name)
            if len(entries) not in (3, 6):
                form = "[x, y, theta] or [x, y, z, roll, pitch, yaw]"
                raise reader.error(node, f"{name} must be {form}, got {len(entries)} entries")
            yield f"{name}[0]", entries[0]
            yield f"{name}[-1]", entries[-1]


def _is_drive(block: Block) -> bool:
    """Return True for the parameters of a ``diff_drive_controller``."""
    # That of ROS 1 takes the distance of the wheels from the URDF if it is not here.
    return any(name in block for name in ("wheel_separation", "left_wheel", "left_wheel_names"))


def _is_off(block: Block, name: str) -> bool:
    """Return True for a limit that another parameter of its block switches off."""
    axis, _, last = name.rpartition(".")
    flag = f"{axis}.has_{last.split('_')[1]}_limits".replace("dec", "acc") if axis else ""
    if name == "rotate_to_heading_angular_vel":
        flag = "use_rotate_to_heading"
    return _is_false(block.get(flag))


def _is_false(node: yaml.Node | None) -> bool:
    return getattr(node, "value", None) in ("false", "False", "FALSE")


def _reject_unread(reader: NodeReader, path: Path, block: Block, given: Collection[str]) -> None:
    """Reject a limit that is not in the table, unless the robot's file has the field."""
    if "has_velocity_limits" in block or "has_acceleration_limits" in block:
        return  # Of a joint.
    wheels = any(word in name for name in block for word in ("wheel", "traction", "steering"))
    axis = {"linear", "angular", "y", "z"}.intersection(path[-1:])
    for name, node in block.items():
        # Another kind of drive has limits of the same names.
        known = name in _FIELDS and ("." not in name or wheels)
        lists = name in _SMOOTHER and isinstance(node, yaml.SequenceNode)
        field = "" if known or lists else _limited(name, axis, node)
        if field and field not in given:
            text = f"{name} is a limit that is not read: write {field} in the robot's file"
            raise reader.error(node, text)


def _limited(name: str, axis: set[str], node: yaml.Node) -> str:
    """Return the field that a parameter seems to limit by its name; empty if it is no limit."""
    nodes = node.value if isinstance(node, yaml.SequenceNode) else [node]
    values = [read_number(str(entry.value)) for entry in nodes]
    words = {*re.findall("[a-z]+", _snake(name)), *axis}
    # Below zero it is a limit backwards, unless it is the size of a speed, which has no sign.
    least = words & _LEAST and not words & _SIZE and any(value < 0.0 for value in values)
    is_limit = (least or words & _LIMIT) and words & (_SPEED | _CHANGE) and not words & _NO_LIMIT
    if not is_limit or not values or any(map(math.isnan, values)):
        return ""
    if words & _CHANGE:
        along = "deceleration" if least or words & _BRAKE else "wheel_acceleration"
        return "turn_acceleration" if words & _TURN else along
    along = "min_wheel_speed" if least or words & _BACK else "max_wheel_speed"
    return "turn_limit" if words & _TURN else along


def _snake(name: str) -> str:
    """Return a name in small letters, with underscores between its words."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def _corners(reader: NodeReader, node: yaml.Node) -> list[tuple[float, float]]:
    """Read the corners of a footprint, which for Nav2 is a text."""
    try:
        root = reader.parse(node.value.encode()) if isinstance(node, yaml.ScalarNode) else node
        corners = reader.items(root or node, "footprint")
        return [reader.pair(corner, "a corner", "[x, y]") for corner in corners]
    except reader.failure:
        raise reader.error(node, "footprint must be corners [[x, y], ...] in m") from None
