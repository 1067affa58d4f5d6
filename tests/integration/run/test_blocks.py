"""Updates in blocks, and what else a method asks of the training loop."""

from __future__ import annotations

from pathlib import Path

import torch

from tests.integration.tiny_runs import blocky, train, weights_of


def test_updates_come_in_blocks_and_are_as_many_as_without(tmp_path: Path) -> None:
    plain, blocks = dict[int, int](), dict[int, int]()
    for block, found in ((1, plain), (30, blocks)):
        train(
            tmp_path / str(block),
            blocky(block),
            lambda run, found=found: found.update({run.actions: run.updates}),
        )
    for actions, updates in blocks.items():
        last = actions // 30 * 30
        assert updates == (plain[last] if last else 0), actions
    assert blocks[120] == plain[120] == 2 * (120 - 15) // 3


def test_the_policy_stays_as_it_is_within_a_block(tmp_path: Path) -> None:
    weights: list[torch.Tensor] = []
    train(tmp_path, blocky(60), lambda run: weights.append(weights_of(run.learner.policy)))
    moved = [3 * (n + 1) for n in range(1, len(weights)) if not weights[n].equal(weights[n - 1])]
    assert moved == [60, 120]


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
