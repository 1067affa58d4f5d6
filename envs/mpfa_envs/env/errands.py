"""What the drivers of robots in an environment are told."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from gymnasium.error import ResetNeeded

from mpfa_envs.driver import Errand, Senses

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.robots import RobotBatch


def errand_of(batch: RobotBatch, config: TaskConfig, index: int) -> Errand:
    """What a robot has to do in its present episode."""
    task = batch.tasks[index]
    if task is None:
        raise ResetNeeded("there is no errand: call reset() first")
    shape = None
    if batch.memory is not None:
        columns, rows = batch.memory.arrays.shapes[index].tolist()
        shape = columns, rows
    return Errand(
        start=task.start,
        goal=task.goal,
        goal_radius=config.goal_radius,
        time_step=config.time_step,
        action_repeat=config.action_repeat,
        make_filter=batch.make_filter,
        map_shape=shape,
        world=batch.worlds[index],
    )


def senses_of(batch: RobotBatch, config: TaskConfig, robots: NDArray[np.int64]) -> Senses:
    """What some robots know now."""
    observations = batch.observations[robots]
    return Senses(
        robots=robots,
        observations=observations,
        states=observations[:, None],
        motions=batch.measured()[robots],
        poses=batch.episodes.motions[robots, :3],
        goals=batch.episodes.goals[robots],
        maps=None if batch.memory is None else batch.memory.arrays,
        find_still=partial(batch.standing, robots) if config.plan == "known" else None,
    )
