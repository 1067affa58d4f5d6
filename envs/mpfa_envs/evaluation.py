"""Greedy episodes of a policy between fixed starts and goals, and their statistics."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.arguments import Physics
from mpfa_envs.builtin_worlds import resolve_world
from mpfa_envs.checks import check_count
from mpfa_envs.navigation import NavigationEnv
from mpfa_envs.policy import Policy
from mpfa_envs.tasks import Task, evaluation_pairs
from mpfa_envs.worlds import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Action = Callable[[NDArray[np.float32]], NDArray[np.float32]]
    """All that a policy must be: a function from observation to action."""

ENVS_AT_ONCE = 8
"""How many episodes of a :class:`~mpfa_envs.Policy` run together by default."""
_LEVEL = 0.95
_RESAMPLES = 2000


@dataclass(frozen=True)
class EpisodeResult:
    """One evaluation episode."""

    episode: int
    """Number of the task."""
    success: bool
    collision: bool
    timeout: bool
    time_s: float
    """Simulated time [s]."""
    path_length: float
    """Distance driven [m]."""
    shortest_path: float
    """Shortest path of the task [m]."""
    min_clearance: float
    """Least distance between the robot's rim and an obstacle or wall [m]."""
    spl: float
    """Success weighted by path length, see :func:`spl`."""
    world: str = ""
    """Where it was."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


def spl(success: bool, *, path_length: float, shortest_path: float) -> float:
    """Success weighted by path length, of one episode (https://arxiv.org/abs/1807.06757).

    Args:
        success: Whether the goal was reached.
        path_length: Distance driven [m].
        shortest_path: Shortest path of the task [m].

    Returns:
        0 for a failure, 1 for a success on the shortest path.

    Examples:
        >>> spl(True, path_length=4.0, shortest_path=3.0)
        0.75
    """
    return success * shortest_path / max(path_length, shortest_path)


def evaluate(
    policy: Action,
    world: str | os.PathLike[str] | World | Sequence[str | os.PathLike[str] | World] = "test",
    *,
    episodes: int = 200,
    seed: int = 0,
    physics: Physics | None = None,
    envs_at_once: int | None = None,
    progress: bool = False,
    **env_arguments: Any,
) -> list[EpisodeResult]:
    """Drive a policy through fixed tasks; contact is the only collision.

    Args:
        policy: A :class:`~mpfa_envs.Policy` or any function from observation to action, see
            :func:`run_episodes`.
        world: A world as in :class:`~mpfa_envs.NavigationEnv`, or several.
        episodes: Number of tasks in each world, those of :func:`~mpfa_envs.evaluation_pairs`.
        seed: Seed of the tasks.
        physics: ``"wheels"`` or ``"kinematic"``; None: that of the policy.
        envs_at_once: How many episodes run together, which changes no result of a
            :class:`~mpfa_envs.Policy`; None: eight for one, else one at a time.
        progress: Whether to show a bar.
        **env_arguments: Arguments of :class:`~mpfa_envs.NavigationEnv` in place of
            ``policy.env_arguments``.

    Returns:
        One result an episode, world by world.

    Raises:
        ValueError: If an argument is out of its range; nothing has moved then.

    Examples:
        >>> from mpfa_envs import evaluate, summarize
        >>> ahead = lambda observation: np.ones(2)
        >>> results = evaluate(ahead, ["A", "rooms-7"], episodes=3, physics="kinematic")
        >>> [(result.world, result.episode) for result in results[2:4]]
        [('A', 2), ('rooms-7', 0)]
        >>> sorted(summarize(results))[:3]
        ['collision', 'min_clearance', 'path_length']
    """
    if envs_at_once is None:
        envs_at_once = ENVS_AT_ONCE if isinstance(policy, Policy) else 1
    check_count("episodes", episodes)
    check_count("envs_at_once", envs_at_once)
    arguments = {**getattr(policy, "env_arguments", {}), **env_arguments}
    if physics is not None:
        arguments["physics"] = physics
    robot = arguments.get("robot", "turtlebot2")
    several = [world] if isinstance(world, (str, os.PathLike, World)) else world
    worlds = [resolve_world(each) for each in several]
    tasks = [evaluation_pairs(each, episodes, seed, robot=robot) for each in worlds]
    results: list[EpisodeResult] = []
    with _progress_bar(len(worlds) * episodes if progress else None) as advance:
        for each, chosen in zip(worlds, tasks, strict=True):
            with _make_envs(min(envs_at_once, episodes), each, arguments) as envs:
                results += run_episodes(envs, policy, chosen, on_end=lambda *_: advance())
    return results


def run_episodes(
    envs: NavigationEnv | Sequence[NavigationEnv],
    policy: Action,
    tasks: Sequence[Task],
    *,
    on_step: Callable[[NavigationEnv], object] | None = None,
    on_end: Callable[[NavigationEnv, EpisodeResult], object] | None = None,
) -> list[EpisodeResult]:
    """Drive every task once.

    Args:
        envs: One environment, for one episode after the other, or several with equal arguments, for
            as many at once.
        policy: From one observation, ``[O]``, to one action, ``[A]``. With a list of environments
            from ``[N, O]`` to ``[N, A]`` for the N episodes that are under way.
        tasks: Starts and goals.
        on_step: Called after every reset and step, to render a picture, say.
        on_end: Called at the end of every episode; ``env.trail`` is its trajectory.

    Returns:
        One result a task, in the order of the tasks.

    Raises:
        ValueError: If there is no environment, or the policy gives no action for each observation.
    """
    several = not isinstance(envs, NavigationEnv)
    waiting = deque(enumerate(tasks))
    results: dict[int, EpisodeResult] = {}
    idle: list[NavigationEnv] = list(envs) if several else [envs]  # type: ignore[arg-type, list-item]
    if not idle:
        raise ValueError("envs must hold at least one environment")
    running: list[tuple[NavigationEnv, int, NDArray[np.float32]]] = []
    while waiting or running:
        while idle and waiting:
            env = idle.pop()
            number, task = waiting.popleft()
            # The seed is that of a noisy lidar: each episode has its own, whichever env it is in.
            observation, _ = env.reset(seed=number, options=task._asdict())
            running.append((env, number, observation))
            if on_step:
                on_step(env)
        observations = [observation for *_, observation in running]
        actions = _choose(policy, observations) if several else [policy(observations[0])]
        episodes, running = running, []
        for (env, number, _), action in zip(episodes, actions, strict=True):
            observation, _, terminated, truncated, info = env.step(action)
            if on_step:
                on_step(env)
            if not (terminated or truncated):
                running.append((env, number, observation))
                continue
            results[number] = _result(number, env, info)
            idle.append(env)
            if on_end:
                on_end(env, results[number])
    return [results[number] for number in range(len(tasks))]


def summarize(results: Sequence[EpisodeResult], *, seed: int = 0) -> dict[str, Interval]:
    """Rates and means with 95 % intervals; time and path count successes only.

    Rates have Wilson's interval, which stays right near 0 and 1, means that of the percentile
    bootstrap; NaN where there are no two values to tell a spread from.

    Args:
        results: The episodes.
        seed: Seed of the bootstrap.

    Returns:
        Estimates by name; success, collision and timeout sum to one.

    Raises:
        ValueError: If there are no results.
    """
    if not results:
        raise ValueError("results must hold at least one episode")
    rng = np.random.default_rng(seed)
    reached = [result for result in results if result.success]
    return {
        "success": wilson([result.success for result in results]),
        "collision": wilson([result.collision for result in results]),
        "timeout": wilson([result.timeout for result in results]),
        "spl": bootstrap([result.spl for result in results], rng),
        "time_s": bootstrap([result.time_s for result in reached], rng),
        "path_length": bootstrap([result.path_length for result in reached], rng),
        "min_clearance": bootstrap([result.min_clearance for result in results], rng),
    }


def wilson(outcomes: Sequence[bool]) -> Interval:
    """A rate with Wilson's 95 % interval.

    Args:
        outcomes: Of each trial; at least one.

    Returns:
        The rate and its interval.

    Examples:
        >>> interval = wilson([True] * 181 + [False] * 19)
        >>> round(interval.low, 3), round(interval.high, 3)
        (0.856, 0.938)
    """
    from scipy.stats import binomtest

    test = binomtest(sum(outcomes), len(outcomes))
    found = test.proportion_ci(_LEVEL, method="wilson")
    return Interval(float(test.statistic), float(found.low), float(found.high))


def bootstrap(values: Sequence[float], rng: np.random.Generator) -> Interval:
    """A mean with its 95 % percentile bootstrap interval.

    Args:
        values: The sample; without values all is NaN, with one its interval is.
        rng: Source of the resamples.

    Returns:
        The mean and its interval.

    Examples:
        >>> interval = bootstrap([3.0, 4.0, 5.0, 6.0], np.random.default_rng(0))
        >>> interval.value, 3.0 <= interval.low < 4.5 < interval.high <= 6.0
        (4.5, True)
    """
    from scipy import stats

    if len(values) < 2:
        return Interval(float(values[0]) if values else math.nan, math.nan, math.nan)
    found = stats.bootstrap(
        (np.asarray(values, dtype=np.float64),),
        np.mean,
        n_resamples=_RESAMPLES,
        batch=100,
        confidence_level=_LEVEL,
        method="percentile",
        rng=rng,
    ).confidence_interval
    return Interval(float(np.mean(values)), float(found.low), float(found.high))


def _choose(policy: Action, observations: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """One action for each observation."""
    actions = np.asarray(policy(np.stack(observations)))
    if actions.shape != (len(observations), 2):
        raise ValueError(
            f"policy must give actions of shape {(len(observations), 2)} for observations of shape "
            f"{(len(observations), *observations[0].shape)}, got {actions.shape}; one that takes "
            "a single observation runs with envs_at_once=1"
        )
    return actions


def _result(number: int, env: NavigationEnv, info: dict[str, Any]) -> EpisodeResult:
    driven, shortest = info["path_length"], info["shortest_path"]
    return EpisodeResult(
        episode=number,
        success=info["success"],
        collision=info["collision"],
        timeout=info["timeout"],
        time_s=info["sim_time"],
        path_length=driven,
        shortest_path=shortest,
        min_clearance=info["min_clearance"],
        spl=spl(info["success"], path_length=driven, shortest_path=shortest),
        world=env.world.name,
    )


@contextmanager
def _make_envs(
    count: int, world: World, arguments: dict[str, Any]
) -> Iterator[NavigationEnv | list[NavigationEnv]]:
    """One environment, or a list of several, which are closed in the end."""
    arguments = {"collision_distance": "contact", **arguments, "world": world}
    envs: list[NavigationEnv] = []
    try:
        while len(envs) < count:
            envs.append(NavigationEnv(**arguments))
        yield envs if count > 1 else envs[0]
    finally:
        for env in envs:
            env.close()


@contextmanager
def _progress_bar(total: int | None) -> Iterator[Callable[[], object]]:
    """A function that advances a bar by one episode, if there is one."""
    if total is None:
        yield lambda: None
        return
    from tqdm import tqdm

    with closing(tqdm(total=total, unit="episode")) as bar:
        yield bar.update
