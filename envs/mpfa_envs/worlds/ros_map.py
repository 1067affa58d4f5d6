"""Maps of ROS: the image and the YAML file of its map_server, read and written.

A pixel's shade says how sure it is that something is there: p = (255 - shade) / 255, or shade / 255
with ``negate``. Above ``occupied_thresh`` it is occupied, below ``free_thresh`` free. What is in
between depends on ``mode``: with ``trinary`` it is unknown; with ``scale`` it is occupied from the
middle of the two thresholds, and transparent pixels are unknown. With ``raw`` shades of 0 to 100
are p in percent, and above that unknown.

With ``trinary`` and without ``negate`` the shade 205 is always unknown: ROS's own map_saver writes
it for unknown cells beside a ``free_thresh`` of 0.25, under which it would be free.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from mpfa_envs.checks import check_positive
from mpfa_envs.files import read_file
from mpfa_envs.worlds.occupancy import LONGEST_SIDE, MOST_CELLS, OccupancyGrid
from mpfa_envs.worlds.shapes import LARGEST_SIDE
from mpfa_envs.worlds.yaml_nodes import NodeReader, WorldFileError, read_nodes

if TYPE_CHECKING:
    from mpfa_envs.worlds.world import World

Mode = Literal["trinary", "scale", "raw"]
"""Meanings of shades between the thresholds."""
Unknown = Literal["occupied", "free"]
"""Readings of unknown cells."""
_KEYS: Final = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
_FORMATS: Final = ("PPM", "PNG", "BMP")
"""Kinds of images; PGM is among the first."""
_LARGEST_IMAGE: Final = 2**28
"""Size of the largest image file that is read [bytes]."""
_RESOLUTION: Final = 0.05
"""Side of a cell in maps of worlds with shapes [m]."""
_FREE: Final = 254
"""Shade of a free cell, as ROS's map_saver writes it."""
_UNKNOWN: Final = 205
"""Shade of an unknown cell there; p is 0.196."""


class _Rule(NamedTuple):
    """Rules that turn shades into cells."""

    mode: str
    negate: bool
    occupied: float
    free: float


def read_map(
    path: Path, root: yaml.Node | None = None, *, unknown: Unknown = "occupied"
) -> OccupancyGrid:
    """Read the cells of a map of ROS."""
    # The room ends one cell beyond the outermost free cells.
    if unknown not in get_args(Unknown):
        raise ValueError(f"unknown must be one of {get_args(Unknown)}, got {unknown!r}")
    root = read_nodes(path) if root is None else root
    reader = _Reader(path)
    entries = reader.mapping(root, "the file", _KEYS)
    for key in _KEYS[:-1]:
        if key not in entries:
            raise reader.error(root, f"{key} is missing")
    resolution = reader.resolution(entries["resolution"])
    x, y = reader.origin(entries["origin"])
    rule = reader.rule(entries)
    shades, clear = reader.image(entries["image"], resolution)
    occupied, free = _classify(shades, rule)
    marked = free & (shades == _UNKNOWN)
    if rule.mode == "trinary" and not rule.negate and unknown == "occupied" and marked.any():
        free &= ~marked
        line = entries["free_thresh"].start_mark.line + 1
        warnings.warn(
            f"{path}:{line}: free_thresh = {rule.free} would make {marked.sum()} cells of shade "
            f"{_UNKNOWN} free, by which map_saver marks unknown cells: they are read as unknown; "
            "write free_thresh: 0.196, or pass unknown='free' if a robot may drive there",
            stacklevel=2,
        )
    if clear is not None and rule.mode == "scale":
        occupied, free = occupied & ~clear, free & ~clear
    if unknown == "free":
        free = ~occupied
    columns, rows = (np.flatnonzero(free.any(axis=axis)) for axis in (0, 1))
    if not len(columns):
        raise reader.error(entries["image"], "image must have a free cell, got none")
    # The image's first row is the top; ours is the bottom.
    top, bottom = max(rows[0] - 1, 0), min(rows[-1] + 2, len(free))
    left, right = max(columns[0] - 1, 0), min(columns[-1] + 2, free.shape[1])
    kept = ~free[top:bottom, left:right]
    corner = x + float(left) * resolution, y + float(len(free) - bottom) * resolution
    return OccupancyGrid(np.ascontiguousarray(kept[::-1].T), resolution, corner)


def _classify(shades: NDArray[np.uint8], rule: _Rule) -> tuple[NDArray[np.bool_], ...]:
    """Tell which cells are occupied and which are free; those that are neither are unknown."""
    # Of each of the 256 shades once.
    shade = np.arange(256)
    if rule.mode == "raw":
        known, sure = shade <= 100, shade / 100
    else:
        known, sure = np.ones(256, np.bool_), (shade if rule.negate else 255 - shade) / 255
    occupied, free = known & (sure > rule.occupied), known & (sure < rule.free)
    if rule.mode == "scale":
        occupied = sure >= (rule.occupied + rule.free) / 2
        free = ~occupied
    return occupied[shades], free[shades]


