"""A run that drives in a second process: what it does, and what happens when that fails."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from collection import LocalCollector, RemoteCollector, Start
from exploration import Explorer
from settings import TrainSettings
from tests.integration.tiny_runs import rows, tiny, train
from training import TrainingRun, read_checkpoint


def overlapping(learner: str) -> TrainSettings:
    settings = tiny(learner=learner)
    settings.overlap = True
    return settings


class Delayed(LocalCollector):
    """Acts by the policy as it was when the episode was told to begin or to go on.

    It has random numbers of its own, as a process has.
    """

    def begin(self, start: Start, explorer: Explorer) -> None:
        self._live, self._old = explorer.policy, copy.deepcopy(explorer.policy)
        with torch.random.fork_rng(devices=[]):
            super().begin(start, explorer)
            self._random = torch.get_rng_state()

    def collect(self) -> TensorDictBase:
        self._explorer.policy = self._old
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._random)
            transition = super().collect()
            self._random = torch.get_rng_state()
        self._explorer.policy = self._live
        return transition

    def proceed(self) -> None:
        self._old = copy.deepcopy(self._live)


def delayed(folder: Path, settings: TrainSettings) -> TrainingRun:
    folder.mkdir()
    run = TrainingRun(replace(settings, overlap=False), folder)
    run.collector.close()
    run.collector = Delayed(settings, device="cpu")
    run.train()
    run.close()
    return run


def test_a_resumed_run_is_one_whose_policy_acts_an_update_older(tmp_path: Path) -> None:
    settings = overlapping("td3")
    settings.learner.actor_lr = 1e-2
    settings.evaluation.every, settings.evaluation.episodes = 50, 2
    whole = delayed(tmp_path / "delayed", settings)

    part = TrainingRun(settings, tmp_path)
    part.train(on_episode=lambda record: setattr(part, "_stop", record.episode == 3))
    part.close()
    resumed = TrainingRun(settings, tmp_path)
    resumed.load(read_checkpoint(tmp_path))
    assert resumed.train()
    resumed.close()

    assert rows(resumed) == rows(whole)
    assert rows(resumed) != rows(train(tmp_path / "serial", replace(settings, overlap=False)))
    assert resumed.explorer.sigma == whole.explorer.sigma < settings.exploration.sigma
    for mine, other in zip(
        resumed.learner.loss.state_dict().values(),
        whole.learner.loss.state_dict().values(),
        strict=True,
    ):
        assert torch.equal(mine, other)
    # Evaluations beside a run find what they find between two episodes.
    assert len(resumed.progress) == len(whole.progress) > 0
    for beside, between in zip(resumed.progress, whole.progress, strict=True):
        assert replace(beside, seconds=0.0) == replace(between, seconds=0.0)


def test_a_failure_in_the_second_process_is_told_in_the_first(tmp_path: Path) -> None:
    run = TrainingRun(overlapping("sac"), tmp_path)
    collector = run.collector
    assert isinstance(collector, RemoteCollector)
    try:
        collector.begin(Start("A", 0, 0), run.explorer)
        assert collector.collect().batch_size == (1,)
        collector.begin(Start("no-such-map", 0, 0), run.explorer)
        with pytest.raises(RuntimeError, match=r"(?s)environment failed .*no-such-map"):
            collector.collect()
        # It has ended then, and says so.
        with pytest.raises(RuntimeError, match=r"process of the environment has ended"):
            collector.collect()
    finally:
        run.close()
