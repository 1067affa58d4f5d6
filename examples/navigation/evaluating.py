"""A policy out of a training run as a function of its own, and how well it drives."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict.nn import TensorDictModule
from tqdm import tqdm

from mpfa_envs import (
    EpisodeResult,
    NavigationEnv,
    Policy,
    evaluate,
    evaluation_pairs,
    run_episodes,
    summarize,
)
from navigation.assembly import policy_layers
from navigation.environments import env_arguments
from navigation.records import EpisodeRecord, EvaluationRecord
from navigation.settings import TrainSettings

_AT_ONCE = 8
_SEED = 1
"""Of the pairs of start and goal: others than those of ``evaluate.py``."""


@dataclass(frozen=True)
class Drives:
    """What a policy did in one world."""

    results: list[EpisodeResult]
    trails: list[list[tuple[float, float]]]
    """Positions of the robot in each episode [m]."""
    goals: list[tuple[float, float]]
    """Of each episode [m]."""


def drive(
    policy: Policy, world: str, *, episodes: int, seed: int, physics: str | None, progress: bool
) -> Drives:
    """Drive a policy between fixed pairs of start and goal, contact being the only collision.

    As :func:`mpfa_envs.evaluate`, and the ways are kept.

    Args:
        policy: The policy.
        world: Name of a world, or a world file.
        episodes: Number of pairs.
        seed: Seed of the pairs.
        physics: ``wheels`` or ``kinematic``; None: as trained.
        progress: Whether to show a bar.

    Returns:
        Results and ways.
    """
    arguments = {**policy.env_arguments, "collision_distance": "contact", "world": world}
    if physics is not None:
        arguments["physics"] = physics
    tasks = evaluation_pairs(world, episodes, seed, robot=arguments["robot"])
    trails: dict[int, list[tuple[float, float]]] = {}
    with ExitStack() as opened, tqdm(total=episodes, desc=world, disable=not progress) as bar:

        def keep(env: NavigationEnv, result: EpisodeResult) -> None:
            trails[result.episode] = env.trail
            bar.update()

        envs = [
            opened.enter_context(closing(NavigationEnv(**arguments)))
            for _ in range(min(_AT_ONCE, episodes))
        ]
        results = run_episodes(envs, policy, tasks, on_end=keep)
    return Drives(results, [trails[n] for n in range(episodes)], [task.goal for task in tasks])


def film(
    policy: Policy, world: str, *, episode: int, seed: int, physics: str | None
) -> list[NDArray[np.uint8]]:
    """Pictures of one of the episodes of :func:`drive`, each of shape ``[height, width, 3]``."""
    arguments = {**policy.env_arguments, "collision_distance": "contact", "world": world}
    if physics is not None:
        arguments["physics"] = physics
    task = evaluation_pairs(world, episode + 1, seed, robot=arguments["robot"])[episode]
    frames: list[Any] = []
    with closing(NavigationEnv(**arguments, render_mode="rgb_array")) as env:
        run_episodes(env, policy, [task], on_step=lambda env: frames.append(env.render()))
    return frames


def summary_row(results: Sequence[EpisodeResult]) -> dict[str, float]:
    """Estimates of :func:`mpfa_envs.summarize` with the ends of their intervals, as one row."""
    row: dict[str, float] = {"episodes": len(results)}
    for name, interval in summarize(results).items():
        row |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return row


def exported_policy(
    policy: TensorDictModule, settings: TrainSettings, records: Sequence[EpisodeRecord] = ()
) -> Policy:
    """The policy without noise, with what is needed to use it and how it was trained.

    Args:
        policy: The policy in training.
        settings: Of the run.
        records: Its episodes so far.

    Returns:
        The policy, whose weights are copies.
    """
    return Policy.from_layers(
        policy_layers(policy),
        card={
            "method": settings.method.name,
            "learner": settings.learner.name,
            "curriculum": settings.curriculum.name,
            "seed": settings.seed,
            "episodes": len(records),
            "steps": records[-1].total_steps if records else 0,
        },
        env_arguments=env_arguments(settings.environment),
    )


def evaluate_policy(
    settings: TrainSettings, policy: TensorDictModule, *, total_steps: int, episode: int
) -> EvaluationRecord:
    """Drive the fixed pairs of the validation world, or of another one that the settings name.

    Args:
        settings: Of the run.
        policy: The policy as it is now.
        total_steps: Actions so far.
        episode: Episodes so far.

    Returns:
        Rates of success, collision and timeout, and the mean SPL.
    """
    start = time.perf_counter()
    wanted = settings.evaluation
    results = evaluate(
        exported_policy(policy, settings), wanted.world, episodes=wanted.episodes, seed=_SEED
    )
    names = ("success", "collision", "timeout", "spl")
    return EvaluationRecord(
        total_steps=total_steps,
        episode=episode,
        world=wanted.world,
        seconds=time.perf_counter() - start,
        **{name: sum(getattr(r, name) for r in results) / len(results) for name in names},
    )
