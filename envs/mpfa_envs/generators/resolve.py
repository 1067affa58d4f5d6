"""Worlds by name: built-in, generated, of the BARN benchmark, or read from a file."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

from mpfa_envs.checks import did_you_mean
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.world import World

_GAZEBO: Final = (".world", ".sdf", ".world.gz", ".sdf.gz")
"""Endings of files that are read as Gazebo's."""


def resolve_world(world: str | os.PathLike[str] | World) -> World:
    """Find a world by name or read it from a file; a :class:`World` is returned as it is."""
    if isinstance(world, World):
        return world
    if isinstance(world, str) and world in WORLDS:
        return WORLDS[world]
    if isinstance(world, str) and (number := re.fullmatch(r"barn-([0-9]|1[0-9])", world)):
        # Imported here because it needs tasks, which need this file.
        from mpfa_envs.worlds.barn import barn_world

        return barn_world(int(number[1]))
    if isinstance(world, str) and re.fullmatch(r"[a-z]+-[a-z0-9@.-]*[0-9]", world):
        # Imported here because the generators need Numba, which takes half a second.
        from mpfa_envs.generators import world_of_name

        if (generated := world_of_name(world)) is not None:
            return generated
    if isinstance(world, (str, os.PathLike)) and Path(world).suffix.lower() in (".yaml", ".yml"):
        # Imported here because most programs never read a world from a file.
        from mpfa_envs.worlds.world_file import load_world

        return load_world(world)
    if isinstance(world, (str, os.PathLike)) and Path(world).name.lower().endswith(_GAZEBO):
        from mpfa_envs.worlds.gazebo import load_gazebo_world

        return load_gazebo_world(world)
    hint = f" ({question})" if (question := did_you_mean(world, WORLDS)) else ""
    raise ValueError(
        "world must be a World, the path of a .yaml file, 'barn-0' to 'barn-19', a generator's "
        f"'NAME-SEED' or one of {list(WORLDS)}, got {world!r}{hint}"
    )
