"""Worlds of the BARN benchmark, and its task.

BARN, Benchmark for Autonomous Robot Navigation (Perille et al. 2020,
https://arxiv.org/abs/2008.13315), has three hundred fields of cylinders. Twenty come with the
package, every fifteenth of the published ones, which grow denser; ``data/barn/LICENSE.txt`` is
their license. :func:`load_barn` reads all of them from the benchmark's archive. The benchmark's
robot is a Jackal of 0.51 x 0.43 m with up to 2 m/s, ours a disc of 0.18 m radius with
up to 0.5 m/s: rates of success are of another task than those of the benchmark's table.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count
from mpfa_envs.files import cause_of, read_file
from mpfa_envs.worlds.gazebo import read_gazebo_world
from mpfa_envs.worlds.sdf import LARGEST_FILE
from mpfa_envs.worlds.world import Box, Cylinder, Task, World
from mpfa_envs.worlds.yaml_nodes import WorldFileError

BARN_WORLDS: Final = tuple(range(5, 300, 15))
"""Numbers of the worlds in the benchmark."""
_FILE: Final = Path(__file__).parents[1] / "data" / "barn" / "barn_sample.npz"
_RADIUS: Final = 0.075
_CENTER: Final = (-2.25, 7.0)
"""Middle of the room in the benchmark's coordinates [m]."""
_SIZE: Final = (10.0, 15.0)
_PUBLISHED: Final = 300
"""Number of worlds in the benchmark."""
_CELL: Final = 2 * _RADIUS
"""Side of a cell of the reference paths [m]."""
_FIRST_CELL: Final = (-4.575, 5.075)
"""Center of their cell (0, 0) in the benchmark's coordinates [m]."""
_MOST_CELLS: Final = 100
"""Cells of a grid in either direction at most; the benchmark has 30."""
_LARGEST_PATH: Final = 1_000_000
"""Longest file of a path that is read [bytes]."""
_REGIONS: Final[dict[str, Any]] = {
    "start_regions": (Box(-2.0, -6.5, 2.0, -2.5),),
    "goal_regions": (Box(-2.0, 3.5, 2.0, 7.0),),
}


def barn_task() -> Task:
    """Start and goal of the benchmark, the same in all of its worlds.

    The robot starts in the corridor, faces the field and has its goal 10 m ahead, 3.5 m behind it.

    Returns:
        The task.

    Examples:
        >>> from mpfa_envs import NavigationEnv
        >>> from mpfa_envs.worlds.barn import barn_task
        >>> env = NavigationEnv(world="barn-3", physics="kinematic")
        >>> observation, info = env.reset(options=barn_task()._asdict())
        >>> info["distance"]
        10.0
    """
    return Task((-2.25 - _CENTER[0], 3.0 - _CENTER[1], math.pi / 2), (0.0, 13.0 - _CENTER[1]))


@lru_cache(maxsize=len(BARN_WORLDS))
def barn_world(index: int) -> World:
    """Read one of the twenty worlds.

    The benchmark stands in the open; here walls stand around it, 2.75 m from the corridor's sides
    and 1.5 m behind the goal. Sampled tasks lead from the corridor through the field.

    Args:
        index: From 0 to 19, denser on average; the benchmark calls it ``BARN_WORLDS[index]``.

    Returns:
        The world, called ``"barn-INDEX"``.

    Raises:
        ValueError: If there is no such world.

    Examples:
        >>> from mpfa_envs.worlds.barn import barn_world
        >>> world = barn_world(0)
        >>> world.name, len(world.cylinders)
        ('barn-0', 187)
    """
    check_count("index", index, least=0, most=len(BARN_WORLDS) - 1)
    with np.load(_FILE, allow_pickle=False) as file:
        centers = file[f"cyl_{BARN_WORLDS[index]}"].astype(np.float64) - _CENTER
    cylinders = tuple(Cylinder(round(x, 3), round(y, 3), _RADIUS) for x, y in centers.tolist())
    return World(name=f"barn-{index}", size=_SIZE, cylinders=cylinders, **_REGIONS)


