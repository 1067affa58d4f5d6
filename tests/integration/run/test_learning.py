"""Training runs of minutes: does the robot learn to drive to its goal?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mpfa_envs import evaluate
from training.run.evaluations import exported_policy
from training.run.loop import TrainingRun
from training.settings.command_line import composed
from training.settings.train import (
    GROUPS,
    CurriculumSettings,
    EnvironmentSettings,
    EvaluationSettings,
    Stage,
    TrainSettings,
    register,
)

pytestmark = pytest.mark.slow
# Neither the tasks of training nor those that the documentation reports.
SEED = 4711


def settings_of(method: str, learner: str, episodes: int) -> TrainSettings:
    settings = TrainSettings(
        method=replace(GROUPS["method"][method]),
        learner=GROUPS["learner"][learner](),
        curriculum=CurriculumSettings("A", [Stage("A", episodes)]),
        environment=EnvironmentSettings(physics="kinematic"),
        seed=5,
    )
    settings.tracking.mode = "off"
    if method == "ref_er":
        # How fast it sets the policy free goes by the slots of the buffer.
        settings.method.capacity = 10_000
    return settings


def greedy_success(run: TrainingRun) -> float:
    policy = exported_policy(run.learner.policy, run.settings)
    results = evaluate(policy, "A", episodes=40, seed=SEED)
    return sum(result.success for result in results) / len(results)


def train(settings: TrainSettings, folder: Path) -> float:
    torch.set_num_threads(1)
    run = TrainingRun(settings, folder)
    run.train()
    run.close()
    return greedy_success(run)


RANDOM = 0.2
"""A robot that did not train finds at most this share of the goals, as a test below says."""
MARGIN = 0.4
WELL_TRAINED = 0.85


LEAST = {
    # Goals in hindsight are for sparse rewards, of which forty episodes hold few.
    **{
        (method, "ddpg"): RANDOM + MARGIN
        for method, made in sorted(GROUPS["method"].items())
        if not made.hindsight
    },
    **{(method, "ddpg"): WELL_TRAINED for method in ("mpfa_per", "per", "uniform")},
    **{(method, "td3"): WELL_TRAINED for method in ("mpfa_per", "la3p")},
    ("mpfa_per", "sac"): WELL_TRAINED,
}
"""Success after forty episodes: of any method far more than at random, of some most goals."""


@pytest.mark.parametrize(("method", "learner"), LEAST)
def test_a_robot_that_trained_for_forty_episodes_finds_its_goals(
    method: str, learner: str, tmp_path: Path
) -> None:
    assert train(settings_of(method, learner, 40), tmp_path) >= LEAST[method, learner]


def test_a_robot_that_did_not_train_finds_few_goals(tmp_path: Path) -> None:
    run = TrainingRun(settings_of("mpfa_per", "ddpg", 1), tmp_path)
    assert greedy_success(run) <= RANDOM
    run.close()


@pytest.mark.parametrize("broken", ["critic_lr", "gamma"])
def test_a_broken_learner_does_not_pass_for_one_that_works(broken: str, tmp_path: Path) -> None:
    settings = settings_of("mpfa_per", "ddpg", 40)
    # Either leaves a critic that says nothing of what lies ahead.
    setattr(settings.learner, broken, {"critic_lr": 1e-9, "gamma": 0.0}[broken])
    assert train(settings, tmp_path) < WELL_TRAINED


def test_the_settings_of_sparse_rewards_reach_goals_in_new_rooms_to_the_end(tmp_path: Path) -> None:
    register()
    file = Path(__file__).parents[3] / "examples/sparse.yaml"
    [settings] = composed([f"settings={file}", "seed=600", "tracking=off"])
    settings.evaluation = EvaluationSettings(12_000, "mixed:validation", 40)
    torch.set_num_threads(1)
    run = TrainingRun(settings, tmp_path)
    run.train()
    run.close()
    assert [found.success > WELL_TRAINED for found in run.evaluations] == [True, True]
