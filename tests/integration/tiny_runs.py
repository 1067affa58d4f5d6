"""Runs of the training script that take a second, and what they are compared by."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.paper.methods import RECONSTRUCTIONS
from training.run.checkpoints import read_checkpoint
from training.run.hooks import Hook
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
    "learner.compile=false",
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
        method=replace((GROUPS["method"] | RECONSTRUCTIONS)[method]),
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


def blocky(block: int, method: str = "rud") -> TrainSettings:
    """Three robots, whose updates come in blocks after so many actions."""
    settings = tiny(method, [Stage("A", actions=120)], robots=3, updates=2)
    settings.method.batch_size, settings.method.update_block = 18, block
    return settings


def mostly_slow(cases: Iterable[Any], kept: Collection[Any]) -> list[Any]:
    """Mark all cases of a test slow but those that are kept."""
    return [c if c in kept else pytest.param(*_as_tuple(c), marks=pytest.mark.slow) for c in cases]


def _as_tuple(case: Any) -> tuple[Any, ...]:
    return case if isinstance(case, tuple) else (case,)


def weights_of(policy: torch.nn.Module) -> torch.Tensor:
    return torch.cat([each.detach().reshape(-1).clone() for each in policy.parameters()])


def rows(run: TrainingRun) -> list[dict[str, object]]:
    return [{k: v for k, v in asdict(r).items() if k != "seconds"} for r in run.records]


class Look(Hook):
    """Calls a function after each iteration."""

    def __init__(self, look: Callable[[TrainingRun], object]) -> None:
        self.on_iteration = look


def train(
    folder: Path,
    settings: TrainSettings,
    look: Callable[[TrainingRun], object] = lambda run: None,
    *,
    state: dict[str, Any] | None = None,
) -> TrainingRun:
    """Train to the end, or until ``look`` stops it after an iteration."""
    folder.mkdir(parents=True, exist_ok=True)
    run = TrainingRun(settings, folder, state, [Look(look)])
    run.train()
    run.close()
    return run


def stop_after(actions: int, folder: Path, settings: TrainSettings) -> TrainingRun:
    run = train(folder, settings, lambda run: run.actions >= actions and run.stop.ask())
    assert actions <= run.actions < actions + settings.robots
    assert not run.schedule.finished
    return run


def go_on(folder: Path, settings: TrainSettings) -> TrainingRun:
    """Train on from the checkpoint of a folder, to the end."""
    run = train(folder, settings, state=read_checkpoint(folder))
    assert run.schedule.finished
    return run


def assert_same_run(resumed: TrainingRun, whole: TrainingRun) -> None:
    """Assert the same episodes, networks, random numbers, priorities and signals, bit by bit."""
    assert rows(resumed) == rows(whole)
    assert resumed.actions == whole.actions
    networks = [run.learner.state_dict()["networks"] for run in (resumed, whole)]
    assert networks[0].keys() == networks[1].keys()
    assert all(networks[0][name].equal(networks[1][name]) for name in networks[0])
    mine, other = resumed.buffer.state_dict(), whole.buffer.state_dict()
    assert torch.equal(mine["_rng"][0], other["_rng"][0])
    if "_sum_tree" in other["_sampler"]:
        assert torch.equal(mine["_sampler"]["_sum_tree"], other["_sampler"]["_sum_tree"])
    if "_signals" in other["_storage"]:
        signals = [state["_storage"]["_signals"]["rows"] for state in (mine, other)]
        # NaN marks what is not known yet.
        torch.testing.assert_close(*signals, rtol=0, atol=0, equal_nan=True)
