"""SDF files: their elements with lines, the models that they include, and the solids of these.

A solid is upright: from a turned shape, on a floor, in a room around all of them.
"""

from __future__ import annotations

import gzip
import io
import math
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.files import cause_of, read_file
from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon, Shape
from mpfa_envs.worlds.world import World
from mpfa_envs.worlds.yaml_nodes import WorldFileError, read_number

LARGEST_FILE: Final = 20_000_000
"""Longest text that is read [bytes]."""
_DEEPEST: Final = 100
"""Greatest depth of nested elements."""
_MOST_ELEMENTS: Final = 500_000
"""Most elements of a file with all that it includes."""
_MARKS: Final = re.compile(
    rb"<!--.*?(?:-->|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<\?.*?(?:\?>|\Z)", re.DOTALL
)
"""Comments, quoted text and declarations; one without an end is tried once."""
_AMPERSAND: Final = re.compile(rb"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[\da-fA-F]+);)")
"""An ampersand that begins no character."""
_STAGE: Final = re.compile(rb"^\s*(?:define\s+\w+\s+)?\w+\s*\(", re.MULTILINE)
"""A part of a world of Stage, whose files have the same ending."""
_OF_STAGE: Final = (
    "is a world of Stage, not of Gazebo: give its bitmap as a ROS map, a .yaml file with the keys "
    "image, resolution, origin, negate, occupied_thresh and free_thresh"
)
_JUNK: Final = expat.errors.codes[expat.errors.XML_ERROR_JUNK_AFTER_DOC_ELEMENT]


@dataclass(slots=True)
class Element:
    """An element of a file, with its line."""

    path: str
    tag: str
    attributes: dict[str, str]
    line: int
    pieces: list[str] = field(default_factory=list)
    children: list[Element] = field(default_factory=list)

    @property
    def text(self) -> str:
        """Text between its children."""
        return "".join(self.pieces).strip()

    def all(self, tag: str) -> Iterator[Element]:
        """Its children with a tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """Its first child with a tag; None without one."""
        return next(self.all(tag), None)

    def count(self, tag: str) -> int:
        """Count the elements with a tag in it, itself included."""
        return (self.tag == tag) + sum(child.count(tag) for child in self.children)

    def error(self, text: str) -> WorldFileError:
        """An error at its line."""
        return WorldFileError(f"{self.path}:{self.line}: {text}")


class SdfFiles:
    """Parses a file and those that it includes, which must lie in one of some folders."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = [folder.resolve() for folder in folders]
        self._elements = 0
        self._models: dict[Path, tuple[Element | None, int]] = {}

    def parse(self, path: str, text: bytes) -> Element:
        """Read the elements; a document type, which could define entities, is rejected."""
        parser = expat.ParserCreate(_older_encoding(text))
        parser.buffer_text = True  # Else each line end is a separate piece.
        document = Element(path, "", {}, 1)
        open_ones = [document]

        def error(reason: str) -> WorldFileError:
            return WorldFileError(f"{path}:{parser.CurrentLineNumber}: {reason}")

        def start(tag: str, attributes: dict[str, str]) -> None:
            element = Element(path, tag, attributes, parser.CurrentLineNumber)
            open_ones[-1].children.append(element)
            open_ones.append(element)
            if len(open_ones) > _DEEPEST:
                raise error("is nested too deeply")
            self._spend(element, 1)

        def end(_: str) -> None:
            open_ones.pop()

        def add(text: str) -> None:
            open_ones[-1].pieces.append(text)

        def reject(*_: object) -> None:
            raise error("must not have a document type, as that may define entities")

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = add, reject
        try:
            parser.Parse(_strict(text), True)
        except WorldFileError:
            raise
        except (expat.ExpatError, LookupError, ValueError) as reason:  # The last two: its encoding.
            if getattr(reason, "code", None) != _JUNK:
                stage = b"<" not in text and _STAGE.search(text)
                what = _OF_STAGE if stage else f"is not XML: {reason}"
                raise error(what) from reason
        return document.children[0]

    def included(self, include: Element) -> Element | None:
        """Read the model of an include, with what the include changes; None if there is none."""
        self._spend(include, 100)  # A look into the folders takes as long as a hundred elements.
        uri = include.first("uri")
        path = None if uri is None else self._locate(uri.text)
        if path is None:
            return None
        if path in self._models:
            self._spend(include, self._models[path][1])
        else:
            before = self._elements
            root = self.parse(str(path), read_sdf(path))
            model = root.first("model") if root.tag == "sdf" else None
            self._models[path] = model, self._elements - before
        model = self._models[path][0]
        if model is None:
            return None
        own = {child.tag: child for child in include.children}
        attributes = dict(model.attributes)
        attributes |= {tag: own[tag].text for tag in ("name", "placement_frame") if tag in own}
        changes = [own[tag] for tag in ("pose", "static") if tag in own]
        return replace(model, attributes=attributes, children=[*changes, *model.children])

    def _spend(self, element: Element, count: int) -> None:
        """Count elements that are read, or read once more."""
        self._elements += count
        if self._elements > _MOST_ELEMENTS:
            raise element.error(
                f"has more than {_MOST_ELEMENTS} elements with all that is included"
            )

    def _locate(self, uri: str) -> Path | None:
        """Find the file of a model in a search folder; None for one elsewhere."""
        scheme, _, name = uri.rpartition("://")
        if scheme not in ("model", "file", "") or not name:
            return None
        for folder in self._folders:
            try:
                place = _inside(folder, name)
                if place is not None and place.is_dir():
                    config = _inside(folder, str(place / "model.config"))
                    sdf = "model.sdf" if config is None else self._newest(config)
                    place = _inside(folder, str(place / sdf))
                if place is not None and place.is_file():
                    return place
            except (OSError, RuntimeError):  # A name that is too long, or links in a circle.
                continue
        return None

    def _newest(self, config: Path) -> str:
        """Name the file of the newest version in a ``model.config``."""
        files = self.parse(str(config), read_sdf(config)).all("sdf")
        versions = {read_number(each.attributes.get("version", "0")): each.text for each in files}
        return versions[max(versions)] if versions else "model.sdf"


