"""Maps of ROS: the image and the YAML file of its map_server, read and written.

A pixel's shade says how sure it is that something is there: p = (255 - shade) / 255, or shade / 255
with ``negate``. Above ``occupied_thresh`` it is occupied, below ``free_thresh`` free. What is in
between depends on ``mode``: with ``trinary`` it is unknown; with ``scale`` it is occupied from the
middle of the two thresholds, and pixels that are not wholly opaque are unknown. With ``raw`` shades
of 0 to 100 are p in percent, and above that unknown. With ``trinary`` the shade is the mean of all
channels, opacity included, as in the map_servers of ROS 1 and Nav2: transparent white is unknown.

With ``trinary`` and without ``negate`` the shade 205 is always unknown: ROS's own map_saver writes
it for unknown cells with a ``free_thresh`` of 0.25, under which it would be free.
"""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from mpfa_envs.files import cause_of, read_file
from mpfa_envs.worlds.shapes import LARGEST_SIDE, LONGEST_SIDE, MOST_CELLS, OccupancyGrid
from mpfa_envs.worlds.yaml_nodes import NodeReader, WorldFileError

Mode = Literal["trinary", "scale", "raw"]
"""Meanings of shades between the thresholds."""
Unknown = Literal["occupied", "free"]
"""Readings of unknown cells."""
_KEYS: Final = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
_FORMATS: Final = ("PPM", "PNG", "BMP")
"""Kinds of images; PGM is among the first."""
_LARGEST_IMAGE: Final = 2**28
"""Size of the largest image file that is read [bytes]."""
_MOST_PIXELS: Final = 2**26
"""Most pixels of an image, before it is cut to its free part."""
_WORDS: Final = {
    word: truth
    for truth, words in ((False, "0 n no off false"), (True, "1 y yes on true"))
    for word in words.split()
}
"""Values of ``negate``."""
_FINE, _CELL, _COARSE, _MANY = 0.01, 0.05, 0.25, 100
"""Least, usual and greatest side of a cell [m], the last in a map with more cells on a side."""
_QUARTERS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Cosine and sine of the quarter turns."""
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
    if unknown not in get_args(Unknown):
        raise ValueError(f"unknown must be one of {get_args(Unknown)}, got {unknown!r}")
    reader = _Reader(path)
    root = reader.read() if root is None else root
    entries = reader.mapping(root, "the file", _KEYS)
    for key in _KEYS[:-1]:
        if key not in entries:
            raise reader.error(root, "; ".join((f"{key} is missing", *reader.misspelt)))
    for text in reader.misspelt:
        warnings.warn(f"{text} It is ignored", stacklevel=3)
    resolution = reader.resolution(entries["resolution"])
    x, y, yaw = reader.origin(entries["origin"])
    rule = reader.rule(entries)
    shades, opacity = reader.image(entries["image"])
    quarters = round(yaw / (math.pi / 2))
    # No cell may be off by more than half a side.
    if abs(yaw - quarters * math.pi / 2) > min(1e-4, 0.5 / max(shades.shape)):
        raise reader.error(
            entries["origin"],
            "origin must have a yaw of 0 or a multiple of pi/2, as the cells lie along the axes, "
            f"got {yaw}",
        )
    marked = shades == _UNKNOWN
    if opacity is not None and rule.mode == "trinary":
        shades = ((3 * shades.astype(np.uint16) + opacity + 2) // 4).astype(np.uint8)
    occupied, free = _classify(shades, rule)
    marked &= free
    if rule.mode == "trinary" and not rule.negate and unknown == "occupied" and marked.any():
        free &= ~marked
        line = entries["free_thresh"].start_mark.line + 1
        warnings.warn(
            f"{path}:{line}: free_thresh = {rule.free} would make {marked.sum()} cells of shade "
            f"{_UNKNOWN} free, by which map_saver marks unknown cells: they are read as unknown; "
            f"write free_thresh: {0.196 if opacity is None else 0.147}, or pass unknown='free' if "
            "a robot may drive there",
            stacklevel=3,
        )
    if opacity is not None and rule.mode == "scale":
        occupied, free = occupied & (opacity == 255), free & (opacity == 255)
    if unknown == "free":
        free = ~occupied
    columns, rows = (np.flatnonzero(free.any(axis=axis)) for axis in (0, 1))
    if not len(columns):
        raise reader.error(entries["image"], "image must have a free cell, got none")
    # The image's first row is the top; ours is the bottom.
    top, bottom = max(rows[0] - 1, 0), min(rows[-1] + 2, len(free))
    left, right = max(columns[0] - 1, 0), min(columns[-1] + 2, free.shape[1])
    kept = np.rot90(~free[top:bottom, left:right][::-1].T, quarters)
    if resolution < _FINE or (resolution > _COARSE and max(kept.shape) > _MANY):
        wide, deep = np.multiply(kept.shape, resolution)
        meant = resolution / 10.0 ** round(math.log10(resolution / _CELL))
        text = f"resolution = {resolution:g} makes a room of {wide:.4g} x {deep:.4g} m"
        where = reader.error(entries["resolution"], text)
        warnings.warn(f"{where}; did you mean {meant:.4g}?", stacklevel=3)
    reader.check_size(entries["image"], kept.shape, resolution)
    cosine, sine = _QUARTERS[quarters % 4]
    ends = np.array([[left, len(free) - bottom], [right, len(free) - top]]) * resolution
    low = (ends @ [[cosine, sine], [-sine, cosine]]).min(axis=0)
    return OccupancyGrid(np.ascontiguousarray(kept), resolution, (x + low[0], y + low[1]))


def _classify(shades: NDArray[np.uint8], rule: _Rule) -> tuple[NDArray[np.bool_], ...]:
    """Return masks of the occupied and of the free cells; the others are unknown."""
    # Of each of the 256 shades once.
    shade = np.arange(256)
    if rule.mode == "raw":
        known, sure = shade <= 100, shade / 100
    else:
        known, sure = np.ones(256, np.bool_), (shade if rule.negate else 255 - shade) / 255
    occupied = known & (sure > rule.occupied)
    free = known & (sure < rule.free) & ~occupied
    if rule.mode == "scale":
        free |= ~occupied & (sure < (rule.occupied + rule.free) / 2)
        occupied = ~free
    return occupied[shades], free[shades]


class _Reader(NodeReader):
    """Reads the values of one map's YAML file, and its image."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.misspelt: list[str] = []

    def unknown(self, error: ValueError, hint: str, keys: tuple[str, ...]) -> None:
        """Ignore a key of another tool, as map_server does, and keep one that looks misspelt."""
        if hint:
            self.misspelt.append(f"{error}; {hint}")

    def resolution(self, node: yaml.Node) -> float:
        """Read the side of a cell [m]."""
        value = self.number(node, "resolution")
        if value <= 0.0:
            raise self.error(node, f"resolution must be positive, got {value}")
        return value

    def origin(self, node: yaml.Node) -> tuple[float, float, float]:
        """Read the pose of the lower left corner (x, y, yaw) [m, m, rad]."""
        values = self.items(node, "origin")
        if len(values) != 3:
            raise self.error(node, f"origin must be [x, y, yaw], got {len(values)} entries")
        x, y, yaw = (self.number(value, "origin", "") for value in values)
        return x, y, yaw

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
        if negate not in _WORDS:
            raise self.error(entries["negate"], f"negate must be 0 or 1, got {negate}")
        names = "free_thresh", "occupied_thresh"
        free, occupied = (self.number(entries[name], name, "") for name in names)
        if not 0.0 <= free < occupied <= 1.0:
            where = self.error(entries["free_thresh"], f"free_thresh = {free} should be below")
            text = f"{where} {occupied = }, both in [0, 1]: cells are read as by map_server"
            warnings.warn(text, stacklevel=4)
        return _Rule(mode, _WORDS[negate], occupied, free)

    def image(self, node: yaml.Node) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
        """Read the shades of an image ``[rows, columns]``, and its opacity if it has one."""
        name = self.text(node, "image")
        path = self.path.parent / name
        try:
            content = io.BytesIO(read_file(path, _LARGEST_IMAGE))
            with warnings.catch_warnings():
                # Pillow warns of sizes that are rejected below.
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                image = Image.open(content, formats=_FORMATS)
            with image:
                if math.prod(image.size) > _MOST_PIXELS:
                    text = f"image must have at most {_MOST_PIXELS} pixels, got {image.size}"
                    raise self.error(node, text)
                return _shades(image)
        except WorldFileError:
            raise
        except FileNotFoundError:
            beside = self.path.parent / re.split(r"[\\/]", name)[-1]
            hint = (
                f"; write image: {beside.name}, which lies next to it" if beside.is_file() else ""
            )
            text = f"image must be a file, and there is no {path}{hint}"
            raise self.error(node, text) from None
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            kinds = ", ".join(("PGM", *_FORMATS))
            text = f"image must be one of {kinds}, and {path} cannot be read: {cause_of(error)}"
            raise self.error(node, text) from error

    def check_size(self, node: yaml.Node, size: tuple[int, ...], resolution: float) -> None:
        """Reject a map that is too large."""
        if math.prod(size) > MOST_CELLS or max(size) > LONGEST_SIDE:
            raise self.error(
                node,
                f"image must have at most {MOST_CELLS} pixels in its free part, {LONGEST_SIDE} a "
                f"side, got {size}",
            )
        if max(size) * resolution > LARGEST_SIDE:
            raise self.error(
                node,
                f"image must be at most {LARGEST_SIDE:g} m wide and high in its free part, got "
                f"{size} pixels of {resolution} m",
            )


def _shades(image: Image.Image) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """The mean of the colors of each pixel ``[rows, columns]``, and its opacity if any has one."""
    if image.mode.startswith("I"):  # 16 bits
        steps = np.rint(np.arange(65536) / 65535 * 255).astype(np.uint8)
        return steps[np.clip(np.asarray(image), 0, 65535)], None
    is_opaque = "transparency" not in image.info
    if image.mode in ("L", "1") and is_opaque:
        return np.asarray(image.convert("L")), None
    is_opaque &= "A" not in image.mode
    colors = np.asarray(image.convert("RGBA"))
    thirds = np.rint(np.arange(766) / 3).astype(np.uint8)
    mean = thirds[colors[..., :3].sum(axis=2, dtype=np.uint16)]
    return mean, None if is_opaque else colors[..., 3]


def write_map(grid: OccupancyGrid, path: str | os.PathLike[str]) -> None:
    """Write cells as a map for ROS's map_server, the image next to the YAML file."""
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"path must end in .yaml, got {str(path)!r}")
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
