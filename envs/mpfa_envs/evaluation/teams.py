"""Drives of teams, robots that share a world: who arrived, who touched whom, who stood for ever."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mpfa_envs.checks import check_count
from mpfa_envs.control.standing import STANDING_SIDE, STANDING_TIME
from mpfa_envs.driver import Action, Driver, as_driver
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.evaluation.results import EpisodeResult
from mpfa_envs.evaluation.runs import ENVS_AT_ONCE, drive_steps
from mpfa_envs.tasks.teams import TeamTask

Trail = NDArray[np.float64]
"""Positions (x, y) of a robot [m], ``[T, 2]``."""
_TOUCHING = 0.01
"""Robots whose rims are this near when one of them collides have touched each other [m]."""


@dataclass(frozen=True)
class TeamResult:
    """One drive of a team."""

    world: str
    robots: int
    """Size of the team."""
    arrived: int
    """Robots that reached their goals."""
    touched: int
    """Robots that touched another, whichever of them moved."""
    touch_speed: float
    """Greatest speed of a robot when it touched another [m/s]; 0 without a touch."""
    hit: int
    """Robots that touched an obstacle or a wall."""
    deadlock: bool
    """True if none of the robots under way moved for ten seconds, whether or not they went on."""
    time_s: float
    """Time until the last robot's episode ended [s]."""
    min_gap: float
    """Least distance between the rims of two robots [m]; infinite for a team of one."""

    @property
    def success(self) -> bool:
        """True if all robots arrived."""
        return self.arrived == self.robots


def run_teams(
    policy: Action | Driver,
    tasks: Sequence[TeamTask],
    *,
    on_end: Callable[[int, list[Trail], list[EpisodeResult]], object] | None = None,
    **env_arguments: Any,
) -> list[TeamResult]:
    """Drive every task once: a team in a world, all robots by the same policy.

    A robot that has arrived, or touched something, stays where it is, as an obstacle of the others.

    Args:
        policy: As for :func:`~mpfa_envs.run_tasks`; a function takes all observations, ``[N, O]``.
        tasks: Tasks, as :func:`~mpfa_envs.tasks.teams.team_tasks` makes them.
        on_end: Called at the end of each task with its number, and paths and results of the robots.
        **env_arguments: Arguments of :class:`~mpfa_envs.VectorNavigationEnv`.

    Returns:
        One result a task, in the order of the tasks.

    Raises:
        ValueError: If an argument is out of its range, or a task cannot be driven.

    Examples:
        >>> from mpfa_envs.evaluation.teams import run_teams
        >>> from mpfa_envs.tasks.teams import team_tasks
        >>> ahead = lambda observations: np.ones((len(observations), 2), np.float32)
        >>> results = run_teams(ahead, team_tasks("crossing", 2, episodes=1), physics="kinematic")
        >>> results[0].robots
        2
    """
    driver = as_driver(policy)
    results: list[TeamResult] = []
    sizes = groupby(enumerate(tasks), key=lambda each: (len(each[1].tasks), each[1].world.diagonal))
    for (size, _), group in sizes:
        numbered = list(group)
        at_once = max(ENVS_AT_ONCE // size, 1)
        for first in range(0, len(numbered), at_once):
            part = numbered[first : first + at_once]
            for number, trails, ends, result in _drive(driver, part, env_arguments):
                results.append(result)
                if on_end:
                    on_end(number, trails, ends)
    return results


def _drive(
    driver: Driver, part: Sequence[tuple[int, TeamTask]], env_arguments: Mapping[str, Any]
) -> Iterator[tuple[int, list[Trail], list[EpisodeResult], TeamResult]]:
    """Drive some teams of a size together, each in its world."""
    numbers, tasks = zip(*part, strict=True)
    size = len(tasks[0].tasks)
    check_count("team", size)
    each = [task for team in tasks for task in team.of_robots()]
    arguments = {"contact": True, **env_arguments, **each[0].limit(env_arguments)}
    arguments |= {"world": tasks[0].world, "autoreset_mode": AutoresetMode.DISABLED, "team": size}
    env = VectorNavigationEnv(len(each), **arguments)
    ends: dict[int, EpisodeResult] = {}
    with closing(env):
        for step in drive_steps(env, driver, each, range(len(each))):
            ends |= {robot: result for robot, _, result in step.ended}
        trails = [np.array(env.trail(robot)) for robot in range(len(each))]
        motions = env.motions
    radius, period = env.config.robot.radius, env.config.time_step
    for place, number in enumerate(numbers):
        robots = slice(place * size, (place + 1) * size)
        members = [ends[robot] for robot in range(robots.start, robots.stop)]
        result = judge_team(members, trails[robots], motions[robots], radius, period)
        yield number, trails[robots], members, result


def judge_team(
    ends: Sequence[EpisodeResult],
    trails: Sequence[Trail],
    motions: NDArray[np.float64],
    radius: float,
    period: float,
) -> TeamResult:
    """Judge a drive of a team by the ends of its robots.

    Args:
        ends: Results of the robots.
        trails: Their positions, from the same moment on [m].
        motions: Poses and speeds where they ended, ``[robots, 5]``.
        radius: Of each [m].
        period: Time from one position to the next [s].

    Returns:
        The result of the team.
    """
    places = together(trails)
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) - 2 * radius
    gaps[:, range(len(ends)), range(len(ends))] = math.inf
    last = gaps[[len(trail) - 1 for trail in trails], range(len(ends))].min(axis=1)
    touching = [end.collision and gap <= _TOUCHING for end, gap in zip(ends, last, strict=True)]
    speeds = np.abs(motions[:, 3])[touching]
    return TeamResult(
        world=ends[0].world,
        robots=len(ends),
        arrived=sum(end.success for end in ends),
        touched=sum(touching),
        touch_speed=float(speeds.max(initial=0.0)),
        hit=sum(end.collision for end in ends) - sum(touching),
        deadlock=stood(trails, period),
        time_s=max(end.time_s for end in ends),
        min_gap=float(gaps.min()),
    )


def together(trails: Sequence[Trail]) -> NDArray[np.float64]:
    """Positions of all robots at each moment, ``[T, robots, 2]``; one that has ended stays."""
    longest = max(map(len, trails))
    rows = [
        np.concatenate((trail, np.repeat(trail[-1:], longest - len(trail), axis=0)))
        for trail in trails
    ]
    return np.stack(rows, axis=1)


def stood(trails: Sequence[Trail], period: float) -> bool:
    """Return True if, for ten seconds, none moved of the robots that were under way all the time.

    Args:
        trails: Positions of each robot until it ended [m].
        period: Time from one position to the next [s].
    """
    count = math.ceil(STANDING_TIME / period) + 1
    longest = max(map(len, trails))
    moved = np.zeros(max(longest - count + 1, 0), dtype=np.bool_)
    for trail in trails:
        windows = max(len(trail) - count + 1, 0)
        if windows:
            spans = np.lib.stride_tricks.sliding_window_view(trail, count, axis=0)
            moved[:windows] |= (np.ptp(spans, axis=-1) > STANDING_SIDE).any(axis=-1)
        # One that ends within a window was under way.
        moved[windows : min(len(trail), len(moved))] = True
    return bool((~moved).any())
