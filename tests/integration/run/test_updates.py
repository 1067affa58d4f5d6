"""Updates in blocks, and the rows that tell what a run learned from, against plain loops."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from tensordict import TensorDictBase

from tests.integration.tiny_runs import (
    blocky,
    go_on,
    mostly_slow,
    tiny,
    train,
    weights_of,
)
from torchrl_mpfa.selection import SampledBatch
from training.records import read_table
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.run.updates import COLUMNS, UpdateLog
from training.settings.train import Stage


def of_run(folder: Path) -> pd.DataFrame:
    return read_table(folder / "updates.csv")


@pytest.mark.usefixtures("reconstructed")
@pytest.mark.parametrize("method", mostly_slow(["mpfa_per", "uniform", "klper"], ["mpfa_per"]))
def test_the_rows_say_what_was_sampled_and_how_old_its_errors_were(
    tmp_path: Path, method: str
) -> None:
    settings = tiny(method)
    settings.environment.max_steps, settings.tracking.log_every = 18, 7
    run = TrainingRun(settings, tmp_path)
    learned: dict[int, int] = {}
    rewards: list[float] = []
    expected: list[dict[str, float]] = []
    extend, prepared = run.buffer.extend, run._prepared

    def extended(rows: Any) -> torch.Tensor:
        index = extend(rows)
        rewards.extend(rows["next", "reward"].flatten().tolist())
        for slot in index.tolist():
            learned.pop(slot, None)
        return index

    updates = 0

    def sees(draw: SampledBatch) -> SampledBatch:
        nonlocal updates
        updates += 1
        slots = draw.batch["index"].tolist()
        ages = [updates - learned[slot] for slot in slots if slot in learned]
        positive = (run.buffer[:]["next", "reward"].flatten() > 0).tolist()
        every = [
            updates - at for slot, at in ({**learned, **dict.fromkeys(slots, updates)}).items()
        ]
        expected.append(
            {
                "td_error_age": sum(ages) / len(ages) if ages else math.nan,
                "fresh": 1 - len(ages) / len(slots),
                "positive_batch": sum(positive[slot] for slot in slots) / len(slots),
                "positive_buffer": sum(positive) / len(positive),
                "td_error_age_buffer": sum(every) / len(every),
            }
        )
        learned.update(dict.fromkeys(slots, updates))
        return prepared(draw)

    run.buffer.extend = extended
    run._prepared = sees
    run.train()
    run.close()
    found = of_run(tmp_path)
    assert list(found.columns[: len(COLUMNS)]) == list(COLUMNS)
    assert found["total_steps"].tolist() == list(range(7, run.actions + 1, 7))
    for place, row in enumerate(found.to_dict("records")):
        assert row["reward"] == pytest.approx(sum(rewards[7 * place : 7 * place + 7]))
        assert row["average_reward"] == pytest.approx(row["reward"] / 7)
        if row["updates"] == 0:
            assert math.isnan(row["td_error"])
            continue
        assert row["td_error"] > 0
        for name, value in expected[int(row["updates"]) - 1].items():
            assert row[name] == pytest.approx(value, nan_ok=True), name
    assert found["updates"].iloc[-1] > 20
    assert found["td_error_age"].max() > 1
    if method == "mpfa_per":
        assert set(found["phi"]) == {3.0}
        weights = found[[f"weight_{name}" for name in settings.method.signals]].dropna()
        assert weights.sum(axis=1).tolist() == pytest.approx([1.0] * len(weights))
    else:
        assert found["phi"].isna().all()


def test_the_error_is_the_mean_of_the_sizes_in_units_of_the_reward(tmp_path: Path) -> None:
    run = train(tmp_path, tiny(), lambda run: len(run.buffer) >= 25 and run.stop.ask())
    log = UpdateLog(100, reward_scale=0.1)
    log.learns(torch.arange(4))
    squared = torch.tensor([0.04, 0.0, 0.01, 0.01])
    log.learned({"td_error": squared})
    log.add(25, episode=1, buffer=run.buffer)
    assert log.rows[0]["td_error"] == pytest.approx((2 + 0 + 1 + 1) / 4)


def test_a_run_that_was_killed_and_goes_on_has_every_row_once(tmp_path: Path) -> None:
    settings = tiny()
    settings.environment.max_steps, settings.tracking.log_every = 25, 3
    settings.checkpoint_every = 20
    train(tmp_path / "whole", settings)

    def kill(run: TrainingRun) -> None:
        if run.actions == 50:
            raise SystemExit("as if killed: nothing is saved")

    with pytest.raises(SystemExit):
        train(tmp_path, settings, kill)
    assert of_run(tmp_path)["total_steps"].tolist() == list(range(3, 41, 3))
    go_on(tmp_path, settings)
    pd.testing.assert_frame_equal(of_run(tmp_path), of_run(tmp_path / "whole"))


def test_the_share_that_phi_follows_is_in_the_rows(tmp_path: Path) -> None:
    settings = tiny("mpfa_adaptive")
    settings.tracking.log_every = 5
    train(tmp_path, settings)
    phi = of_run(tmp_path)["phi"].dropna()
    assert phi.between(1, 10).all()
    assert phi.nunique() > 1


def test_a_transition_in_the_place_of_an_old_one_was_never_learned_from() -> None:
    log = UpdateLog(4, reward_scale=1.0)
    log.wrote(torch.arange(4), torch.ones(4, 1))
    log.learns(torch.arange(4))
    log.wrote(torch.tensor([1]), torch.ones(1, 1))
    log.learns(torch.tensor([0, 1]))
    _, before, _ = log.state_dict()["last"]
    assert before.tolist() == [1, -1]


def test_updates_of_a_round_are_offered_to_the_program_at_once(tmp_path: Path) -> None:
    run, offered = TrainingRun(tiny(updates=3), tmp_path), []

    def update_each(rows: TensorDictBase, batches: int) -> None:
        offered.append((len(rows), batches))

    run.learner.update_each = update_each  # type: ignore[attr-defined]
    run.train()
    run.close()
    assert offered == [(3 * 8, 3)] * (run.updates // 3)
    assert run.updates > 30


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


def test_updates_that_wait_are_dropped_with_the_parts_that_they_were_for(tmp_path: Path) -> None:
    settings = blocky(30)
    settings.curriculum.stages = [Stage("A", actions=45), Stage("B", actions=45)]
    settings.curriculum.carry = False
    run = train(tmp_path, settings)
    # Batches of 18 are there after six actions of three robots, in each stage.
    assert run.updates == 2 * ((30 - 15) // 3 + (45 - 15) // 3)


def test_rows_of_a_stage_that_begins_anew_are_of_its_own_buffer(tmp_path: Path) -> None:
    settings = blocky(1)
    settings.curriculum.stages = [Stage("A", actions=45), Stage("B", actions=45)]
    settings.curriculum.carry, settings.tracking.log_every = False, 16
    train(tmp_path, settings)
    found = of_run(tmp_path).set_index("total_steps")
    # The second stage begins after 45 actions, and learns from the 63rd on.
    missing = {18: False, 33: False, 48: True, 66: False, 81: False}
    assert found["td_error"].isna().to_dict() == missing
    assert found["positive_batch"].isna()[48]


def test_each_batch_of_a_round_counts_by_itself(tmp_path: Path) -> None:
    run, seen = TrainingRun(tiny(updates=3), tmp_path), []
    learns = run.log.learns
    run.log.learns = lambda index: (seen.append(len(index)), learns(index))  # type: ignore[method-assign]
    run.train()
    run.close()
    assert seen == [8] * run.updates


def test_updates_of_a_block_are_told_of_if_one_of_its_actions_is_to_be_logged(
    tmp_path: Path,
) -> None:
    told: list[int] = []

    class Told(Hook):
        def on_update(self, run: TrainingRun, losses: Any, batch: Any) -> None:
            told.append(run.actions)

    settings = blocky(30)
    settings.tracking.log_every = 20
    run = TrainingRun(settings, tmp_path, hooks=[Told()])
    run.train()
    run.close()
    assert told == [30, 60, 90, 120]


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
