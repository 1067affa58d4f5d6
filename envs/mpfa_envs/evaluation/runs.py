"""Greedy episodes of a policy between fixed starts and goals, many at once."""

from __future__ import annotations

import os
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mpfa_envs.checks import check_count
from mpfa_envs.control.standing import stands_still
from mpfa_envs.driver import Action, Driver, as_driver
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.evaluation.results import ENCOUNTERS, EpisodeResult, barn_score, sct, spl
from mpfa_envs.planners.dynamic_window import DynamicWindow
from mpfa_envs.policies.policy import Policy
from mpfa_envs.robots.drives import Physics
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.tasks.sampling import WorldTask, world_tasks
from mpfa_envs.worlds.world import World

ENVS_AT_ONCE = 64
"""Episodes that run together by default, if the policy is known to take many observations."""


def evaluate(
    policy: Action | Driver,
    world: str | os.PathLike[str] | World | Sequence[str | os.PathLike[str] | World] = "test",
    *,
    episodes: int | None = None,
    seed: int = 0,
    physics: Physics | None = None,
    envs_at_once: int | None = None,
    progress_bar: bool = False,
    **env_arguments: Any,
) -> list[EpisodeResult]:
    """Run a policy on fixed tasks; contact is the only collision.

    Args:
        policy: A :class:`~mpfa_envs.Policy`, any function from observation to action, or a
            :class:`~mpfa_envs.driver.Driver`.
        world: What :func:`~mpfa_envs.world_tasks` takes: a world, or ``"bars:test"``, the test
            worlds of a generator; or several of these.
        episodes: Number of tasks in each; None: 200 in a world, 400 in the worlds of a generator.
        seed: Seed of the tasks in a world.
        physics: ``"wheels"`` or ``"kinematic"``; None: that of the policy.
        envs_at_once: As in :func:`run_tasks`.
        progress_bar: If True, show one.
        **env_arguments: Arguments of :class:`~mpfa_envs.VectorNavigationEnv` in place of
            ``policy.env_arguments``; ``max_steps`` counts where a task has no time limit of its
            own, as those of the benchmark have.

    Returns:
        One result an episode, world by world. Those of a world are the same whichever others are
        evaluated with it.

    Raises:
        ValueError: If an argument is out of its range; nothing has moved then.

    Examples:
        >>> from mpfa_envs import evaluate, summarize
        >>> ahead = lambda observation: np.ones(2)
        >>> results = evaluate(ahead, ["A", "rooms-7"], episodes=3, physics="kinematic")
        >>> [(result.world, result.episode) for result in results[2:4]]
        [('A', 2), ('rooms-7', 0)]
        >>> sorted(summarize(results))[:3]
        ['collision', 'decision_s', 'min_clearance']
    """
    arguments = {**getattr(policy, "env_arguments", {}), **env_arguments}
    if physics is not None:
        arguments["physics"] = physics
    robot = arguments.get("robot", "turtlebot2")
    several = [world] if isinstance(world, (str, os.PathLike, World)) else world
    tasks = [
        task
        for each in several
        for task in world_tasks(each, episodes=episodes, seed=seed, robot=robot)
    ]
    return run_tasks(
        policy, tasks, envs_at_once=envs_at_once, progress_bar=progress_bar, **arguments
    )


