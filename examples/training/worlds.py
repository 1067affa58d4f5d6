"""The worlds that a command line names, and one line of what a script has understood of them."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import label, maximum

from mpfa_envs import GENERATORS, World, world_tasks
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot

_LONGEST = 60
"""Characters of a label, without the number that is put in place of the rest."""
_MOST_WORLDS = 10_000
"""Worlds of a span at most."""
_ARCHIVE = "barn:"
"""Prefix of the path of the benchmark's archive."""
_OF_MANY = re.compile(r"(barn300|[a-z]+)(?:-(validation|test))?-\d+(?:@.*)?")


def parse_worlds(words: Sequence[str]) -> list[str]:
    """Return names and paths of the worlds that a command line names, each once.

    Words are names of worlds, paths of world files, spans of a generator's worlds, ``bars:test`` or
    ``bars:validation``, ``barn`` and ``barn:PATH``, and ``all``: the test worlds of every generator
    of worlds in which nothing moves.

    Examples:
        >>> parse_worlds(["test", "rooms:7-9", "bars:test"])
        ['test', 'rooms-7', 'rooms-8', 'rooms-9', 'bars:test']
    """
    worlds: list[str] = []
    for word in words:
        if word == "all":
            worlds += [f"{name}:test" for name in GENERATORS if name not in ("mixed", "crowd")]
            continue
        span = re.fullmatch(r"([a-z]+):(\d{1,9})-(\d{1,9})", word)
        if span is None:
            worlds.append(word)
        else:
            first, last = int(span[2]), int(span[3])
            if last < first:
                raise ValueError(f"{word} ends before it begins")
            if last - first >= _MOST_WORLDS:
                raise ValueError(
                    f"{word} must be at most {_MOST_WORLDS} worlds, got {last - first + 1}"
                )
            worlds += [f"{span[1]}-{number}" for number in range(first, last + 1)]
    for number, world in enumerate(worlds):
        if world in worlds[:number]:
            raise ValueError(f"world {world!r} is named twice")
        world_tasks(world, episodes=1)
    return worlds


def family(name: str) -> str:
    """Return the family of a world: its generator and split, BARN, or the world itself.

    Examples:
        >>> [family(name) for name in ("bars-test-7", "rooms-7", "barn-3", "test", "my-room")]
        ['bars:test', 'rooms', 'barn', 'test', 'my-room']
        >>> [family(name) for name in ("barn300-5", "barn:BARN_dataset.zip")]
        ['barn300', 'barn300']
    """
    if name.startswith(_ARCHIVE):
        return "barn300"
    found = _OF_MANY.fullmatch(name)
    if found is None:
        return name
    return f"{found[1]}:{found[2]}" if found[2] else found[1]


def is_of_a_test(word: str) -> bool:
    """Return True if a world is for tests, so that nothing may be chosen by it.

    Examples:
        >>> [is_of_a_test(word) for word in ("test", "bars:test", "bars-test-3", "barn", "bars-3")]
        [True, True, True, True, False]
    """
    return family(word) in ("test", "barn", "barn300") or family(word).endswith(":test")


def world_name(world: str) -> str:
    """Return a world as part of a file's name: a world file without folder and ending."""
    if world.startswith(_ARCHIVE):
        return "barn300"
    name = Path(world).stem if Path(world).suffix else world
    return re.sub(r"[^\w.-]", "_", name.replace(":", "-"))


def worlds_label(words: Sequence[str]) -> str:
    """Return a name for the results in some worlds.

    Examples:
        >>> worlds_label(["test", "rooms:100-109"])
        'test+rooms-100-109'
    """
    label = "+".join(world_name(word) for word in words)
    if len(label) <= _LONGEST and not any(
        Path(word).suffix or word.startswith(_ARCHIVE) for word in words
    ):
        return label
    # Two files may have one name, in two folders.
    digest = hashlib.sha256("\n".join(words).encode()).hexdigest()[:8]
    return f"{label[:_LONGEST]}-{digest}"


_FINEST = 0.025
"""Side of the cells in which a passage is looked for [m], unless there would be too many."""
_MOST_CELLS = 400_000
_COARSEST = 0.1
"""With longer cells the width of a door is not told [m]."""
_WIDEST = 2.5
"""A wider passage is no door [m]."""
_ROOM = 0.5
"""Least area for a robot's center on either side of a door [m²]."""


def understood(robot: RobotChoice, worlds: Iterable[str]) -> str:
    """Return the size of a robot and of the worlds that are read from files, in one line.

    Examples:
        >>> understood("kobuki", ["mixed", "A"])
        'kobuki: 0.36 m wide, 0.7 m/s; mixed; A'
    """
    model = resolve_robot(robot)
    parts = [f"{model.name}: {2 * model.radius:.3g} m wide, {model.max_wheel_speed:g} m/s"]
    for world in dict.fromkeys(worlds):
        parts.append(_described(resolve_world(world)) if Path(world).is_file() else world)
    return "; ".join(parts)


def _described(world: World) -> str:
    """Return the size of a world, and the width of its narrowest door if it has one."""
    width, depth = world.size
    door = narrowest_door(world)
    size = f"{world.name}: {width:.1f} x {depth:.1f} m"
    return size if door is None else f"{size}, doors from {door:.2f} m"


def narrowest_door(world: World) -> float | None:
    """Return the width of the narrowest passage between two rooms, to 0.05 m; None without one.

    A passage joins what a slightly wider robot finds in two parts, each with room to drive in.
    """
    side = max(_FINEST, math.sqrt(world.size[0] * world.size[1] / _MOST_CELLS))
    if side > _COARSEST:
        return None
    clearance = FreeGrid(world, distance=side, resolution=side).clearance
    parts, _ = label(clearance >= side)
    for half in np.arange(2 * side, _WIDEST / 2, side):
        inner, _ = label(clearance >= half)
        rooms = np.flatnonzero(np.bincount(inner.ravel()) * side**2 >= _ROOM)
        rooms = rooms[rooms > 0]
        joined = np.atleast_1d(maximum(parts, inner, rooms)) if len(rooms) else rooms
        if len(np.unique(joined)) < len(rooms):
            # The passage is narrower than this radius, and wider than the one before.
            return round(round((2 * half - side) / 0.05) * 0.05, 2)
        parts = inner
    return None
