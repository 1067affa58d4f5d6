"""Robots that share a world: each is an obstacle that moves to the others."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np
from gymnasium.vector import AutoresetMode

from mpfa_envs.checks import check_count
from mpfa_envs.compiled import njit
from mpfa_envs.env.step_loops import MIN_CLEARANCE
from mpfa_envs.worlds.arrays import clearance_at

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from mpfa_envs.env.step_loops import EpisodeArrays
    from mpfa_envs.worlds.arrays import BatchArrays
    from mpfa_envs.worlds.batch import WorldBatch
    from mpfa_envs.worlds.world import Task, World

MOST: Final = 50
"""Greatest number of robots in a world."""


def check_team(team: int, robots: int, mode: AutoresetMode) -> int:
    """Return a size of teams, or reject one into which the robots cannot be divided."""
    team = check_count("team", team)
    if team > MOST or robots % team:
        raise ValueError(
            f"team must divide num_envs = {robots} and be at most {MOST}, got {team}: N worlds "
            "with a team each need num_envs = N * team"
        )
    if team > 1 and mode is not AutoresetMode.DISABLED:
        raise ValueError(
            f"autoreset_mode must be DISABLED with team={team}, as a robot that has arrived stays "
            f"in the world of the others, got {mode}"
        )
    return team


def check_starts(
    chosen: NDArray[np.bool_],  # begin, [N]
    given: Sequence[tuple[World, Task | None] | None],  # of all robots
    team: int,
    radius: float,  # [m]
) -> None:
    """Reject episodes that a team cannot begin together."""
    for first in range(0, len(chosen), team):
        members = range(first, first + team)
        begin = chosen[first : first + team]
        if not begin.any():
            continue
        if not begin.all():
            raise ValueError(
                f"reset_mask must start all robots of a team or none, got {begin.tolist()} for the "
                f"robots {first} to {members[-1]}"
            )
        tasks = [given[robot] for robot in members]
        worlds, pairs = zip(*(each or (None, None) for each in tasks), strict=True)
        if None in pairs:
            raise ValueError(
                "tasks must have one for each robot of a team, got None for robot "
                f"{members[pairs.index(None)]}: mpfa_envs.tasks.teams.team_tasks makes some"
            )
        if any(world != worlds[0] for world in worlds):
            names = [world.name for world in worlds]
            raise ValueError(f"worlds of a team must be one world, got {names}")
        if worlds[0].walkers:
            raise ValueError(
                f"world {worlds[0].name!r} must have no walkers with team={team}, got "
                f"{len(worlds[0].walkers)}: remove them, or drive each robot alone with team=1"
            )
        for one, other in combinations(members, 2):
            starts = [pairs[robot - first].start[:2] for robot in (one, other)]
            if math.dist(*starts) <= 2 * radius:
                raise ValueError(
                    f"tasks of a team must start {2 * radius:g} m apart, got robots {one} and "
                    f"{other} at {starts[0]} and {starts[1]}"
                )


class Team:
    """The other robots of a team around each robot, as circles in its world."""

    def __init__(self, worlds: WorldBatch, size: int, radius: float) -> None:
        self._worlds, self._size, self._radius = worlds, size, radius

    def place(self, motions: NDArray[np.float64]) -> None:
        """Put the circles where the robots are, by their motions ``[N, 5]``."""
        place_mates(self._worlds.arrays, motions, self._size)

    def begin(self, episodes: EpisodeArrays, chosen: NDArray[np.bool_]) -> None:
        """Put the circles at the starts of the chosen robots, ``[N]``, and measure clearances."""
        self.place(episodes.motions)
        for robot in np.flatnonzero(chosen).tolist():
            x, y = episodes.motions[robot, :2].tolist()
            room = clearance_at(self._worlds.arrays, robot, x, y) - self._radius
            episodes.clearances[robot] = episodes.numbers[MIN_CLEARANCE, robot] = room

    def of(self, robot: int, motions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The others: (x, y), speeds in both directions, radius [m, m/s], ``[team - 1, 5]``."""
        first = robot // self._size * self._size
        others = [each for each in range(first, first + self._size) if each != robot]
        x, y, heading, speed, _ = motions[others].T
        radii = np.full(len(others), self._radius)
        return np.stack((x, y, speed * np.cos(heading), speed * np.sin(heading), radii), axis=1)


@njit
def place_mates(worlds: BatchArrays, motions: NDArray[np.float64], size: int) -> None:
    """Write the positions of each robot's mates into the last circles of its world."""
    for robot in range(motions.shape[0]):
        first = robot // size * size
        row = worlds.counts[robot, 1] - size + 1
        for other in range(first, first + size):
            if other != robot:
                worlds.circles[robot, row, 0] = motions[other, 0]
                worlds.circles[robot, row, 1] = motions[other, 1]
                row += 1
