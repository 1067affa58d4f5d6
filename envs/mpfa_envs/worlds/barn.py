"""Twenty worlds of the BARN benchmark, and its task.

BARN, Benchmark for Autonomous Robot Navigation (Perille et al. 2020,
https://arxiv.org/abs/2008.13315), has three hundred fields of cylinders. These are every fifteenth
of the published ones, which grow denser; ``data/barn/LICENSE.txt`` is their license. The
benchmark's robot is a Jackal of 0.51 x 0.43 m with up to 2 m/s, ours a disc of 0.18 m radius with
up to 0.5 m/s: rates of success are of another task than those of the benchmark's table.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from mpfa_envs.checks import check_count
from mpfa_envs.worlds.task import Task
from mpfa_envs.worlds.world import Box, Cylinder, World

BARN_WORLDS: Final = tuple(range(5, 300, 15))
"""Numbers of the worlds in the benchmark."""
_FILE: Final = Path(__file__).parents[1] / "data" / "barn" / "barn_sample.npz"
_RADIUS: Final = 0.075
_CENTER: Final = (-2.25, 7.0)
"""Middle of the room in the benchmark's coordinates [m]."""
_SIZE: Final = (10.0, 15.0)


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
    return World(
        name=f"barn-{index}",
        size=_SIZE,
        cylinders=tuple(Cylinder(round(x, 3), round(y, 3), _RADIUS) for x, y in centers.tolist()),
        start_regions=(Box(-2.0, -6.5, 2.0, -2.5),),
        goal_regions=(Box(-2.0, 3.5, 2.0, 7.0),),
    )
