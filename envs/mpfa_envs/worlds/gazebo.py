"""Worlds of Gazebo (SDF): the boxes, cylinders and upright planes of their static models."""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.worlds.sdf import (
    STEP,
    Element,
    SdfFiles,
    Solid,
    box_of,
    cylinder_of,
    floor_of,
    plane_of,
    pose_matrix,
    read_sdf,
    room_around,
)
from mpfa_envs.worlds.world import World
from mpfa_envs.worlds.world_file import has_room
from mpfa_envs.worlds.yaml_nodes import WorldFileError, read_number

Array = NDArray[np.float64]

_FARTHEST: Final = 1e9
"""Numbers must be smaller than this [m, rad]."""
_NARROWEST: Final = 0.1
"""The smallest robot needs this clearance [m]."""
_MOST_SOLIDS: Final = 5_000
"""Most shapes, of which at most 1,000 may be obstacles."""
_INCLUDES: Final = 20
"""Greatest depth of models that include models."""
_FOLDERS: Final = ("GAZEBO_MODEL_PATH", "GZ_SIM_RESOURCE_PATH")
"""Variables of the environment that list folders of models."""
_MOVABLE: Final = ("models that may move", "actors")
"""Parts that are no part of the room."""


def load_gazebo_world(
    path: str | os.PathLike[str],
    *,
    size: tuple[float, float] | None = None,
    center: tuple[float, float] | None = None,
    height: float = 0.5,
    model_paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
) -> World:
    """Read the boxes, cylinders and upright planes of a Gazebo world.

    They are those of the collisions of static models, included and nested ones as well, where and
    as large as the ``state`` of the file has them. What lies under everything else is the floor. A
    warning counts the collisions that are read, and the parts that are left out: includes that are
    not found, models that may move, meshes and other geometry, tilted parts, poses in named frames,
    and poses with a quaternion.

    Args:
        path: A ``.world`` or ``.sdf`` file, or one that is compressed (``.gz``).
        size: Width and depth of the room [m]. None: as large as the obstacles need.
        center: Middle of the room in the file (x, y) [m]. None: that of the obstacles.
        height: Shapes that begin higher above the floor are no obstacles [m], nor are those in it.
        model_paths: Folder or folders of the models of ``model://`` and ``file://``, besides the
            file's, ``models`` in it, and those of GAZEBO_MODEL_PATH and GZ_SIM_RESOURCE_PATH.
            Nothing outside them is read.

    Returns:
        The world, with the name of the file.

    Raises:
        WorldFileError: If a file cannot be read, is no SDF, or defines entities, the obstacles do
            not fit in the room, no robot fits, or without a size most of the room is left out.
    """
    path = Path(path)
    listed = [folder for name in _FOLDERS for folder in os.environ.get(name, "").split(os.pathsep)]
    given = (model_paths,) if isinstance(model_paths, (str, os.PathLike)) else model_paths
    beside = path.parent, path.parent / "models"
    folders = [*map(Path, given), *beside, *map(Path, filter(None, listed))]
    text, name = read_sdf(path), str(path)
    return read_gazebo_world(text, name, size=size, center=center, height=height, folders=folders)


def read_gazebo_world(
    text: bytes,
    path: str,
    *,
    size: tuple[float, float] | None,
    center: tuple[float, float] | None,
    height: float = 0.5,
    folders: Sequence[Path] = (),
) -> World:
    """Read the text of a file; ``path`` names it in errors, and the world."""
    least = 0.0 if size is None else World(name="room", size=size).room.area / 10
    files = SdfFiles(folders)
    root = files.parse(path, text)
    world = root.first("world") if root.tag == "sdf" else None
    if world is None:
        raise root.error("must be an sdf element with a world in it")
    reader = _Reader(files)
    reader.read_world(root, world)
    floor = floor_of(reader.solids, reader.grounds, least)
    shapes = [
        solid.shape
        for solid in reader.solids
        if solid.top > floor + STEP and solid.bottom < floor + height
    ]
    found = reader.summary()
    if size is None and not shapes:
        raise world.error(f"has no obstacle, and so no size; {found}")
    if size is None and reader.lost > len(shapes):
        raise world.error(f"is mostly left out; pass a size to read it all the same; {found}")
    try:
        room = room_around(os.path.basename(path).split(".")[0], shapes, size, center)
    except ValueError as error:
        raise WorldFileError(f"{path}: {error}; {found}") from error
    if has_room(room, room.room, _NARROWEST) is False:
        raise world.error(f"has no room for a robot in its {room.size} m; {found}")
    if reader.left_out:
        warnings.warn(f"{path}: {found}", stacklevel=3)
    return room


