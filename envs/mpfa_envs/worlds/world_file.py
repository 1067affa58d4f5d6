"""Worlds in YAML files: reading with errors that name the line, and writing."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import yaml

from mpfa_envs.files import check_replaceable, write_atomically
from mpfa_envs.worlds.plain import walker_to_plain
from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon
from mpfa_envs.worlds.walker import Walker
from mpfa_envs.worlds.world import World
from mpfa_envs.worlds.yaml_nodes import NodeReader, WorldFileError, is_map, parse_nodes, read_nodes

if TYPE_CHECKING:
    from collections.abc import Mapping

_SHAPES: Final[Mapping[str, tuple[str, ...]]] = {
    "boxes": ("x_min", "x_max", "y_min", "y_max"),
    "cylinders": ("x", "y", "radius"),
    "start": ("x_min", "x_max", "y_min", "y_max"),
    "goal": ("x_min", "x_max", "y_min", "y_max"),
}
"""Keys of a file that hold lists, and the keys of an entry."""
_WALKER: Final = ("radius", "speed", "behavior", "waypoints")
_KEYS: Final = ("name", "size", "polygons", "walkers", *_SHAPES)
_REGION_CLEARANCE: Final = 0.5
"""A region must hold a point this far from every obstacle: what the TurtleBot2 asks for [m]."""
_FINEST: Final = 0.01
"""Room that a square of this diagonal may hold is not looked for [m]."""
_MOST_CELLS: Final = 100_000
"""A region in which more squares are undecided is too large and too narrow to be looked through."""


def load_world(path: str | os.PathLike[str]) -> World:
    """Read a world from a YAML file; ``docs/worlds.md`` describes the format.

    A map of ROS, a YAML file with the key ``image``, is read as by :meth:`World.from_map`.

    Args:
        path: The file.

    Returns:
        The world; without a name in the file it is called as the file.

    Raises:
        WorldFileError: If the file cannot be read, is too large, is not YAML, or does not describe
            a world.

    Examples:
        >>> from mpfa_envs import EXAMPLE_WORLD, load_world
        >>> world = load_world(EXAMPLE_WORLD)
        >>> world.name, len(world.boxes), len(world.cylinders)
        ('example', 4, 3)
    """
    path = Path(path)
    root = read_nodes(path)
    if is_map(root):
        # Imported here because most worlds are no maps.
        from mpfa_envs.worlds.ros_map import read_map

        grid = read_map(path, root)
        return World(name=path.stem, size=grid.size, occupancy=grid)
    return _Reader(path).world(root)


def _load(path: Path) -> World:
    """Read a world that is no map, which another function writes."""
    return _Reader(path).world(read_nodes(path))


class _Reader(NodeReader):
    """Turns the nodes of one file into a world."""

    def world(self, root: yaml.Node | None) -> World:
        """Read the whole file."""
        entries = self.mapping(root, "the file", _KEYS)
        name = self.path.stem
        if "name" in entries:
            name = self.text(entries["name"], "name")
        if "size" not in entries:
            raise self.error(root, "size is missing; it is a list [width, depth] in meters")
        size = self.size(entries["size"])
        room = self.built(entries["size"], name=name, size=size)
        boxes = self.shapes(entries, "boxes", room)
        cylinders = self.shapes(entries, "cylinders", room)
        polygons = self.polygons(entries, room)
        world = self.built(
            root,
            name=name,
            size=size,
            boxes=tuple(box for box, _ in boxes if isinstance(box, Box)),
            cylinders=tuple(shape for shape, _ in cylinders if isinstance(shape, Cylinder)),
            polygons=polygons,
        )
        starts = self.regions(entries, "start", world)
        goals = self.regions(entries, "goal", world)
        return World(
            name=name,
            size=size,
            boxes=world.boxes,
            cylinders=world.cylinders,
            polygons=polygons,
            start_regions=starts,
            goal_regions=goals,
            walkers=self.walkers(entries, world),
        )

    def built(self, node: yaml.Node | None, **parts: Any) -> World:
        """Build a world, with the line of a node in its error."""
        try:
            return World(**parts)
        except ValueError as error:
            raise self.error(node, str(error)) from error

    def size(self, node: yaml.Node) -> tuple[float, float]:
        """Read the size of the room [m]."""
        width, depth = self.pair(node, "size", "[width, depth]")
        if width <= 0 or depth <= 0:
            raise self.error(node, f"size must be positive, got {[width, depth]}")
        return width, depth

    def shapes(
        self, entries: dict[str, yaml.Node], key: str, room: World
    ) -> list[tuple[Box | Cylinder, yaml.Node]]:
        """Read a list of shapes that lie in the room, each with its node."""
        if key not in entries:
            return []
        shapes: list[tuple[Box | Cylinder, yaml.Node]] = []
        for node in self.items(entries[key], key):
            what = f"an entry of {key}"
            values = self.mapping(node, what, _SHAPES[key])
            for name in _SHAPES[key]:
                if name not in values:
                    raise self.error(node, f"{what} lacks the key {name!r}")
            numbers = {name: self.number(value, name) for name, value in values.items()}
            try:
                shape = Cylinder(**numbers) if key == "cylinders" else Box(**numbers)
            except ValueError as error:
                raise self.error(node, str(error)) from error
            if not room.holds(shape):
                raise self.error(node, f"{what} lies outside the room {room.room}, got {shape}")
            shapes.append((shape, node))
        return shapes

    def polygons(self, entries: dict[str, yaml.Node], room: World) -> tuple[Polygon, ...]:
        """Read a list of polygons, each a list of vertices, that lie in the room."""
        polygons: list[Polygon] = []
        for node in self.items(entries["polygons"], "polygons") if "polygons" in entries else ():
            what = "an entry of polygons"
            vertices = tuple(
                self.pair(vertex, "a vertex", "[x, y]") for vertex in self.items(node, what)
            )
            try:
                polygon = Polygon(vertices)
            except ValueError as error:
                raise self.error(node, str(error)) from error
            if not room.holds(polygon):
                raise self.error(node, f"{what} lies outside the room {room.room}, got {polygon}")
            polygons.append(polygon)
        return tuple(polygons)

    def walkers(self, entries: dict[str, yaml.Node], world: World) -> tuple[Walker, ...]:
        """Read a list of walkers that have room in the world."""
        walkers: list[Walker] = []
        for node in self.items(entries["walkers"], "walkers") if "walkers" in entries else ():
            given = self.mapping(node, "an entry of walkers", _WALKER)
            values: dict[str, Any] = {
                name: self.number(given[name], name) for name in _WALKER[:2] if name in given
            }
            if "behavior" in given:
                values["behavior"] = self.text(given["behavior"], "behavior")
            if "waypoints" in given:
                values["waypoints"] = tuple(
                    self.pair(point, "a waypoint", "[x, y]")
                    for point in self.items(given["waypoints"], "waypoints")
                )
            try:
                walkers.append(Walker(**values))
                replace(world, walkers=(walkers[-1],))
            except ValueError as error:
                raise self.error(node, str(error)) from error
        return tuple(walkers)

    def regions(self, entries: dict[str, yaml.Node], key: str, world: World) -> tuple[Box, ...]:
        """Read regions in which a robot has room."""
        regions: list[Box] = []
        for region, node in self.shapes(entries, key, world):
            if not isinstance(region, Box):
                continue
            found = _has_room(world, region)
            if not found:
                what = "is too large to find a" if found is None else "has no"
                raise self.error(
                    node,
                    f"an entry of {key} {what} point {_REGION_CLEARANCE} m from every obstacle "
                    f"and wall, got {region}",
                )
            regions.append(region)
        return tuple(regions)


def _has_room(world: World, region: Box) -> bool | None:
    """Tell whether a region has a point that is clear; None if it is too large to tell."""
    # The region is cut in four again and again. Within a rectangle the clearance differs from that
    # of its middle by half its diagonal at most, so that most rectangles are decided at once.
    half = np.array([region.x_max - region.x_min, region.y_max - region.y_min]) / 2
    middles = np.array([[region.x_min, region.y_min]]) + half
    corners = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    while len(middles) <= _MOST_CELLS:
        clearances = world.clearances(middles)
        if (clearances >= _REGION_CLEARANCE).any():
            return True
        reach = float(np.hypot(*half))
        undecided = middles[clearances + reach >= _REGION_CLEARANCE]
        if reach < _FINEST / 2 or not len(undecided):
            return False
        half = half / 2
        middles = (undecided[:, None] + corners * half).reshape(-1, 2)
    return None


def save_world(world: World, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a world to a YAML file that :func:`load_world` reads back as an equal world.

    Args:
        world: The world.
        path: The file; another world there is replaced.
        overwrite: Whether anything else there is replaced, too.

    Raises:
        FileExistsError: If there is a file that is no world, and overwrite is false.
        ValueError: If the world has the cells of a map, which :meth:`World.to_map` writes, or
            :func:`load_world` would reject the file, as it does one without a name; nothing is
            written then.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from mpfa_envs import WORLDS, load_world, save_world
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_world(WORLDS["B"], Path(folder) / "b.yaml")
        ...     load_world(Path(folder) / "b.yaml") == WORLDS["B"]
        True
    """
    if world.occupancy is not None:
        raise ValueError(f"world {world.name!r} must be written by to_map, as it comes from a map")
    content: dict[str, object] = {
        "name": world.name,
        "size": [float(side) for side in world.size],
    }
    lists = {
        "boxes": world.boxes,
        "cylinders": world.cylinders,
        "start": world.start_regions,
        "goal": world.goal_regions,
    }
    for key, shapes in lists.items():
        if shapes:
            content[key] = [
                {name: float(getattr(shape, name)) for name in _SHAPES[key]} for shape in shapes
            ]
    if world.polygons:
        content["polygons"] = [
            [list(vertex) for vertex in polygon.vertices] for polygon in world.polygons
        ]
    if world.walkers:
        content["walkers"] = [walker_to_plain(walker) for walker in world.walkers]
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True)
    path, encoded = Path(path), text.encode()
    try:
        _Reader(path).world(parse_nodes(encoded, path))
    except WorldFileError as error:
        raise ValueError(f"world must be one that can be loaded again: {error}") from error
    check_replaceable(path, _load, "world", overwrite=overwrite)
    write_atomically(encoded, path)