def read_sdf(path: Path) -> bytes:
    """Read a file, decompressed if it ends in .gz, up to the largest size."""
    try:
        content = read_file(path, LARGEST_FILE)
        if path.suffix.lower() == ".gz":
            content = gzip.GzipFile(fileobj=io.BytesIO(content)).read(LARGEST_FILE + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise WorldFileError(f"{path}: cannot be read: {cause_of(error)}") from error
    if len(content) > LARGEST_FILE:
        raise WorldFileError(f"{path}: has more than {LARGEST_FILE} bytes")
    return content


def _inside(folder: Path, name: str) -> Path | None:
    """Resolve a name in a folder; None if nothing is there, or it leads out of the folder."""
    place = (folder / name).resolve()
    return place if place.is_relative_to(folder) and place.exists() else None


def _older_encoding(text: bytes) -> str | None:
    """Name the encoding of a file that is neither UTF-8 nor UTF-16; None if it says it itself."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return None if b"\0" in text[:4] else "iso-8859-1"
    return None


def _strict(text: bytes) -> bytes:
    """Rewrite what TinyXML2 takes and Expat does not, without moving a line."""
    if b"\0" in text[:4]:  # UTF-16.
        return text
    declarations: list[bytes] = []

    def blank(mark: re.Match[bytes]) -> bytes:
        found = mark[0]
        if found.startswith(b"<![") or not found.endswith((b"-->", b"?>")):
            return found
        if re.match(rb"<\?xml\s", found):
            declarations.append(b" ".join(found.split()))
        return b"\n" * found.count(b"\n")

    text = _AMPERSAND.sub(b"&amp;", _MARKS.sub(blank, text))
    begins = max(text.find(b"<"), 0)
    return b"".join((*declarations[:1], b"\n" * text.count(b"\n", 0, begins), text[begins:]))


Array = NDArray[np.float64]

STEP: Final = 0.01
"""A robot drives over steps up to this height [m]."""
_STRAIGHT: Final = 1e-5
"""A turn differs less from a quarter that is written with five digits [rad]."""
_TILT: Final = 0.025
"""A shape that is tilted by less counts as upright [rad]."""
_THIN: Final = 0.01
"""Thickness of the wall that an upright plane is [m]."""
_WIDE: Final = 0.75
"""Least share of the world under which a floor lies; a disc has 0.785 of the square around it."""


class Solid(NamedTuple):
    """A footprint between two heights [m]."""

    shape: Shape
    bottom: float
    top: float


def pose_matrix(
    x: float, y: float, z: float, roll: float, pitch: float, yaw: float
) -> NDArray[np.float64]:
    """Write a pose of SDF [m, rad] as a matrix, ``[4, 4]``."""
    matrix = np.eye(4)
    for axis, angle in enumerate((roll, pitch, yaw)):
        turn, (one, other) = np.eye(4), ((1, 2), (2, 0), (0, 1))[axis]
        turn[one, one] = turn[other, other] = math.cos(angle)
        turn[other, one] = math.sin(angle)
        turn[one, other] = -turn[other, one]
        matrix = turn @ matrix
    matrix[:3, 3] = x, y, z
    return matrix


def box_of(pose: Array, sides: Array) -> Solid | None:
    """A box, any side up; None if it is tilted."""
    for up, (along, across) in enumerate(((1, 2), (0, 2), (0, 1))):
        if abs(pose[2, up]) >= math.cos(_TILT):
            return _prism(pose, pose[:2, along], sides[along], sides[across], sides[up])
    return None


def cylinder_of(pose: Array, radius: float, length: float) -> Solid | None:
    """A cylinder that stands, or the box around one that lies; None if it is tilted."""
    x, y, z = pose[:3, 3].tolist()
    if abs(pose[2, 2]) >= math.cos(_TILT):
        return Solid(Cylinder(x, y, float(radius)), z - length / 2, z + length / 2)
    if abs(pose[2, 2]) <= math.sin(_TILT):
        return _prism(pose, pose[:2, 2], length, 2 * radius, 2 * radius)
    return None


def plane_of(pose: Array, normal: Array, size: Array) -> Solid | float | None:
    """A thin wall, or the height of a level plane [m]; None if it is tilted."""
    # The shortest turn from z to the normal, as in Gazebo, says how the plane's sides lie.
    a, b, c = normal / np.linalg.norm(normal)
    half = (1.0 - c) / (a * a + b * b) if a * a + b * b else 0.0
    sides = pose[:3, :3] @ [
        [1 - half * a * a, -half * a * b],
        [-half * a * b, 1 - half * b * b],
        [-a, -b],
    ]
    facing = pose[:3, :3] @ (a, b, c)
    if abs(facing[2]) >= math.cos(_TILT):
        return float(pose[2, 3])
    if abs(facing[2]) <= math.sin(_TILT):
        along = np.array([-facing[1], facing[0]])
        length = np.abs(along @ sides[:2]) @ size
        return _prism(pose, along, length, _THIN, np.abs(sides[2]) @ size)
    return None


def _prism(pose: Array, direction: Array, along: float, across: float, tall: float) -> Solid:
    """A rectangle between two heights, a polygon where its sides are not parallel to the axes."""
    x, y, z = pose[:3, 3].tolist()
    yaw = math.atan2(direction[1], direction[0])
    quarters = round(yaw / (math.pi / 2))
    u, v = along / 2, across / 2
    shape: Shape
    if abs(yaw - quarters * math.pi / 2) < _STRAIGHT:
        u, v = (u, v) if quarters % 2 == 0 else (v, u)
        shape = Box(float(x - u), float(y - v), float(x + u), float(y + v))
    else:
        c, s = math.cos(yaw), math.sin(yaw)
        corners = (-u, -v), (u, -v), (u, v), (-u, v)
        shape = Polygon(tuple((x + c * p - s * q, y + s * p + c * q) for p, q in corners))
    return Solid(shape, float(z - tall / 2), float(z + tall / 2))


def floor_of(solids: Sequence[Solid], grounds: Sequence[float], least: float = 0.0) -> float:
    """Find the height on which everything else stands [m], from solids and level planes."""
    # A floor has the least area [m²] or more: a pedestal in a hall is none.
    # The floor is the lowest of the ground, 0, and of what is as wide as the world, on which
    # something stands. From there it rises to whatever else is as wide, lies on it, and has most of
    # what is higher on it.
    if not solids:
        return 0.0
    bottoms, tops = np.array([(solid.bottom, solid.top) for solid in solids]).T
    bounds = np.array([solid.shape.bounds for solid in solids])
    outlines = [_outline(solid.shape) for solid in solids]
    order = np.argsort(tops)
    parts = np.split(order, np.flatnonzero(np.diff(tops[order]) > STEP) + 1)
    levels = [(float(tops[part].max()), float(bottoms[part].min()), part) for part in parts]
    levels += [(height, -math.inf, order[:0]) for height in grounds]

    def area_above(height: float) -> float:
        return _hull_area([outlines[k] for k in np.flatnonzero(tops > height)])

    def is_wide(part: NDArray[np.int64], area: float) -> bool:
        shapes = {solids[k].shape for k in part}  # The same one may be there twice.
        return not shapes or sum(shape.area for shape in shapes) >= max(_WIDE * area, least)

    area = area_above(-math.inf)
    floors = [0.0, *(top for top, _, part in levels if is_wide(part, area))]
    floor = min((at for at in floors if (abs(bottoms - at) <= STEP).any()), default=0.0)
    area = area_above(floor + STEP)
    for top, bottom, part in sorted(levels, key=lambda level: level[0]):
        higher = bounds[tops > top + STEP]
        rest = np.count_nonzero(tops > floor + STEP) - len(part)
        if top > floor >= bottom - STEP and 0 < rest <= 2 * len(higher) and is_wide(part, area):
            low = bounds[part, :2].min(axis=0, initial=math.inf) - STEP
            high = bounds[part, 2:].max(axis=0, initial=-math.inf) + STEP
            on = (higher[:, :2] <= high).all(axis=1) & (higher[:, 2:] >= low).all(axis=1)
            if not len(part) or on.mean() >= 0.5:
                floor, area = top, area_above(top + STEP)
    return floor


def _outline(shape: Shape) -> Array:
    """Corners of a shape, or of the square around a cylinder, ``[corners, 2]`` [m]."""
    if isinstance(shape, Polygon):
        return np.array(shape.vertices)
    left, low, right, high = shape.bounds
    return np.array([(left, low), (right, low), (right, high), (left, high)])


def _hull_area(outlines: Sequence[Array]) -> float:
    """Area of the convex hull of outlines [m²], infinite where it has none."""
    # Imported here because it takes long, and most worlds come from elsewhere.
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(np.concatenate(outlines)).volume)
    except (QhullError, ValueError):  # No outline, or one without an area.
        return math.inf


def room_around(
    name: str,
    shapes: Sequence[Shape],
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
