"""Worlds of Gazebo (SDF): the boxes and cylinders of their static models."""

from __future__ import annotations

import gzip
import io
import math
import os
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple
from xml.parsers import expat

from mpfa_envs.files import read_file
from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon, Shape
from mpfa_envs.worlds.world import World
from mpfa_envs.worlds.yaml_nodes import WorldFileError, read_number

LARGEST_FILE: Final = 20_000_000
"""Longest text that is read [bytes]."""
_DEEPEST: Final = 100
"""Greatest depth of nested elements."""
_FLOOR: Final = 0.01
"""A robot drives over obstacles up to this height [m]."""
_FARTHEST: Final = 1e9
"""Numbers must be smaller than this [m, rad]."""
_STRAIGHT: Final = 1e-6
"""Smaller angles count as zero [rad]."""


@dataclass(slots=True)
class _Element:
    """An element of the file, with its line."""

    tag: str
    attributes: dict[str, str]
    line: int
    pieces: list[str] = field(default_factory=list)
    children: list[_Element] = field(default_factory=list)

    @property
    def text(self) -> str:
        """Text between its children."""
        return "".join(self.pieces).strip()

    def all(self, tag: str) -> Iterator[_Element]:
        """Its children with a tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> _Element | None:
        """Its first child with a tag; None without one."""
        return next(self.all(tag), None)


class _Pose(NamedTuple):
    """A pose: x, y, z [m] and yaw [rad]."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0

    def __matmul__(self, inner: _Pose) -> _Pose:
        """Compose two poses: the inner one is given in the frame of this one."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return _Pose(
            self.x + cosine * inner.x - sine * inner.y,
            self.y + sine * inner.x + cosine * inner.y,
            self.z + inner.z,
            self.yaw + inner.yaw,
        )


def load_gazebo_world(
    path: str | os.PathLike[str],
    *,
    size: tuple[float, float] | None = None,
    center: tuple[float, float] | None = None,
    height: float = 0.5,
) -> World:
    """Read the boxes and cylinders of a Gazebo world.

    They are those of the collisions of static models, models in models included, where the
    ``state`` of the file puts them. A warning counts parts that are left out: includes, models that
    may move, meshes and other geometry, tilted parts, poses in named frames, and poses with a
    quaternion.

    Args:
        path: A ``.world`` or ``.sdf`` file, or one that is compressed (``.gz``).
        size: Width and depth of the room [m]. None: as large as the obstacles need.
        center: Middle of the room in the file (x, y) [m]. None: that of the obstacles.
        height: Shapes that begin above this are no obstacles [m], nor are those below the floor.

    Returns:
        The world, with the name of the file.

    Raises:
        WorldFileError: If the file cannot be read, is no world of SDF, defines entities, or the
            obstacles do not fit in the room.
    """
    path = Path(path)
    return read_gazebo_world(_read(path), str(path), size=size, center=center, height=height)


def read_gazebo_world(
    text: bytes,
    path: str,
    *,
    size: tuple[float, float] | None,
    center: tuple[float, float] | None,
    height: float = 0.5,
) -> World:
    """Read the text of a file; ``path`` names it in errors, and the world."""
    root = _parse(path, text)
    world = root.first("world") if root.tag == "sdf" else None
    if world is None:
        raise WorldFileError(f"{path}:{root.line}: must be an sdf element with a world in it")
    reader = _Reader(path, height)
    moved = reader.state(world.first("state"))
    for model in world.all("model"):
        reader.model(model, _Pose(), moved.get(model.attributes.get("name", "")))
    reader.left_out["includes"] += sum(1 for _ in world.all("include"))
    reader.left_out["actors"] += sum(1 for _ in world.all("actor"))
    left_out = [f"{count} {what}" for what, count in reader.left_out.items() if count]
    if left_out:
        warnings.warn(f"{path}: left out {', '.join(left_out)}", stacklevel=3)
    if not reader.shapes and size is None:
        raise WorldFileError(f"{path}:{world.line}: has no obstacle, and so no size")
    try:
        return _room(path, reader.shapes, size, center)
    except ValueError as error:
        raise WorldFileError(f"{path}: {error}") from error


def _read(path: Path) -> bytes:
    """Read a file, decompressed if it ends in .gz, up to the largest size."""
    try:
        content = read_file(path, LARGEST_FILE)
        if path.suffix.lower() == ".gz":
            content = gzip.GzipFile(fileobj=io.BytesIO(content)).read(LARGEST_FILE + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise WorldFileError(f"{path}: cannot be read: {error}") from error
    if len(content) > LARGEST_FILE:
        raise WorldFileError(f"{path}: has more than {LARGEST_FILE} bytes")
    return content


def _parse(path: str, text: bytes) -> _Element:
    """Read the elements; a document type, which could define entities, is rejected."""
    parser = expat.ParserCreate()
    parser.buffer_text = True  # Else each line end is a separate piece.
    document = _Element("", {}, 1)
    open_ones = [document]

    def error(reason: str) -> WorldFileError:
        return WorldFileError(f"{path}:{parser.CurrentLineNumber}: {reason}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = _Element(tag, attributes, parser.CurrentLineNumber)
        open_ones[-1].children.append(element)
        open_ones.append(element)
        if len(open_ones) > _DEEPEST:
            raise error("is nested too deeply")

    def end(_: str) -> None:
        open_ones.pop()

    def add(text: str) -> None:
        open_ones[-1].pieces.append(text)

    def reject(*_: object) -> None:
        raise error("must not have a document type, as that may define entities")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = add, reject
    try:
        parser.Parse(text, True)
    except WorldFileError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as reason:  # The last two: its encoding.
        raise error(f"is not XML: {reason}") from reason
    return document.children[0]


class _Reader:
    """Collects the obstacles of one file, and counts the parts left out."""

    def __init__(self, path: str, height: float) -> None:
        self._path = path
        self._height = height
        self.shapes: list[Shape] = []
        self.left_out: Counter[str] = Counter()

    def state(self, state: _Element | None) -> dict[str, _Element]:
        """Poses of models by name, if the file has them in a separate state."""
        models = () if state is None else state.all("model")
        places = ((model.attributes.get("name", ""), model.first("pose")) for model in models)
        return {name: pose for name, pose in places if pose is not None}

    def model(
        self, model: _Element, outer: _Pose, moved: _Element | None = None, static: bool = False
    ) -> None:
        """Collect the obstacles of a model and those in it."""
        flag = model.first("static")
        static |= flag is not None and flag.text.lower() in ("1", "true")
        inner = self._pose(moved or model.first("pose"))
        if not static:
            self.left_out["models that may move"] += 1
            return
        if inner is not None and model.attributes.get("placement_frame"):
            self.left_out["poses in named frames"] += 1
            inner = None
        self.left_out["includes"] += sum(1 for _ in model.all("include"))
        if inner is None:
            return
        place = outer @ inner
        for link in model.all("link"):
            inner = self._pose(link.first("pose"))
            for collision in link.all("collision") if inner is not None else ():
                own = self._pose(collision.first("pose"))
                if inner is not None and own is not None:
                    self._collision(collision, place @ inner @ own)
        for part in model.all("model"):
            self.model(part, place, static=static)

    def _pose(self, pose: _Element | None) -> _Pose | None:
        """Read a pose; None if it is of a kind that is left out."""
        if pose is None:
            return _Pose()
        if pose.attributes.get("frame") or pose.attributes.get("relative_to"):
            self.left_out["poses in named frames"] += 1
            return None
        if pose.attributes.get("rotation_format", "euler_rpy") != "euler_rpy":
            self.left_out["poses that are not written as roll, pitch and yaw"] += 1
            return None
        x, y, z, roll, pitch, yaw = self._numbers(pose, 6)
        if pose.attributes.get("degrees", "").strip().lower() in ("1", "true"):
            roll, pitch, yaw = (math.radians(angle) for angle in (roll, pitch, yaw))
        if max(abs(roll), abs(pitch)) > _STRAIGHT:
            self.left_out["tilted parts"] += 1
            return None
        return _Pose(x, y, z, yaw)

    def _collision(self, collision: _Element, pose: _Pose) -> None:
        """Collect the shape of a collision, if a robot can hit it."""
        geometry = collision.first("geometry")
        kinds = [] if geometry is None else geometry.children
        for kind in kinds:
            if kind.tag == "cylinder":
                radius, length = (
                    self._lengths(kind, "radius", 1)[0],
                    self._lengths(kind, "length", 1)[0],
                )
                if self._is_met(pose.z, length):
                    self.shapes.append(Cylinder(pose.x, pose.y, radius))
            elif kind.tag == "box":
                width, depth, tall = self._lengths(kind, "size", 3)
                if self._is_met(pose.z, tall):
                    try:
                        self.shapes.append(_turned_box(pose, width, depth))
                    except ValueError as error:  # A side vanishes beside where it is.
                        raise self._error(kind, str(error)) from error
            elif kind.tag != "plane":  # The ground.
                self.left_out[f"geometries of the kind {kind.tag}"] += 1

    def _is_met(self, middle: float, length: float) -> bool:
        """Tell whether a robot meets an upright shape with its middle at a height [m]."""
        return middle + length / 2 > _FLOOR and middle - length / 2 < self._height

    def _lengths(self, element: _Element, tag: str, count: int) -> list[float]:
        """Read positive numbers."""
        child = element.first(tag)
        if child is None:
            raise self._error(element, f"{element.tag} lacks {tag}")
        numbers = self._numbers(child, count)
        if min(numbers) <= 0.0:
            raise self._error(child, f"{tag} must be positive, got {child.text!r}")
        return numbers

    def _numbers(self, element: _Element, count: int) -> list[float]:
        """Read finite numbers."""
        numbers = [read_number(word) for word in element.text.split()]
        # Sums and squares of larger numbers are not finite.
        if len(numbers) != count or not all(abs(number) < _FARTHEST for number in numbers):
            raise self._error(
                element, f"{element.tag} must be {count} numbers, got {element.text!r}"
            )
        return numbers

    def _error(self, element: _Element, text: str) -> WorldFileError:
        """An error at the line of an element."""
        return WorldFileError(f"{self._path}:{element.line}: {text}")


def _turned_box(pose: _Pose, width: float, depth: float) -> Box | Polygon:
    """A box, or a polygon where its sides are not parallel to the axes."""
    quarters = round(pose.yaw / (math.pi / 2))
    if abs(pose.yaw - quarters * math.pi / 2) < _STRAIGHT:
        across, up = (width / 2, depth / 2) if quarters % 2 == 0 else (depth / 2, width / 2)
        return Box(pose.x - across, pose.y - up, pose.x + across, pose.y + up)
    corners = [(-width, -depth), (width, -depth), (width, depth), (-width, depth)]
    places = [pose @ _Pose(x / 2, y / 2) for x, y in corners]
    return Polygon(tuple((place.x, place.y) for place in places))


def _room(
    path: str,
    shapes: list[Shape],
    size: tuple[float, float] | None,
    center: tuple[float, float] | None,
) -> World:
    """Put a room around obstacles, and move them into its frame."""
    bounds = [shape.bounds for shape in shapes]
    if center is None:
        center = (0.0, 0.0)
        if bounds:
            center = (
                (min(b.x_min for b in bounds) + max(b.x_max for b in bounds)) / 2,
                (min(b.y_min for b in bounds) + max(b.y_max for b in bounds)) / 2,
            )
    x, y = center
    if size is None:
        half_width = max(max(b.x_max - x, x - b.x_min) for b in bounds)
        half_depth = max(max(b.y_max - y, y - b.y_min) for b in bounds)
        # Up to a millimeter wider, so that rounding leaves none outside.
        size = (math.ceil(2e3 * half_width) / 1e3, math.ceil(2e3 * half_depth) / 1e3)
        size = (size[0] + 1e-3, size[1] + 1e-3)
    moved = [_moved(shape, -x, -y) for shape in shapes]
    name = os.path.basename(path).split(".")[0]
    return World(
        name=name,
        size=size,
        boxes=tuple(shape for shape in moved if isinstance(shape, Box)),
        cylinders=tuple(shape for shape in moved if isinstance(shape, Cylinder)),
        polygons=tuple(shape for shape in moved if isinstance(shape, Polygon)),
    )


def _moved(shape: Shape, x: float, y: float) -> Shape:
    """The same shape elsewhere."""
    if isinstance(shape, Cylinder):
        return Cylinder(shape.x + x, shape.y + y, shape.radius)
    if isinstance(shape, Box):
        return Box(shape.x_min + x, shape.y_min + y, shape.x_max + x, shape.y_max + y)
    return Polygon(tuple((u + x, v + y) for u, v in shape.vertices))
