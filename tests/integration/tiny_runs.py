"""Runs of the training script that take a second, and what they are compared by."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from training.run.loop import TrainingRun
from training.settings.train import (
    GROUPS,
    CurriculumSettings,
    EnvironmentSettings,
    Stage,
    TrainSettings,
)

# Two worlds, so that a change of world lies between the checkpoints too.
STAGES = [Stage("A", 3), Stage("B", 3)]
OVERRIDES = [
    "regime=paper",
    "learner.width=8",
    "method.batch_size=8",
    "method.capacity=200",
    "environment.physics=kinematic",
    "environment.max_steps=20",
    "evaluation.every=0",
    "tracking=off",
]
"""The same on the command line."""


def tiny(
    method: str = "mpfa_per",
    episodes: list[Stage] | None = None,
    learner: str = "ddpg",
    *,
    robots: int = 1,
    updates: int = 1,
) -> TrainSettings:
    settings = TrainSettings(
        method=replace(GROUPS["method"][method]),
        learner=GROUPS["learner"][learner](),
        curriculum=CurriculumSettings("tiny", list(episodes or STAGES)),
        environment=EnvironmentSettings(physics="kinematic", max_steps=14),
        checkpoint_every=10_000,
        seed=3,
        robots=robots,
        updates=updates,
    )
    settings.method.capacity, settings.method.batch_size = 30, 8
    settings.method.update_block = min(settings.method.update_block, 10)
    settings.learner.width = 16
    settings.exploration.random_steps = 10
    settings.exploration.annealing_steps = 30
    settings.tracking.mode = "off"
    return settings


def rows(run: TrainingRun) -> list[dict[str, object]]:
    return [{k: v for k, v in asdict(r).items() if k != "seconds"} for r in run.records]


def train(folder: Path, settings: TrainSettings) -> TrainingRun:
    folder.mkdir(parents=True, exist_ok=True)
    run = TrainingRun(settings, folder)
    run.train()
    run.close()
    return run
