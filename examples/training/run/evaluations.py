"""The policy of a run as a function of its own, its evaluations in fixed tasks, and its values."""

from __future__ import annotations

import time
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from mpfa_envs import Policy, RobotModel, WorldTask, world_tasks
from mpfa_envs.robots.resolve import resolve_robot
from torchrl_mpfa import ActorCritic, Learner
from training.environments import env_arguments
from training.evaluating import Drives, as_trained, drive_together
from training.pictures import Values
from training.records import EvaluationRecord, last_best
from training.run.assembly import policy_layers
from training.settings.learners import is_discrete
from training.settings.train import TrainSettings

if TYPE_CHECKING:
    from training.run.loop import TrainingRun

SEED = 1
"""Seed of the pairs of start and goal: other pairs than those of ``evaluate.py``."""


def exported_policy(
    policy: TensorDictModule, settings: TrainSettings, *, episodes: int = 0, steps: int = 0
) -> Policy:
    """Return the policy without noise, with its card and the arguments of its environment."""
    return Policy(
        policy_layers(policy),
        card={
            "method": settings.method.name,
            "learner": settings.learner.name,
            "curriculum": settings.curriculum.name,
            "seed": settings.seed,
            "filter": _always_filtered(settings),
            "episodes": episodes,
            "steps": steps,
        },
        env_arguments=env_arguments(settings.environment),
    )


def _always_filtered(settings: TrainSettings) -> bool:
    """Return True if a policy needs the filter: if all robots had it."""
    return settings.environment.filter == 1.0 and not is_discrete(settings.learner)


def kept_policy(run: TrainingRun) -> Policy:
    """Return the policy of a run: the last one, or the best in evaluations."""
    policy, episodes, steps = run.learner.policy, run.schedule.episodes, run.actions
    if run.settings.evaluation.choose and run.best is not None:
        record = last_best(run.evaluations)
        policy, episodes, steps = run.best, record.episode, record.total_steps
    return exported_policy(policy, run.settings, episodes=episodes, steps=steps)


def evaluate_policy(
    settings: TrainSettings,
    policy: TensorDictModule,
    *,
    total_steps: int,
    episode: int,
    trained_for: float,
) -> tuple[EvaluationRecord, Drives]:
    """Drive the fixed tasks of the validation world, or of others that the settings name.

    Args:
        settings: Of the run.
        policy: The policy as it is now.
        total_steps: Actions so far.
        episode: Episodes so far.
        trained_for: Wall-clock time of the training so far [s].

    Returns:
        Rates of success, collision and timeout, the means of SPL and SCT, and the episodes.
    """
    start = time.perf_counter()
    wanted, driver = settings.evaluation, as_trained(exported_policy(policy, settings))
    tasks = _tasks(wanted.world, wanted.episodes, resolve_robot(settings.environment.robot))
    [driven] = drive_together(driver, [tasks], progress=False, **driver.env_arguments)
    names = ("success", "collision", "timeout", "spl", "sct")
    record = EvaluationRecord(
        total_steps=total_steps,
        episode=episode,
        world=wanted.world,
        seconds=time.perf_counter() - start,
        trained_for=trained_for,
        **{name: sum(getattr(r, name) for r in driven.results) / len(tasks) for name in names},
    )
    return record, driven


@lru_cache(maxsize=4)
def _tasks(world: str, episodes: int, robot: RobotModel) -> list[WorldTask]:
    """The tasks of each evaluation, with worlds whose shortest paths are known from the second."""
    return world_tasks(world, episodes=episodes, seed=SEED, robot=robot)


def values_of(learner: Learner, policy: Policy, settings: TrainSettings) -> Values:
    """Return a function that values a policy's actions by the critics of a learner.

    Args:
        learner: The learner; its networks are used as they are when the values are asked for.
        policy: Whose actions are valued; a learner without an actor values its own.
        settings: Of the run.

    Returns:
        The values, in units of the reward.
    """
    device = settings.device
    scale = settings.learner.reward_scale

    def values(observations: NDArray[np.float32]) -> NDArray[np.float64]:
        inputs = {"observation": torch.as_tensor(observations, device=device)}
        with torch.no_grad():
            if isinstance(learner, ActorCritic):
                inputs["action"] = torch.as_tensor(policy(observations), device=device)
                best = learner.values_of(TensorDict(inputs, [len(observations)])).amin(0)
            else:
                best = learner.policy.outputs(inputs)["chosen_action_value"].squeeze(-1)
        return best.double().cpu().numpy() / scale

    return values
