"""Training runs that learn from goals in hindsight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.integration.tiny_runs import (
    assert_same_run,
    go_on,
    mostly_slow,
    stop_after,
    tiny,
    train,
)
from training.run.loop import TrainingRun
from training.settings.train import Stage, TrainSettings


def sparse(method: str = "her", **changes: object) -> TrainSettings:
    """Three robots, with a reward for the goal and the collision alone."""
    settings = tiny(method, [Stage("A", actions=240)], robots=3, updates=2)
    settings.method = replace(settings.method, capacity=2000, **{"hindsight": 2, **changes})
    settings.environment.progress = "none"
    settings.environment.memory = "map"
    settings.environment.max_steps = 40
    return settings


def buffer_of(run: TrainingRun) -> torch.Tensor:
    return run.buffer.storage[:]["observation"]


@pytest.mark.parametrize("method", mostly_slow(["her", "mpfa_per", "ref_er", "la3p"], ["her"]))
def test_a_resumed_run_with_goals_in_hindsight_is_an_uninterrupted_one(
    method: str, tmp_path: Path
) -> None:
    whole = train(tmp_path / "whole", sparse(method))
    stop_after(100, tmp_path / "parts", sparse(method))
    resumed = go_on(tmp_path / "parts", sparse(method))
    assert_same_run(resumed, whole)
    assert torch.equal(buffer_of(resumed), buffer_of(whole))
    assert len(whole.buffer) > whole.actions


def test_hindsight_adds_goals_and_neither_actions_nor_updates(tmp_path: Path) -> None:
    runs = {n: train(tmp_path / str(n), sparse("ddpg", hindsight=n)) for n in (0, 2)}
    assert [run.actions for run in runs.values()] == [240, 240]
    assert runs[0].updates == runs[2].updates > 0
    goals = {n: int((run.buffer.rewards() == 10).sum()) for n, run in runs.items()}
    assert goals[2] > goals[0]
    # Rows of the log are about what the robots did.
    own = {n: sum(record.reward for record in run.records) for n, run in runs.items()}
    assert all(abs(own[n]) <= 10 * len(run.records) for n, run in runs.items())
    for run in runs.values():
        run.log.add(run.actions, episode=0, buffer=run.buffer)
        assert abs(run.log.rows[-1]["average_reward"]) <= 10
