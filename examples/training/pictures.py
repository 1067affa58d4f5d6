"""What an evaluation shows: paths in up to nine worlds, Q over one, an episode, or a window."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mpfa_envs import Policy, World, WorldTask
from mpfa_envs.driver import Filtered
from mpfa_envs.evaluation.results import EpisodeResult
from mpfa_envs.render import (
    drive_episode,
    film_episode,
    render_trajectories,
    render_values,
    tiled,
    write_animation,
)
from training.evaluating import Drivable, Drives

Values = Callable[[NDArray[np.float32]], NDArray[np.float64]]
"""Values by a critic: from observations, ``[N, O]``, to numbers, ``[N]``."""

TRAJECTORIES = "trajectories.png"
VALUES = "values.png"
EPISODE = "episode.gif"
_PICTURED = 9
"""Worlds in a picture at most."""


def write_pictures(
    policy: Drivable,
    driven: Sequence[Drives],
    folder: Path,
    *,
    values: Values | None = None,
    **env_arguments: Any,
) -> None:
    """Write ``trajectories.png``, ``episode.gif`` and, of a policy, ``values.png``, all whole."""
    number, task = longest(driven)
    # The number of a task is the seed of its walkers, and of the noise.
    film = film_episode(policy, task, values=values, seed=number, **env_arguments)
    seen = policy.policy if isinstance(policy, Filtered) else policy
    with TemporaryDirectory(dir=folder, prefix=".pictures-", suffix=".tmp") as place:
        made = Path(place)
        Image.fromarray(trajectories_of(driven)).save(made / TRAJECTORIES, optimize=True)
        write_animation(film.frames, made / EPISODE, frame_time=film.frame_time, speed=4.0)
        if isinstance(seen, Policy):
            Image.fromarray(values_over(seen, task, values)).save(made / VALUES, optimize=True)
        for picture in made.iterdir():
            picture.replace(folder / picture.name)


def trajectories_of(driven: Sequence[Drives], *, size: int = 360) -> NDArray[np.uint8]:
    """The paths in up to nine worlds, each of a size [px], shape ``[height, width, 3]``."""
    # One world of each row, then a second one of each, and so on.
    in_turn = zip_longest(*map(worlds_in, driven))
    worlds = [each for nth in in_turn for each in nth if each is not None]
    size = 640 if len(worlds) == 1 else size
    return tiled([picture_of(world, drives, size=size) for world, drives in worlds[:_PICTURED]])


def worlds_in(drives: Drives) -> list[tuple[World, Drives]]:
    """Return each world of some drives, with the drives."""
    return [(world, drives) for world in {e.world.name: e.world for e in drives.tasks}.values()]


def picture_of(world: World, drives: Drives, *, size: int) -> NDArray[np.uint8]:
    """The paths in one world, shape ``[size + 28, size, 3]``."""
    numbers = drives.of_world(world.name)
    return render_trajectories(
        world,
        [drives.trails[n] for n in numbers],
        [drives.tasks[n].task.goal for n in numbers],
        [drives.results[n].outcome for n in numbers],
        title=world.name,
        size=size,
    )


def longest(driven: Sequence[Drives], most: float = math.inf) -> tuple[int, WorldTask]:
    """Number and task of the longest success of at most this path [m]; else of a failure."""
    episodes: list[tuple[EpisodeResult, int, WorldTask]] = [
        (result, number, task)
        for each in driven
        for number, (result, task) in enumerate(zip(each.results, each.tasks, strict=True))
    ]
    reached = [each for each in episodes if each[0].success and each[0].path_length <= most]
    _, number, task = max(reached or episodes, key=lambda each: each[0].path_length)
    return number, task


def values_over(policy: Policy, task: WorldTask, values: Values | None) -> NDArray[np.uint8]:
    """Q and the actions all over the world of a task, each robot facing as at its start."""
    return render_values(
        task.world,
        goal=task.task.goal,
        heading=task.task.start[2],
        values=values,
        actions=policy,
        title=task.world.name,
        size=640,
        **policy.env_arguments,
    )


_PAUSE = 1.0
"""For which the end of an episode is shown [s]."""
_OUTCOMES = ("success", "collision", "timeout")


class Watched(NamedTuple):
    """The end of an episode that was watched to its end."""

    world: str
    outcome: str
    time_s: float


def watch(
    policy: Drivable, tasks: Sequence[WorldTask], *, speed: float = 1.0, **env_arguments: Any
) -> Iterator[Watched]:
    """Drive tasks one after another in a window, until it is closed.

    The key N starts the next task, Escape ends.
    """
    # Only here, as it needs pygame, an extra of its own.
    from mpfa_envs.scene.scene import Window

    window: Window | None = None
    for number, task in enumerate(tasks):
        for step in drive_episode(policy, task, seed=number, **env_arguments):
            env = step.env
            if window is None:
                fps = speed / (env.config.time_step * env.config.action_repeat)
                window = Window("N: next task   Escape: end", fps=fps)
            (picture,) = env.render() or ()
            if not window.show(picture) or "n" in window.pressed:
                break
            if step.wheels is None:
                outcome = next(name for name in _OUTCOMES if step.info[name][0])
                yield Watched(task.world.name, outcome, float(step.info["sim_time"][0]))
                for _ in range(round(_PAUSE / (env.config.time_step * env.config.action_repeat))):
                    window.show(picture)
        if window is not None and window.closed:
            break
    if window is not None:
        window.close()
