"""Worlds in YAML files: reading with errors that name the line, and writing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from mpfa_envs.files import check_replaceable, write_atomically
from mpfa_envs.worlds.ros_map import read_map
from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon
from mpfa_envs.worlds.walker import Walker
from mpfa_envs.worlds.world import World
from mpfa_envs.worlds.yaml_nodes import NodeReader, WorldFileError, is_map

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
"""A region must hold a point this far from every obstacle, which a TurtleBot2 needs [m]."""
_FINEST: Final = 0.01
"""Squares of a smaller diagonal are not searched for room [m]."""
_MOST_CELLS: Final = 100_000
"""A region that leaves more squares undecided is too large and too narrow to search."""


def load_world(path: str | os.PathLike[str]) -> World:
    """Read a world from a YAML file; ``docs/howto/world.md`` describes the format.

    A YAML file with the key ``image`` is a map of ROS and read as by :meth:`World.from_map`.

    Args:
        path: The file.

    Returns:
        The world; without a name in the file, it has that of the file.

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
    reader = _Reader(path)
    root = reader.read()
    if is_map(root):
        grid = read_map(path, root)
        return World(name=path.stem, size=grid.size, occupancy=grid)
    return reader.world(root)


def _load(path: Path) -> World:
    """Read a world that is no map, which another function writes."""
    reader = _Reader(path)
    return reader.world(reader.read())


class _Reader(NodeReader):
    """Turns the nodes of one file into a world."""

    def world(self, root: yaml.Node | None) -> World:
        """Read the whole file."""
        entries = self.mapping(root, "the file", _KEYS)
        name = self.text(entries["name"], "name") if "name" in entries else self.path.stem
        if "size" not in entries:
            raise self.error(root, "size is missing; it is a list [width, depth] in meters")
        with self.at(entries["size"]):
            empty = World(name=name, size=self.pair(entries["size"], "size", "[width, depth]"))
        obstacles: dict[str, Any] = {
            key: self.parts(entries, key, empty, key) for key in ("boxes", "cylinders", "polygons")
        }
        with self.at(root):
            world = replace(empty, **obstacles)
        starts = self.parts(entries, "start", empty, "start_regions")
        goals = self.parts(entries, "goal", empty, "goal_regions")
        for key, regions in (("start", starts), ("goal", goals)):
            for node, region in zip(self.nodes(entries, key), regions, strict=True):
                found = has_room(world, region, _REGION_CLEARANCE)
                if not found:
                    what = "is too large to find a" if found is None else "has no"
                    raise self.error(
                        node,
                        f"an entry of {key} {what} point {_REGION_CLEARANCE} m from every obstacle "
                        f"and wall, got {region}",
                    )
        walkers = self.parts(entries, "walkers", world, "walkers")
        return replace(world, start_regions=starts, goal_regions=goals, walkers=walkers)

    @contextmanager
    def at(self, node: yaml.Node | None) -> Iterator[None]:
        """Give an error about a value the line of a node."""
        try:
            yield
        except WorldFileError:
            raise
        except ValueError as error:
            raise self.error(node, str(error)) from error

    def nodes(self, entries: dict[str, yaml.Node], key: str) -> list[yaml.Node]:
        """Read a list, empty without the key."""
        return self.items(entries[key], key) if key in entries else []

    def parts(
        self, entries: dict[str, yaml.Node], key: str, world: World, field: str
    ) -> tuple[Any, ...]:
        """Read a list of parts, each of which fits in the world by itself."""
        read = {"polygons": self.polygon, "walkers": self.walker}.get(key, self.shape)
        parts: list[Any] = []
        for node in self.nodes(entries, key):
            with self.at(node):
                parts.append(read(node, key))
                alone: dict[str, Any] = {field: (parts[-1],)}
                replace(world, **alone)
        return tuple(parts)

    def shape(self, node: yaml.Node, key: str) -> Box | Cylinder:
        """Read a box, a cylinder or a region."""
        what = f"an entry of {key}"
        values = self.mapping(node, what, _SHAPES[key])
        for name in _SHAPES[key]:
            if name not in values:
                raise self.error(node, f"{what} lacks the key {name!r}")
        numbers = {name: self.number(value, name) for name, value in values.items()}
        return Cylinder(**numbers) if key == "cylinders" else Box(**numbers)

    def polygon(self, node: yaml.Node, key: str) -> Polygon:
        """Read a polygon, a list of vertices."""
        vertices = self.items(node, f"an entry of {key}")
        return Polygon(tuple(self.pair(vertex, "a vertex", "[x, y]") for vertex in vertices))

    def walker(self, node: yaml.Node, key: str) -> Walker:
        """Read a walker."""
        given = self.mapping(node, f"an entry of {key}", _WALKER)
        values: dict[str, Any] = {
            name: self.number(given[name], name) for name in ("radius", "speed") if name in given
        }
        if "behavior" in given:
            values["behavior"] = self.text(given["behavior"], "behavior")
        if "waypoints" in given:
            points = self.items(given["waypoints"], "waypoints")
            values["waypoints"] = tuple(
                self.pair(point, "a waypoint", "[x, y]") for point in points
            )
        return Walker(**values)


def has_room(world: World, region: Box, clearance: float) -> bool | None:
    """Return True if a region has a point with a clearance [m]; None if it is too large."""
    # The region is cut in four again and again. Within a rectangle the clearance differs from that
    # of its middle by half its diagonal at most, so that most rectangles are decided at once.
    half = np.array([region.x_max - region.x_min, region.y_max - region.y_min]) / 2
    middles = np.array([[region.x_min, region.y_min]]) + half
    corners = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    while len(middles) <= _MOST_CELLS:
        clearances = world.clearances(middles)
        if (clearances >= clearance).any():
            return True
        reach = float(np.hypot(*half))
        undecided = middles[clearances + reach >= clearance]
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
        overwrite: If True, replace any other file, too.

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
        raise ValueError(
            f"world {world.name!r} must be written by to_map, as it has the cells of a map"
        )
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
        content["walkers"] = [
            {
                "radius": float(walker.radius),
                "speed": float(walker.speed),
                "behavior": walker.behavior,
                "waypoints": [list(point) for point in walker.waypoints],
            }
            for walker in world.walkers
        ]
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True)
    path, encoded = Path(path), text.encode()
    try:
        reader = _Reader(path)
        reader.world(reader.parse(encoded))
    except WorldFileError as error:
        raise ValueError(f"world must be one that can be loaded again: {error}") from error
    check_replaceable(path, _load, "world", overwrite=overwrite)
    write_atomically(encoded, path)
