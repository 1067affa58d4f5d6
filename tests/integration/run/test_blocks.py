"""Updates in blocks, and what else a method asks of the training loop."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.integration.run.test_training import assert_same_run, stop_after
from tests.integration.tiny_runs import tiny, train
from training.run.checkpoints import read_checkpoint
from training.run.loop import TrainingRun
from training.settings.train import Stage, TrainSettings


def blocky(block: int, method: str = "rud") -> TrainSettings:
    settings = tiny(method, [Stage("A", actions=120)], robots=3, updates=2)
    settings.method.batch_size, settings.method.update_block = 16, block
    return settings


def updates_by_actions(folder: Path, settings: TrainSettings) -> dict[int, int]:
    """Updates that were made after so many actions."""
    folder.mkdir()
    run = TrainingRun(settings, folder)
    found: dict[int, int] = {}
    run.train(lambda: found.update({run.actions: run.updates}))
    run.close()
    return found


def test_updates_come_in_blocks_and_are_as_many_as_without(tmp_path: Path) -> None:
    plain = updates_by_actions(tmp_path / "plain", blocky(1))
    blocks = updates_by_actions(tmp_path / "blocks", blocky(30))
    for actions, updates in blocks.items():
        last = actions // 30 * 30
        assert updates == (plain[last] if last else 0), actions
    assert blocks[120] == plain[120] == 2 * (120 - 15) // 3


def test_the_policy_stays_as_it_is_within_a_block(tmp_path: Path) -> None:
    run = TrainingRun(blocky(60), tmp_path)
    weights: list[torch.Tensor] = []
    run.train(
        lambda: weights.append(
            torch.cat([p.detach().reshape(-1).clone() for p in run.learner.policy.parameters()])
        )
    )
    run.close()
    moved = [3 * (n + 1) for n in range(1, len(weights)) if not weights[n].equal(weights[n - 1])]
    assert moved == [60, 120]


@pytest.mark.parametrize("method", ["rud", "reaper", "ref_er"])
def test_a_run_that_is_stopped_within_a_block_goes_on_alike(tmp_path: Path, method: str) -> None:
    settings = blocky(30, method)
    whole = train(tmp_path / "whole", settings)
    stop_after(45, tmp_path, settings)
    resumed = TrainingRun(settings, tmp_path, read_checkpoint(tmp_path))
    assert resumed.train()
    resumed.close()
    assert_same_run(resumed, whole)


def test_episodes_are_numbered_and_no_two_share_a_number(tmp_path: Path) -> None:
    settings = blocky(1, "reaper")
    settings.environment.max_steps, settings.method.capacity = 8, 120
    run = train(tmp_path / "reaper", settings)
    stored = run.buffer[:]
    episodes = stored["episode"].reshape(-1, 3)  # A column for each robot, step by step.
    done = stored["next", "done"].reshape(-1, 3)
    assert not set(episodes[:, 0].tolist()) & set(episodes[:, 1].tolist())
    for robot in range(3):
        ends = done[:-1, robot]
        changes = episodes[1:, robot] != episodes[:-1, robot]
        assert changes.equal(ends)
    assert done.any()
    plain = train(tmp_path / "plain", blocky(1)).buffer[:]
    assert plain.get("episode", None) is None