def barn_worlds() -> Iterator[tuple[World, float]]:
    """The twenty worlds, each with the length of its reference path [m].

    Examples:
        >>> from mpfa_envs.worlds.barn import barn_worlds
        >>> [f"{world.name}: {length:.2f}" for world, length in barn_worlds()][:2]
        ['barn-0: 11.86', 'barn-1: 11.23']
    """
    with np.load(_FILE, allow_pickle=False) as file:
        for index, number in enumerate(BARN_WORLDS):
            yield barn_world(index), _length(file[f"path_{number}"])


def load_barn(archive: str | os.PathLike[str]) -> Iterator[tuple[World, float]]:
    """Read the worlds of the benchmark's archive, and the lengths of its reference paths.

    World 5 is ``world_files/world_5.world``, a Gazebo world, with ``path_files/path_5.npy``, an
    array ``[N, 2]`` of cells; all other files are left alone. In place of ``world_files`` the
    worlds may lie next to ``path_files``, as in the repositories of the BARN Challenge.

    Args:
        archive: ``BARN_dataset.zip``, or a folder with its files; both folders may be in another
            one.

    Yields:
        The worlds of the archive by their numbers, called ``"barn300-NUMBER"``, in rooms as those
        of :func:`barn_world`, with the length of the reference path from the start through its
        cells to the goal [m].

    Raises:
        WorldFileError: If there is no such archive, or it has no world; or, when its turn comes, if
            a file is missing or damaged.
    """
    path = Path(archive)
    root: Path | zipfile.Path = path
    if not path.is_dir():
        if not path.is_file():
            raise WorldFileError(f"{path}: is neither a folder nor an archive of BARN")
        try:
            root = zipfile.Path(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise WorldFileError(f"{path}: cannot be read: {cause_of(error)}") from error
    inside: list[Path | zipfile.Path] = [*root.iterdir()]
    places = [root, *sorted(inside, key=str)]
    folder = next((place for place in places if (place / "path_files").is_dir()), root)
    files = folder / "world_files" if (folder / "world_files").is_dir() else folder
    numbers = [n for n in range(_PUBLISHED) if (files / f"world_{n}.world").is_file()]
    if not numbers:
        raise WorldFileError(
            f"{path}: has no world of BARN, world_files/world_0.world with path_files/path_0.npy "
            "for example"
        )
    for number in numbers:
        file = files / f"world_{number}.world"
        text = _read(file, LARGEST_FILE)
        world = read_gazebo_world(text, str(file), size=_SIZE, center=_CENTER)
        length = _read_length(folder / "path_files" / f"path_{number}.npy")
        yield replace(world, name=f"barn300-{number}", **_REGIONS), length


def _read(file: Path | zipfile.Path, most: int) -> bytes:
    """Read a file of a folder or an archive, up to the largest size."""
    try:
        if isinstance(file, Path):
            return read_file(file, most)
        with file.open("rb") as stream:
            content = stream.read(most + 1)
    # A damaged archive raises many errors: a wrong checksum, header, length, method, password.
    except Exception as error:
        raise WorldFileError(f"{file}: cannot be read: {cause_of(error)}") from error
    if len(content) > most:
        raise WorldFileError(f"{file}: cannot be read: it has more than {most} bytes")
    return content


def _read_length(file: Path | zipfile.Path) -> float:
    """The length of the reference path in a file [m]."""
    content = _read(file, _LARGEST_PATH)
    try:
        cells = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:
        raise WorldFileError(f"{file}: is no array: {cause_of(error)}") from error
    if not isinstance(cells, np.ndarray) or cells.dtype.kind not in "iuf":
        raise WorldFileError(f"{file}: must be an array of numbers, got {cells!r:.60}")
    if cells.ndim != 2 or cells.shape[1] != 2 or not len(cells):
        raise WorldFileError(f"{file}: must have shape [N, 2], got {list(cells.shape)}")
    if not ((cells >= 0) & (cells < _MOST_CELLS)).all():
        raise WorldFileError(f"{file}: must have cells from 0 to {_MOST_CELLS - 1}, got others")
    return _length(cells)


def _length(cells: NDArray[Any]) -> float:
    """Length of a path from the start through the centers of cells, ``[N, 2]``, to the goal [m]."""
    start, goal = barn_task()
    centers = cells * _CELL + np.subtract(_FIRST_CELL, _CENTER)
    points = np.concatenate([[start[:2]], centers, [goal]])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