def run_tasks(
    policy: Action | Driver,
    tasks: Sequence[WorldTask],
    *,
    envs_at_once: int | None = None,
    progress_bar: bool = False,
    on_end: Callable[[VectorNavigationEnv, int, int], object] | None = None,
    **env_arguments: Any,
) -> list[EpisodeResult]:
    """Drive every task once.

    Args:
        policy: From observations, ``[N, O]``, to actions, ``[N, A]``, for the N running episodes;
            with ``envs_at_once=1`` from one observation, ``[O]``, to one action.
        tasks: Tasks with their worlds.
        envs_at_once: How many episodes run together, which changes no result of a
            :class:`~mpfa_envs.Policy` but by what :class:`~mpfa_envs.VectorNavigationEnv` says of
            wheels; None: 64 for one, a :class:`~mpfa_envs.driver.Driver` or a
            :class:`~mpfa_envs.planners.DynamicWindow`, else one at a time.
        progress_bar: If True, show one.
        on_end: Called at the end of every episode with the environment, the number of the robot,
            whose path is ``env.trail(robot)``, and that of the task.
        **env_arguments: Arguments of :class:`~mpfa_envs.VectorNavigationEnv`; ``max_steps``
            counts where a task has no time limit of its own.

    Returns:
        One result a task, in the order of the tasks.

    Raises:
        ValueError: If an argument is out of its range, or the robot cannot drive a task, and
            nothing has moved then; or if the policy gives no action for each observation.

    Warns:
        UserWarning: If the policy, the planner or the filter is for another robot, or the policy
            learned behind a filter and has none.
    """
    for name in ("world", "num_envs", "autoreset_mode"):
        if name in env_arguments:
            raise ValueError(
                f"{name} must be left to the tasks, which decide it, got {env_arguments[name]!r}"
            )
    if envs_at_once is None:
        takes_many = isinstance(policy, (Policy, DynamicWindow, Driver))
        envs_at_once = ENVS_AT_ONCE if takes_many else 1
    check_count("envs_at_once", envs_at_once)
    _warn_of_another_robot(policy, resolve_robot(env_arguments.get("robot", "turtlebot2")))
    card = getattr(policy, "card", None)
    if isinstance(card, Mapping) and card.get("filter"):
        warnings.warn(
            "policy learned behind the filter and drives without it: Filtered(policy, "
            "TaskConfig(**policy.env_arguments).make_filter()) has it",
            stacklevel=2,
        )
    driver = as_driver(policy, alone=envs_at_once == 1)
    # Each task has its own seed, whichever robot drives it.
    tasks = [
        each._replace(seed=number) if each.seed is None else each
        for number, each in enumerate(tasks)
    ]
    results: dict[int, EpisodeResult] = {}
    arguments = {"contact": True, **env_arguments}
    arguments["autoreset_mode"] = AutoresetMode.DISABLED
    with ExitStack() as opened, _progress_bar(len(tasks) if progress_bar else None) as advance:
        fleets = []
        for numbers in _by_time_limit(tasks).values():
            robots = min(envs_at_once, len(numbers))
            arguments["world"] = _largest_of([tasks[number].world for number in numbers])
            limit = tasks[numbers[0]].limit(arguments)
            env = VectorNavigationEnv(robots, **{**arguments, **limit})
            fleets.append((opened.enter_context(closing(env)), numbers))
        for env, numbers in fleets:
            _check(env, tasks, numbers)
        for env, numbers in fleets:
            for step in drive_steps(env, driver, tasks, numbers):
                for robot, number, result in step.ended:
                    results[number] = result
                    advance()
                    if on_end:
                        on_end(env, robot, number)
    return [results[number] for number in range(len(tasks))]


def _warn_of_another_robot(policy: Action | Driver, robot: RobotModel) -> None:
    """Warn of a policy, a planner or a filter that was made for another robot."""
    made_for = getattr(policy, "env_arguments", {}).get("robot")
    for what, given in (("policy", made_for), ("filter", getattr(policy, "keep", None))):
        named = getattr(given, "robot", given)
        if not isinstance(named, (str, os.PathLike, Mapping, RobotModel)):
            continue
        if (other := resolve_robot(named)) == robot:
            continue
        both = zip(asdict(other).items(), asdict(robot).values(), strict=True)
        differ = ", ".join(f"{n} {one} and {two}" for (n, one), two in both if one != two)
        warnings.warn(
            f"{what} must be for the robot that drives, got one for {other.name!r} with "
            f"robot={robot.name!r}: {differ} differ",
            stacklevel=3,
        )


def _check(env: VectorNavigationEnv, tasks: Sequence[WorldTask], numbers: Sequence[int]) -> None:
    """Reject tasks that the robot cannot drive."""
    for number in numbers:
        world, task, *_ = tasks[number]
        try:
            env.check_task(0, *task, world)
        except ValueError as error:
            raise ValueError(f"task {number}, in world {world.name!r}: {error}") from error


def _by_time_limit(tasks: Sequence[WorldTask]) -> dict[int | None, list[int]]:
    """Numbers of the tasks that have the same time limit."""
    found: dict[int | None, list[int]] = {}
    for number, each in enumerate(tasks):
        found.setdefault(each.max_steps, []).append(number)
    return found


def _largest_of(worlds: Sequence[World]) -> World:
    """An empty world of the largest width and depth, which bounds the observations."""
    sides = zip(*(world.size for world in worlds), strict=True)
    width, depth = (max(each) for each in sides)
    return World(name="empty", size=(max(width, 10.0), max(depth, 10.0)))


class Step(NamedTuple):
    """A decision of all robots that drive, before it is carried out, or the end of episodes."""

    observations: NDArray[np.float32]
    """Of all robots, ``[N, O]``."""
    info: dict[str, Any]
    """Of all robots, as the environment gives it."""
    actions: NDArray[np.float32] | None
    """The decisions, ``[N, 2]``, zero for robots that do not drive; None at an end."""
    ended: list[tuple[int, int, EpisodeResult]]
    """Number of the robot, number of the task and result of each episode that ended."""