class _Reader(NodeReader):
    """Reads the values of one map's YAML file, and its image."""

    def resolution(self, node: yaml.Node) -> float:
        """Read the side of a cell [m]."""
        value = self.number(node, "resolution")
        if value <= 0.0:
            raise self.error(node, f"resolution must be positive, got {value}")
        return value

    def origin(self, node: yaml.Node) -> tuple[float, float]:
        """Read the position of the lower left corner (x, y) [m]."""
        values = self.items(node, "origin")
        if len(values) != 3:
            raise self.error(node, f"origin must be [x, y, yaw], got {len(values)} entries")
        x, y, yaw = (self.number(value, "origin", "") for value in values)
        if yaw != 0.0:
            raise self.error(
                node, f"origin must have a yaw of 0, as the cells lie along the axes, got {yaw}"
            )
        return x, y

    def rule(self, entries: Mapping[str, yaml.Node]) -> _Rule:
        """Read the rule that turns shades into cells."""
        mode = "trinary"
        if "mode" in entries:
            mode = self.text(entries["mode"], "mode")
            if mode not in get_args(Mode):
                raise self.error(
                    entries["mode"], f"mode must be one of {get_args(Mode)}, got {mode}"
                )
        negate = self.text(entries["negate"], "negate").lower()
        if negate not in ("0", "1", "false", "true"):
            raise self.error(entries["negate"], f"negate must be 0 or 1, got {negate}")
        names = "free_thresh", "occupied_thresh"
        free, occupied = (self.number(entries[name], name, "") for name in names)
        for name, value in zip(names, (free, occupied), strict=True):
            if not 0.0 <= value <= 1.0:
                raise self.error(entries[name], f"{name} must be in [0, 1], got {value}")
        if free >= occupied:
            node = entries["free_thresh"]
            raise self.error(node, f"free_thresh must be below {occupied = }, got {free}")
        return _Rule(mode, negate in ("1", "true"), occupied, free)

    def image(
        self, node: yaml.Node, resolution: float
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """Read the shades of an image ``[rows, columns]``, and which pixels are transparent."""
        path = self.path.parent / self.text(node, "image")
        try:
            content = io.BytesIO(read_file(path, _LARGEST_IMAGE))
            with warnings.catch_warnings():
                # Pillow warns of sizes that are rejected below.
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                image = Image.open(content, formats=_FORMATS)
            with image:
                self._check_size(node, image.size, resolution)
                return _shades(image)
        except WorldFileError:
            raise
        except FileNotFoundError:
            raise self.error(node, f"image must be a file, and there is no {path}") from None
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            kinds = ", ".join(("PGM", *_FORMATS))
            text = f"image must be one of {kinds}, and {path} cannot be read: {error}"
            raise self.error(node, text) from error

    def _check_size(self, node: yaml.Node, size: tuple[int, int], resolution: float) -> None:
        """Reject an image that is too large, before it is read."""
        if size[0] * size[1] > MOST_CELLS or max(size) > LONGEST_SIDE:
            raise self.error(
                node,
                f"image must have at most {MOST_CELLS} pixels, {LONGEST_SIDE} a side, got {size}",
            )
        if max(size) * resolution > LARGEST_SIDE:
            raise self.error(
                node,
                f"image must be at most {LARGEST_SIDE:g} m wide and high, got {size} pixels of "
                f"{resolution} m",
            )


def _shades(image: Image.Image) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The mean of the colors of each pixel ``[rows, columns]``, and which are transparent."""
    if image.mode.startswith("I"):  # 16 bits
        values = np.asarray(image, dtype=np.float64)
        return np.rint(np.clip(values / 65535, 0.0, 1.0) * 255).astype(np.uint8), None
    if image.mode in ("L", "1"):
        return np.asarray(image.convert("L")), None
    colors = np.asarray(image.convert("RGBA"))
    mean = np.rint(colors[..., :3].mean(axis=2)).astype(np.uint8)
    return mean, colors[..., 3] == 0


def save_map(
    world: World, path: str | os.PathLike[str], *, resolution: float | None = None
) -> None:
    """Write the obstacles of a world as a map for ROS's map_server."""
    # The cells of a map are written as they are, and :meth:`~mpfa_envs.World.from_map` reads an
    # equal world. Of shapes a cell is occupied if its middle is within half a cell of an obstacle,
    # and walls are one cell thick, so that nothing thin is lost. Walkers and regions are not in a
    # map.
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"path must end in .yaml, got {str(path)!r}")
    own = world.occupancy
    if own is not None and not world.obstacles and resolution in (None, own.resolution):
        grid = own
    else:
        grid = _rasterize(world, resolution or (own.resolution if own else _RESOLUTION))
    shades = np.where(grid.occupied.T[::-1], 0, _FREE).astype(np.uint8)
    content = {
        "image": path.with_suffix(".pgm").name,
        "resolution": float(grid.resolution),
        "origin": [*map(float, grid.origin), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        "mode": "trinary",
    }
    Image.fromarray(shades).save(path.with_suffix(".pgm"), format="PPM")
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    path.write_text(text, encoding="utf-8")


def _rasterize(world: World, resolution: float) -> OccupancyGrid:
    """Cover a room and its walls with cells, and find the occupied ones."""
    check_positive("resolution", resolution)
    sides = [int(np.ceil(round(side / resolution, 6))) + 2 for side in world.size]
    if sides[0] * sides[1] > MOST_CELLS or max(sides) > LONGEST_SIDE:
        raise ValueError(
            f"resolution must leave at most {MOST_CELLS} cells in {world.size} m, got {resolution}"
        )
    xs, ys = (resolution * (np.arange(count) - (count - 1) / 2) for count in sides)
    points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    near = world.clearances(points).reshape(sides[0], sides[1]) < resolution / 2 - 1e-9
    center = world.occupancy.center if world.occupancy else (0.0, 0.0)
    corner = tuple(at - side * resolution / 2 for at, side in zip(center, sides, strict=True))
    return OccupancyGrid(near, resolution, (corner[0], corner[1]))
