"""A world of any of the other kinds."""

from __future__ import annotations

import random

from mpfa_envs.generators.bars import bars
from mpfa_envs.generators.clutter import clutter
from mpfa_envs.generators.fields import fields
from mpfa_envs.generators.halls import halls
from mpfa_envs.generators.mazes import mazes
from mpfa_envs.generators.rooms import rooms
from mpfa_envs.worlds.world import World

_KINDS = (rooms, clutter, bars, fields, halls, mazes)


def mixed(rng: random.Random, difficulty: float) -> World:
    """Sample a world of one of the other generators, each as often."""
    return rng.choice(_KINDS)(rng, difficulty)
