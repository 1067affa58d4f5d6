"""Greedy episodes of a policy on fixed tasks, and what they amount to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModule
from tqdm import tqdm

from mpfa_envs import NavigationEnv, Task

Action = Callable[[NDArray[np.float32]], NDArray[np.float32]]


@dataclass
class EpisodeResult:
    """One evaluation episode."""

    episode: int
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
    """Least distance between the robot's rim and an obstacle [m]."""
    spl: float
    """Success weighted by path length: 0 for a failure, 1 for a success on the shortest path."""


@dataclass
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


def greedy(policy: TensorDictModule) -> Action:
    """The policy's action without noise, from one observation."""
    device = next(policy.parameters()).device

    @torch.no_grad()
    def act(observation: NDArray[np.float32]) -> NDArray[np.float32]:
        # Outside of exploration a stochastic policy gives the middle of its distribution.
        found = policy.outputs({"observation": torch.from_numpy(observation).to(device)})
        action: NDArray[np.float32] = found["action"].cpu().numpy()
        return action

    return act


def run_episode(
    env: NavigationEnv, act: Action, task: Task, number: int, *, frames: list[Any] | None = None
) -> tuple[EpisodeResult, NDArray[np.float64]]:
    """Drive one task.

    Args:
        env: The environment.
        act: From observation to action.
        task: Start and goal.
        number: Number of the episode, for the record.
        frames: Where to append a picture of every step, if wanted.

    Returns:
        The result, and the robot's positions, shape ``[steps + 1, 2]`` [m].
    """
    observation, info = env.reset(options=task._asdict())
    positions = [(info["x"], info["y"])]
    over = False
    while not over:
        if frames is not None:
            frames.append(env.render())
        observation, _, terminated, truncated, info = env.step(act(observation))
        positions.append((info["x"], info["y"]))
        over = terminated or truncated
    if frames is not None:
        frames.append(env.render())
    success = bool(info["success"])
    shortest = float(info["shortest_path"])
    driven = float(info["path_length"])
    return (
        EpisodeResult(
            episode=number,
            success=success,
            collision=bool(info["collision"]),
            timeout=bool(info["timeout"]),
            time_s=float(info["sim_time"]),
            path_length=driven,
            shortest_path=shortest,
            min_clearance=float(info["min_clearance"]),
            spl=success * shortest / max(driven, shortest),
        ),
        np.array(positions, dtype=np.float64),
    )


def run_episodes(
    env: NavigationEnv, act: Action, tasks: Sequence[Task], *, progress: bool = True
) -> tuple[list[EpisodeResult], list[NDArray[np.float64]]]:
    """Drive every task once.

    Args:
        env: The environment.
        act: From observation to action.
        tasks: Starts and goals.
        progress: Whether to show a bar.

    Returns:
        One result and one trajectory a task.
    """
    results, trajectories = [], []
    for number, task in enumerate(tqdm(tasks, unit="episode", disable=not progress)):
        result, positions = run_episode(env, act, task, number)
        results.append(result)
        trajectories.append(positions)
    return results, trajectories


def wilson(successes: int, total: int) -> Interval:
    """A rate with Wilson's 95 % interval, which stays right near 0 and 1.

    Args:
        successes: Number of successes.
        total: Number of trials.

    Returns:
        The rate and its interval.
    """
    z = 1.959964
    rate = successes / total
    scale = 1 + z * z / total
    center = (rate + z * z / (2 * total)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / total + z * z / (4 * total * total))
    return Interval(rate, max(center - half, 0.0), min(center + half, 1.0))


def bootstrap(values: Sequence[float], rng: np.random.Generator, *, draws: int = 2000) -> Interval:
    """A mean with its 95 % bootstrap interval; NaN without values.

    Args:
        values: The sample.
        rng: Source of the draws.
        draws: Number of resamples.

    Returns:
        The mean and its interval.
    """
    if not values:
        return Interval(math.nan, math.nan, math.nan)
    sample = np.asarray(values, dtype=np.float64)
    means = sample[rng.integers(len(sample), size=(draws, len(sample)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(float(sample.mean()), float(low), float(high))


def summarize(results: Sequence[EpisodeResult], *, seed: int = 0) -> dict[str, Interval]:
    """Rates and means with intervals; time and path count successes only.

    Args:
        results: The episodes.
        seed: Seed of the bootstrap.

    Returns:
        Estimates by name; success, collision and timeout sum to one.
    """
    rng = np.random.default_rng(seed)
    total = len(results)
    reached = [r for r in results if r.success]
    return {
        "success": wilson(sum(r.success for r in results), total),
        "collision": wilson(sum(r.collision for r in results), total),
        "timeout": wilson(sum(r.timeout for r in results), total),
        "spl": bootstrap([r.spl for r in results], rng),
        "time_s": bootstrap([r.time_s for r in reached], rng),
        "path_length": bootstrap([r.path_length for r in reached], rng),
        "min_clearance": bootstrap([r.min_clearance for r in results], rng),
    }
