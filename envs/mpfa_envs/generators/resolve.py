"""Worlds by name: built-in, generated, of the BARN benchmark, or read from a file."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

from mpfa_envs.checks import did_you_mean
from mpfa_envs.generators.generate import world_of_name
from mpfa_envs.worlds.barn import barn_world
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.gazebo import load_gazebo_world
from mpfa_envs.worlds.world import World
from mpfa_envs.worlds.world_file import load_world
from mpfa_envs.worlds.yaml_nodes import KINDS

_GAZEBO: Final = (".world", ".sdf", ".world.gz", ".sdf.gz")
"""Endings of files that are read as Gazebo's."""


def resolve_world(world: str | os.PathLike[str] | World) -> World:
    """Find a world by name or read it from a file; a :class:`World` is returned as it is."""
    if isinstance(world, World):
        return world
    if isinstance(world, str) and world in WORLDS:
        return WORLDS[world]
    if isinstance(world, str) and (number := re.fullmatch(r"barn-([0-9]|1[0-9])", world)):
        return barn_world(int(number[1]))
    if isinstance(world, str) and (generated := world_of_name(world)) is not None:
        return generated
    if isinstance(world, (str, os.PathLike)):
        name = Path(world).name.lower()
        if name.endswith((".yaml", ".yml")):
            return load_world(world)
        if name.endswith(_GAZEBO):
            return load_gazebo_world(world)
    hint = f" ({question})" if (question := did_you_mean(world, WORLDS)) else ""
    raise ValueError(
        f"world must be a World, the path of {KINDS}, 'barn-0' to 'barn-19', a generator's "
        f"'NAME-SEED' or one of {list(WORLDS)}, got {world!r}{hint}"
    )
