"""Numbers of a robot in parameter files of ``diff_drive_controller`` and Nav2."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import yaml

from mpfa_envs.checks import MEANT
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
