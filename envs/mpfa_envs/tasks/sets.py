"""Sets of tasks that policies are compared on: of a world, a generator or a benchmark."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any, Final, NamedTuple, cast, get_args

from mpfa_envs.checks import check_count, did_you_mean
from mpfa_envs.generators.generate import GENERATORS, Split, generator_tasks
from mpfa_envs.generators.resolve import resolve_world
from mpfa_envs.robots.resolve import RobotChoice
from mpfa_envs.tasks.sampling import evaluation_pairs
from mpfa_envs.worlds.barn import barn_task, barn_worlds, load_barn
from mpfa_envs.worlds.world import Task, World

TASKS_PER_WORLD: Final = 4
"""Number of tasks in each world of a generator."""
_STANDARD_TIME_STEP: Final = 0.1
"""Unit of time limits [s]."""
BARN_MAX_STEPS: Final = 1000
"""The benchmark's 100 s."""
_IN_A_WORLD: Final = 200
_OF_A_GENERATOR: Final = 400


class WorldTask(NamedTuple):
    """One episode to drive and its world."""

    world: World
    task: Task
    max_steps: int | None = None
    """Time limit in steps of 0.1 s, in place of the environment's; None: the environment's."""
    seed: int | None = None
    """Seed of walkers and noise; None: the number of the task among those that are driven."""
    reference_path: float | None = None
    """Length of BARN's reference path, by which its score is computed [m]; None without one."""

    def limit(self, env_arguments: Mapping[str, Any]) -> dict[str, int]:
        """The time limit as an argument of an environment; nothing where that has its own.

        Args:
            env_arguments: The environment's other arguments, ``time_step`` [s] perhaps among them.

        Examples:
            >>> from mpfa_envs import world_tasks
            >>> world_tasks("barn", episodes=1)[0].limit({"time_step": 0.05})  # 100 s
            {'max_steps': 2000}
        """
        if self.max_steps is None:
            return {}
        time_step = env_arguments.get("time_step", _STANDARD_TIME_STEP)
        return {"max_steps": round(self.max_steps * _STANDARD_TIME_STEP / time_step)}


def world_tasks(
    name: str | os.PathLike[str] | World,
    *,
    episodes: int | None = None,
    seed: int = 0,
    robot: RobotChoice = "turtlebot2",
) -> list[WorldTask]:
    """Make the tasks of a name, the same for everyone.

    Args:
        name: A world, as in :class:`~mpfa_envs.NavigationEnv`, with tasks of
            ``evaluation_pairs``; ``"bars:test"`` or ``"bars:validation"``, the
            worlds of that split of a generator, four tasks in each, of
            ``generator_tasks``; or the benchmark's own task: ``"barn"`` in the
            twenty worlds that come with the package, ``"barn:PATH"`` in those of its
            archive, which :func:`~mpfa_envs.worlds.barn.load_barn` reads.
        episodes: Number of tasks; None: 200 in a world, 400 in the worlds of a generator, one in
            each world of the benchmark. The first tasks of a longer list are those of a shorter
            one.
        seed: Seed of the tasks in a world; those of a generator are fixed.
        robot: Whose radius counts in a world. Those of a generator are for a TurtleBot2.

    Returns:
        The tasks with their worlds.

    Raises:
        ValueError: If nothing has that name, or a number is out of its range.
        WorldFileError: If a file is no world, or there is no archive of the benchmark.

    Examples:
        >>> from mpfa_envs import world_tasks
        >>> [each.world.name for each in world_tasks("bars:test", episodes=5)[3:]]
        ['bars-test-0', 'bars-test-1']
    """
    if episodes is not None:
        check_count("episodes", episodes)
    if isinstance(name, str) and (name == "barn" or name.startswith("barn:")):
        # The robot starts at one pose in all of them: more episodes would be the same ones again.
        worlds = barn_worlds() if name == "barn" else load_barn(name.partition(":")[2])
        return _numbered(
            [
                WorldTask(world, barn_task(), BARN_MAX_STEPS, reference_path=length)
                for world, length in islice(worlds, episodes)
            ]
        )
    generator, _, split = str(name).partition(":")
    if split in get_args(Split)[1:] and generator not in GENERATORS:
        hint = f" ({question})" if (question := did_you_mean(generator, GENERATORS)) else ""
        raise ValueError(
            f"world must be NAME:{split} with a NAME of {list(GENERATORS)}, got {name!r}{hint}"
        )
    if isinstance(name, str) and generator in GENERATORS:
        if split not in get_args(Split)[1:]:
            raise ValueError(
                f"world must be {generator}:validation or {generator}:test to stand for tasks in "
                f"the worlds of a generator, got {name!r}"
            )
        count = _OF_A_GENERATOR if episodes is None else episodes
        made = generator_tasks(
            generator,
            cast("Split", split),
            worlds=-(-count // TASKS_PER_WORLD),
            tasks=TASKS_PER_WORLD,
        )
        return _numbered([WorldTask(*each) for each in made[:count]])
    world = resolve_world(name)
    count = _IN_A_WORLD if episodes is None else episodes
    pairs = evaluation_pairs(world, count, seed, robot=robot)
    return _numbered([WorldTask(world, task) for task in pairs])


def _numbered(tasks: Sequence[WorldTask]) -> list[WorldTask]:
    """Seed each task by its number in its set, whichever tasks are driven along with it."""
    return [each._replace(seed=number) for number, each in enumerate(tasks)]
