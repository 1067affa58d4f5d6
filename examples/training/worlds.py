"""The worlds that a command line names."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from mpfa_envs import GENERATORS, world_tasks

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
