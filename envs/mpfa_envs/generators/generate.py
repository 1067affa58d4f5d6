"""Generators of worlds: a generator's name and a seed give everyone the same world, always.

A generator is a function of a source of randomness and a difficulty. :func:`generate_world` seeds
it, and samples again where no robot can drive. Seeds for training, validation and test are apart
by construction (:func:`world_seed`).
"""

from __future__ import annotations

import os
import random
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, TypeAlias, cast, get_args

import numpy as np

from mpfa_envs.checks import check_count, check_share, got
from mpfa_envs.generators.mazes import fields, mazes
from mpfa_envs.generators.rooms import bars, clutter, crowd, halls, rooms
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.tasks import has_task, sample_task_on_grid
from mpfa_envs.worlds.barn import barn_world
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.gazebo import load_gazebo_world
from mpfa_envs.worlds.world import Task, World
from mpfa_envs.worlds.world_file import load_world
from mpfa_envs.worlds.yaml_nodes import KINDS

_KINDS = (rooms, clutter, bars, fields, halls, mazes)


def mixed(rng: random.Random, difficulty: float) -> World:
    """Sample a world of one of the other generators, each as often."""
    return rng.choice(_KINDS)(rng, difficulty)


Generator: TypeAlias = Callable[[random.Random, float], World]
"""A function that samples a world of a difficulty in [0, 1]."""
Split = Literal["train", "validation", "test"]
"""Uses of a seed."""

_BUILT_IN: Final[Mapping[str, Generator]] = {
    "rooms": rooms,
    "clutter": clutter,
    "bars": bars,
    "fields": fields,
    "halls": halls,
    "mazes": mazes,
    "mixed": mixed,
    "crowd": crowd,
}
_registered = dict(_BUILT_IN)
GENERATORS: Final[Mapping[str, Generator]] = MappingProxyType(_registered)
"""The generators by name; :func:`register_generator` adds one."""
ROBOT_DISTANCE: Final = 0.25
"""Every world has a task whose path has this clearance: a TurtleBot2 with 0.07 m to spare [m]."""
_SPLIT_SIZE: Final = 10**9
_ATTEMPTS: Final = 100
_HALFWAY: Final = ("rooms", "crowd")
"""Generators with a default difficulty of 0.5."""
_TASK_STREAM: Final = 7312590
_NAME = re.compile(r"([a-z]+)(?:-(validation|test))?-([0-9]{1,9})(?:@(1|0?\.[0-9]+|0))?")


def register_generator(name: str, generator: Generator) -> None:
    """Add a generator, for this process.

    Its name then stands wherever that of a built-in one does: ``world="pillars"`` is a new world in
    each episode, ``"pillars-7"`` world 7, ``"pillars:test"`` the tasks of its test worlds.

    Args:
        name: Lower-case letters. A generator of your own that has this name is replaced.
        generator: From a source of randomness and a difficulty in [0, 1] to a world, at most 50 m
            from corner to corner. It must take all its random numbers from that source.

    Raises:
        ValueError: If the name has other characters, or is taken by a built-in generator or world,
            or the generator cannot be called.

    Examples:
        >>> from mpfa_envs import Cylinder, NavigationEnv, World, register_generator
        >>> def pillars(source, difficulty):
        ...     places = [(source.uniform(-4, 4), source.uniform(-4, 4)) for _ in range(6)]
        ...     radius = 0.1 + 0.4 * difficulty
        ...     return World(name="pillars", cylinders=tuple(Cylinder(*p, radius) for p in places))
        >>> register_generator("pillars", pillars)  # doctest: +SKIP
        >>> env = NavigationEnv(world="pillars-7", physics="kinematic")  # doctest: +SKIP
    """
    if not isinstance(name, str) or re.fullmatch("[a-z]+", name) is None:
        raise ValueError(f"name must be lower-case letters a to z, got {name!r}")
    if not callable(generator):
        raise ValueError(f"generator must be callable, got {generator!r}")
    if name in _BUILT_IN or name in WORLDS or name == "barn":
        raise ValueError(f"name must not be that of a built-in generator or world, got {name!r}")
    _registered[name] = generator


def world_seed(split: Split, index: int) -> int:
    """Seed of a world of a split.

    Args:
        split: ``"train"``, ``"validation"`` or ``"test"``.
        index: Number of the world in it, below 10⁹.

    Returns:
        The seed; no two splits share one.

    Raises:
        ValueError: If there is no such split or index.

    Examples:
        >>> from mpfa_envs.generators.generate import world_seed
        >>> world_seed("train", 7), world_seed("test", 7)
        (7, 2000000007)
    """
    splits = get_args(Split)
    if split not in splits:
        raise ValueError(f"split must be one of {splits}, got {split!r}")
    number = check_count("index", index, least=0, most=_SPLIT_SIZE - 1)
    return splits.index(split) * _SPLIT_SIZE + number