class _Reader:
    """Collects the solids of one world, and counts the parts left out."""

    def __init__(self, files: SdfFiles) -> None:
        self._files = files
        self.solids: list[Solid] = []
        self.grounds: list[float] = []
        """Heights of level planes [m]."""
        self.left_out: Counter[str] = Counter()
        self.lost = 0
        """Number of collisions and includes of the room that are left out."""
        self._total = self._read = self._explained = 0

    def read_world(self, root: Element, world: Element) -> None:
        """Collect the solids of a world, and account for all collisions of the file."""
        self._total += root.count("collision")
        self._parts(world, np.eye(4), False, _models_of(world.first("state")), 0)
        for actor in world.all("actor"):
            self._leave("actors", actor)
        others = self._total - self._read - self._explained
        if others > 0:
            self.left_out["other collisions"] += others

    def summary(self) -> str:
        """Elements that are read and elements that are left out."""
        parts = ", ".join(f"{count} {what}" for what, count in self.left_out.items())
        return f"read {self._read} of {self._total} collisions, left out {parts or 'nothing'}"

    def _leave(self, what: str, part: Element) -> None:
        """Count a part that is left out, and the collisions in it."""
        self.left_out[what] += 1
        count = part.count("collision")
        self._explained += count
        self.lost += 0 if what in _MOVABLE else count

    def _parts(
        self, owner: Element, place: Array, static: bool, states: Mapping[str, Element], depth: int
    ) -> None:
        """Collect the solids of the models and includes in a world or model."""
        for part in owner.children:
            if part.tag == "model":
                self._model(part, place, static, states, depth)
            elif part.tag == "include":
                if depth >= _INCLUDES:
                    raise part.error(f"is in more than {_INCLUDES} includes, maybe in a circle")
                model = self._files.included(part)
                if model is None:
                    uri = part.first("uri")
                    self._leave("includes", part)
                    self.lost += uri is None or not uri.text.endswith(("sun", "ground_plane"))
                else:
                    self._total += model.count("collision")
                    self._model(model, place, static, states, depth + 1)

    def _model(
        self,
        model: Element,
        outer: Array,
        static: bool,
        states: Mapping[str, Element],
        depth: int,
    ) -> None:
        """Collect the solids of a model and those in it."""
        flag = model.first("static")
        if not (static or (flag is not None and flag.text.lower() in ("1", "true"))):
            return self._leave("models that may move", model)
        if model.attributes.get("placement_frame"):
            return self._leave("poses in named frames", model)
        state = states.get(model.attributes.get("name", ""))
        moved, scale = None, np.ones(3)
        if state is not None:
            moved = state.first("pose")
            scale = self._lengths(state, 3, "scale") if state.first("scale") else scale
        inner = self._pose(model, moved)
        if inner is None:
            return None
        place = inner if moved is not None else outer @ inner  # That of a state is in the world.
        for link in model.all("link"):
            inner = self._pose(link)
            for collision in link.all("collision") if inner is not None else ():
                own = self._pose(collision)
                if inner is not None and own is not None:
                    self._collision(collision, place @ inner @ own, scale)
        return self._parts(model, place, True, _models_of(state), depth)

    def _pose(self, owner: Element, moved: Element | None = None) -> Array | None:
        """Read the pose of a part, ``[4, 4]``; None if it is of a kind that is left out."""
        pose = moved or owner.first("pose")
        if pose is None:
            return np.eye(4)
        if pose.attributes.get("frame") or pose.attributes.get("relative_to"):
            self._leave("poses in named frames", owner)
            return None
        if pose.attributes.get("rotation_format", "euler_rpy") != "euler_rpy":
            self._leave("poses that are not written as roll, pitch and yaw", owner)
            return None
        x, y, z, *angles = self._numbers(pose, 6)
        if pose.attributes.get("degrees", "").strip().lower() in ("1", "true"):
            angles = [math.radians(angle) for angle in angles]
        return pose_matrix(x, y, z, *angles)

    def _collision(self, collision: Element, pose: Array, scale: Array) -> None:
        """Collect the solid of a collision."""
        geometry = collision.first("geometry")
        kind = next(iter(geometry.children if geometry else ()), None)
        if kind is None or kind.tag not in ("box", "cylinder", "plane"):
            what = "none" if kind is None else kind.tag
            return self._leave(f"geometries of the kind {what}", collision)
        solid: Solid | float | None
        try:
            if kind.tag == "box":
                solid = box_of(pose, scale * self._lengths(kind, 3, "size"))
            elif kind.tag == "cylinder":
                radius, length = (self._lengths(kind, 1, tag)[0] for tag in ("radius", "length"))
                solid = cylinder_of(pose, radius * max(scale[:2]), length * scale[2])
            else:
                solid = self._plane(kind, pose, scale)
        except WorldFileError:
            raise
        except ValueError as error:  # A side vanishes beside where it is.
            raise kind.error(str(error)) from error
        if solid is None:
            return self._leave("tilted parts", collision)
        self._read += 1
        if isinstance(solid, Solid):
            self.solids.append(solid)
        else:
            self.grounds.append(solid)
        if len(self.solids) > _MOST_SOLIDS:
            raise collision.error(f"has more than {_MOST_SOLIDS} shapes with all that is included")

    def _plane(self, plane: Element, pose: Array, scale: Array) -> Solid | float | None:
        """Read a plane, which may lack its normal and its size."""
        normal, size = plane.first("normal"), plane.first("size")
        facing = np.array([0.0, 0.0, 1.0] if normal is None else self._numbers(normal, 3))
        if normal is not None and not np.linalg.norm(facing) > 0.0:
            raise normal.error(f"normal must not be zero, got {normal.text!r}")
        sides = np.ones(2) if size is None else np.array(self._lengths(plane, 2, "size"))
        return plane_of(pose, facing, sides * scale[:2])

    def _lengths(self, element: Element, count: int, tag: str) -> Array:
        """Read positive numbers of a child."""
        child = element.first(tag)
        if child is None:
            raise element.error(f"{element.tag} lacks {tag}")
        numbers = self._numbers(child, count)
        if min(numbers) <= 0.0:
            raise child.error(f"{tag} must be positive, got {child.text!r}")
        return np.array(numbers)

    def _numbers(self, element: Element, count: int) -> list[float]:
        """Read finite numbers."""
        numbers = [read_number(word) for word in element.text.split()]
        # Sums and squares of larger numbers are not finite.
        if len(numbers) != count or not all(abs(number) < _FARTHEST for number in numbers):
            raise element.error(f"{element.tag} must be {count} numbers, got {element.text!r}")
        return numbers


def _models_of(state: Element | None) -> dict[str, Element]:
    """The models in a state, by name."""
    models = () if state is None else state.all("model")
    return {model.attributes.get("name", ""): model for model in models}