def drive_steps(
    env: VectorNavigationEnv, driver: Driver, tasks: Sequence[WorldTask], numbers: Sequence[int]
) -> Iterator[Step]:
    """Drive the tasks of these numbers; give each decision, and each end of episodes."""
    worlds = Counter[int]()
    episodes = []
    for task in tasks:
        episodes.append(worlds[id(task.world)])
        worlds[id(task.world)] += 1
    waiting, at_work = deque(numbers), np.full(env.num_envs, -1)
    planned, decided = np.zeros(env.num_envs), np.zeros(env.num_envs)
    decisions = np.zeros(env.num_envs, dtype=np.int64)
    observations = np.empty(env.observation_space.shape or (), np.float32)
    info: dict[str, Any] = {}
    while waiting or (at_work >= 0).any():
        begun = np.zeros(env.num_envs, dtype=np.bool_)
        for robot in np.flatnonzero(at_work < 0)[: len(waiting)]:
            at_work[robot], begun[robot] = waiting.popleft(), True
        if begun.any():
            observations, info = _begin(env, tasks, at_work, begun)
            decided[begun], decisions[begun] = 0.0, 0
        for robot in np.flatnonzero(begun).tolist():
            errand = env.errand(robot)
            start = time.process_time()
            driver.begin(robot, errand)
            planned[robot] = time.process_time() - start
        running = at_work >= 0
        robots = np.flatnonzero(running)
        actions = np.zeros((env.num_envs, 2), np.float32)
        senses = env.senses(robots)
        start = time.process_time()
        actions[running] = driver.drive(senses)
        decided[running] += (time.process_time() - start) / len(robots)
        decisions[running] += 1
        yield Step(observations, info, actions, [])
        observations, _, terminated, truncated, info = env.step(actions, only=running)
        ended = []
        for robot in np.flatnonzero(running & (terminated | truncated)).tolist():
            number, at_work[robot] = int(at_work[robot]), -1
            times = float(planned[robot]), float(decided[robot] / decisions[robot])
            result = _result(env, tasks[number], episodes[number], robot, info, *times)
            ended.append((robot, number, result))
        if ended:
            yield Step(observations, info, None, ended)


def _begin(
    env: VectorNavigationEnv,
    tasks: Sequence[WorldTask],
    at_work: NDArray[np.int64],
    begun: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Put robots at the start of their tasks; observations and infos of all robots."""
    chosen = [
        tasks[number] if begins else None
        for number, begins in zip(at_work.tolist(), begun, strict=True)
    ]
    seeds, worlds, pairs = (
        [None if each is None else getattr(each, name) for each in chosen]
        for name in ("seed", "world", "task")
    )
    options = {"reset_mask": begun, "worlds": worlds, "tasks": pairs}
    return env.reset(seed=seeds, options=options)


def _result(
    env: VectorNavigationEnv,
    task: WorldTask,
    episode: int,
    robot: int,
    info: dict[str, NDArray[Any]],
    plan_s: float,
    decision_s: float,
) -> EpisodeResult:
    """Read the result of a task that a robot has driven."""
    world, reference = task.world, task.reference_path
    time_s = float(info["sim_time"][robot])
    driven, shortest = float(info["path_length"][robot]), float(info["shortest_path"][robot])
    success, timeout = bool(info["success"][robot]), bool(info["timeout"][robot])
    speed, period = env.config.robot.max_wheel_speed, env.config.time_step
    return EpisodeResult(
        episode=episode,
        success=success,
        collision=bool(info["collision"][robot]),
        timeout=timeout,
        standstill=timeout and stands_still(np.array(env.trail(robot)), period),
        time_s=time_s,
        path_length=driven,
        shortest_path=shortest,
        min_clearance=float(info["min_clearance"][robot]),
        spl=spl(success, path_length=driven, shortest_path=shortest),
        sct=sct(success, time_s=time_s, shortest_path=shortest, speed=speed),
        plan_s=plan_s,
        decision_s=decision_s,
        world=world.name,
        barn_score=None
        if reference is None
        else barn_score(success, time_s=time_s, reference_path=reference),
        **({name: float(info[name][robot]) for name in ENCOUNTERS} if world.walkers else {}),
    )


@contextmanager
def _progress_bar(total: int | None) -> Iterator[Callable[[], object]]:
    """A function that advances a bar by one episode, if there is one."""
    if total is None:
        yield lambda: None
        return
    from tqdm import tqdm

    with closing(tqdm(desc="evaluate", total=total, unit="episode")) as bar:
        yield bar.update