def generate_world(name: str, seed: int, *, difficulty: float | None = None) -> World:
    """Make the world of a seed.

    Args:
        name: A generator, one of :data:`GENERATORS`.
        seed: Seed below 3 * 10⁹, as :func:`world_seed` gives them.
        difficulty: From 0 to 1; its meaning depends on the generator. None: the seed's own, uniform
            over this range; 0.5 for ``"rooms"`` and ``"crowd"``.

    Returns:
        The world, in which there is a task for a TurtleBot2 with 0.07 m to spare. It is called
        ``"bars-7"``, ``"bars-test-7"`` or, with a difficulty, ``"bars-7@0.5"``, which
        :func:`~mpfa_envs.generators.generate.resolve_world` understands.

    Raises:
        TypeError: If a generator of your own gives something else.
        ValueError: If there is no such generator, an argument is out of its range, or none of 100
            attempts has a task.

    Examples:
        >>> from mpfa_envs import NavigationEnv, generate_world
        >>> world = generate_world("bars", 7)
        >>> NavigationEnv(world="bars-7", physics="kinematic").world == world
        True
    """
    if name not in GENERATORS:
        raise ValueError(f"generator must be one of {list(GENERATORS)}, {got(name, GENERATORS)}")
    check_count("seed", seed, least=0, most=len(get_args(Split)) * _SPLIT_SIZE - 1)
    if difficulty is not None:
        difficulty = check_share("difficulty", difficulty)
    world_name = _world_name(name, int(seed), difficulty)
    for attempt in range(_ATTEMPTS):
        rng = _source(name, int(seed), attempt)
        # Rooms are as they were before there were others, so that their seeds mean the same.
        own = 0.5 if name in _HALFWAY else rng.random()
        world = GENERATORS[name](rng, own if difficulty is None else difficulty)
        if not isinstance(world, World):
            raise TypeError(f"generator {name!r} must give a World, got {type(world).__name__}")
        if has_task(FreeGrid(world, distance=ROBOT_DISTANCE)):
            return world.renamed(world_name)
    raise ValueError(
        f"world {world_name!r} cannot be made: none of {_ATTEMPTS} attempts has a start and a goal "
        "with a path between them"
    )


def _source(name: str, seed: int, attempt: int) -> random.Random:
    """The source of randomness of one attempt; the same in every process and on every machine."""
    if name == "rooms" and attempt == 0:
        return random.Random(seed)
    return random.Random(f"{name}-{seed}-{attempt}")


def _world_name(name: str, seed: int, difficulty: float | None) -> str:
    """Name of a world, by which it can be made again."""
    split, index = divmod(seed, _SPLIT_SIZE)
    middle = "" if split == 0 else f"-{get_args(Split)[split]}"
    if difficulty is None:
        return f"{name}{middle}-{index}"
    # All digits, and none as an exponent: the name stands for this world and no other.
    return f"{name}{middle}-{index}@{np.format_float_positional(difficulty, trim='-')}"


def world_of_name(name: str) -> World | None:
    """Make the world that a name such as ``"bars-test-7"`` stands for."""
    found = _NAME.fullmatch(name)
    if found is None or found[1] not in GENERATORS:
        return None
    generator, split, index, difficulty = found.groups()
    return generate_world(
        generator,
        world_seed(cast("Split", split or "train"), int(index)),
        difficulty=None if difficulty is None else float(difficulty),
    )


def split_worlds(
    name: str, split: Split, count: int, *, difficulty: float | None = None
) -> list[World]:
    """Make the first worlds of a split.

    Args:
        name: A generator, one of :data:`GENERATORS`.
        split: ``"train"``, ``"validation"`` or ``"test"``.
        count: How many.
        difficulty: See :func:`generate_world`.

    Returns:
        The worlds.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from mpfa_envs.generators.generate import split_worlds
        >>> [world.name for world in split_worlds("clutter", "test", 2)]
        ['clutter-test-0', 'clutter-test-1']
    """
    check_count("count", count)
    return [
        generate_world(name, world_seed(split, index), difficulty=difficulty)
        for index in range(count)
    ]


def generator_tasks(
    name: str, split: Split, *, worlds: int = 100, tasks: int = 4
) -> list[tuple[World, Task]]:
    """Make the tasks of a generator that policies are compared on, which never change.

    Args:
        name: A generator, one of :data:`GENERATORS`.
        split: ``"validation"`` or ``"test"``; ``"train"`` is what a policy learned in.
        worlds: How many worlds; the first ones of more are these.
        tasks: How many tasks in each.

    Returns:
        Worlds and tasks, each solved by a path that keeps a TurtleBot2's radius and 0.07 m.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from mpfa_envs.generators.generate import generator_tasks
        >>> pairs = generator_tasks("bars", "test", worlds=2, tasks=3)
        >>> [world.name for world, task in pairs]  # doctest: +NORMALIZE_WHITESPACE
        ['bars-test-0', 'bars-test-0', 'bars-test-0',
         'bars-test-1', 'bars-test-1', 'bars-test-1']
    """
    check_count("tasks", tasks)
    pairs = []
    for index, world in enumerate(split_worlds(name, split, worlds)):
        grid = FreeGrid(world, distance=ROBOT_DISTANCE)
        # Training with this seed must not meet these tasks.
        kind = int.from_bytes(name.encode(), "big")
        rng = np.random.default_rng((_TASK_STREAM, kind, world_seed(split, index)))
        pairs += [(world, sample_task_on_grid(grid, rng)[0]) for _ in range(tasks)]
    return pairs


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
    raise ValueError(
        f"world must be a World, the path of {KINDS}, 'barn-0' to 'barn-19', a generator's "
        f"'NAME-SEED' or one of {list(WORLDS)}, {got(world, WORLDS)}"
    )
