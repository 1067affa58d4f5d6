"""The training run: resuming, records, policies; every part of it on tiny runs."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.data import RandomSampler

import torchrl_mpfa as mpfa
from mpfa_envs import load_policy
from tests.integration.tiny_runs import (
    assert_same_run,
    blocky,
    go_on,
    mostly_slow,
    rows,
    stop_after,
    tiny,
    train,
)
from torchrl_mpfa import SignalSampler
from torchrl_mpfa.methods import ALIASES, METHODS
from torchrl_mpfa.saving import save_atomically
from training.evaluating import Drives
from training.files import CHECKPOINT
from training.records import EvaluationRecord
from training.run import loop
from training.run.checkpoints import random_state, read_checkpoint, set_random_state
from training.run.driving import Robots
from training.run.evaluations import exported_policy, kept_policy
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.settings.train import GROUPS, Stage, TrainSettings


def test_evaluating_on_the_way_changes_nothing_in_the_training(tmp_path: Path) -> None:
    settings = tiny()
    settings.evaluation.every, settings.evaluation.episodes = 15, 2
    evaluated, plain = train(tmp_path / "evaluated", settings), train(tmp_path / "plain", tiny())
    assert rows(evaluated) == rows(plain)
    steps = [record.total_steps for record in evaluated.evaluations]
    assert steps == list(range(15, evaluated.actions + 1, 15))
    for record in evaluated.evaluations:
        assert record.success + record.collision + record.timeout == pytest.approx(1.0)
        assert record.world == "validation"
    lines = (tmp_path / "evaluated" / "evaluations.csv").read_text().splitlines()
    assert len(lines) == 1 + len(steps)
    assert not (tmp_path / "plain" / "evaluations.csv").exists()


def test_the_clock_of_a_run_stands_during_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate_policy = loop.evaluate_policy

    def slowly(*arguments: Any, **named: Any) -> Any:
        found, driven = evaluate_policy(*arguments, **named)
        return replace(found, seconds=1000.0), driven

    monkeypatch.setattr(loop, "evaluate_policy", slowly)
    settings = tiny()
    settings.evaluation.every, settings.evaluation.episodes = 40, 1
    run = train(tmp_path, settings)
    assert run.robots.elapsed() == pytest.approx(-1000.0 * len(run.evaluations), abs=200.0)
    assert run.evaluations


def of_robots(physics: str) -> TrainSettings:
    settings = tiny(episodes=[Stage("bars", actions=90)], robots=3, updates=2)
    settings.environment.physics, settings.environment.progress = physics, "shortest_path"
    return settings


pytestmark = pytest.mark.usefixtures("reconstructed")
RESUMED = {
    **{f"{name}-ddpg": tiny(name) for name in ("mpfa_per", "averaged_ddpg", "cer", "ddpg_radam")},
    **{f"{name}-ddpg": tiny(name) for name in ("hvper", "klper", "mw", "rank_per")},
    **{f"mpfa_per-{name}": tiny(learner=name) for name in ("td3", "sac", "dqn", "q_learning")},
    "la3p-td3": tiny("la3p", learner="td3"),
    "uper-td3": tiny("uper", learner="td3"),
    # In the middle of the episodes of three robots, and of a block of updates.
    **{f"robots-{physics}": of_robots(physics) for physics in ("kinematic", "wheels")},
    **{f"{name}-blocks": blocky(30, name) for name in ("rud", "reaper", "ref_er")},
}


KEPT = (
    *("mpfa_per-ddpg", "mpfa_per-sac", "mpfa_per-dqn", "la3p-td3"),
    *("ddpg_radam-ddpg", "robots-kinematic"),
)
"""Cases that are not slow: a learner of each kind, a bonus, and several robots."""


@pytest.mark.parametrize("case", mostly_slow(RESUMED, (*KEPT, "ref_er-blocks")))
def test_a_resumed_run_gives_the_numbers_of_an_uninterrupted_one(tmp_path: Path, case: str) -> None:
    settings = RESUMED[case]
    whole = train(tmp_path / "whole", settings)
    actions = 31 if settings.robots == 1 else 45
    part = stop_after(actions, tmp_path, settings)
    assert all(record.total_steps <= actions for record in part.records)
    assert len(whole.records) > len(part.records)
    assert_same_run(go_on(tmp_path, settings), whole)


def test_a_run_that_was_lengthened_goes_on_with_the_rates_of_its_new_length(
    tmp_path: Path,
) -> None:
    short, long = (tiny("per", [Stage("A", actions=actions)]) for actions in (40, 400))
    for settings in (short, long):
        settings.learner.lr_end_factor = 0.1
    train(tmp_path, short)
    run = TrainingRun(long, tmp_path, read_checkpoint(tmp_path))
    rates = [group["lr"] for group in run.learner.optimizer.param_groups]  # type: ignore[attr-defined]
    run.close()
    assert rates == pytest.approx([0.91 * short.learner.actor_lr, 0.91 * short.learner.critic_lr])


ACTORS = ("ddpg", "sac", "td3")
PAIRS = list(product(sorted(GROUPS["method"]), ACTORS))


# Each method is trained by one of the learners, all of them by turns; the other pairs are slow.
@pytest.mark.parametrize(
    ("method", "learner"),
    mostly_slow(PAIRS, [pair for n, pair in enumerate(PAIRS) if n % 3 == n // 3 % 3]),
)
def test_every_method_trains_every_learner_by_its_own_signals(
    tmp_path: Path, method: str, learner: str
) -> None:
    settings = tiny(method, [Stage("A", 4)], learner)
    if settings.method.hindsight:
        settings.environment.progress = "none"
    run = train(tmp_path, settings)
    assert run.updates > 0
    assert all(math.isfinite(record.reward) for record in run.records)
    weights = [value for value in run.learner.networks.state_dict().values() if value.ndim > 0]
    assert all(value.isfinite().all() for value in weights)
    signals = [signal.name for signal in settings.method.priority_signals()]
    if not signals:
        assert isinstance(run.buffer.sampler, RandomSampler)
    else:
        assert isinstance(run.buffer.sampler, SignalSampler)
        assert sorted(run.buffer.sampler.weights) == sorted(signals)
        assert run.buffer.sampler.beta == settings.method.beta_at(1.0)


def test_no_two_methods_have_the_same_settings() -> None:
    methods = {name: m for name, m in GROUPS["method"].items() if name not in ALIASES}
    bare = [replace(method, name="per") for method in methods.values()]
    assert all(one != other for place, one in enumerate(bare) for other in bare[:place])
    assert all(method.name == name for name, method in methods.items())


def test_the_reward_in_the_records_has_no_bonus_in_it(tmp_path: Path) -> None:
    settings = tiny("ddpg_radam")
    settings.method.curiosity = 1e6
    # Nothing is learned in the first episodes, so that both runs drive the same way.
    settings.method.batch_size = settings.method.capacity = 1000
    plain = replace(METHODS["per"], capacity=1000, batch_size=1000)
    without = replace(settings, method=plain)
    curious, bare = train(tmp_path / "curious", settings), train(tmp_path / "plain", without)
    assert [r.reward for r in curious.records] == [r.reward for r in bare.records]
    learned = tiny("ddpg_radam")
    learned.method.curiosity = 1e6
    run = train(tmp_path / "learned", learned)
    assert max(abs(record.reward) for record in run.records) < 1e3
    assert run.buffer[:]["next", "reward"].abs().max() < 1e3


def test_a_learner_hears_of_each_episode_that_ends(tmp_path: Path) -> None:
    run, heard = TrainingRun(tiny(), tmp_path), []
    run.learner.end_episode = lambda: heard.append(len(run.records))  # type: ignore[method-assign]
    run.train()
    run.close()
    assert heard == list(range(1, 7))


def test_a_curriculum_that_does_not_carry_begins_again_in_each_world(tmp_path: Path) -> None:
    settings = tiny()
    settings.curriculum.carry = False
    run = train(tmp_path, settings)
    of_second_world = sum(record.steps for record in run.records[3:])
    assert len(run.buffer) == min(of_second_world, settings.method.capacity)
    assert run.buffer.write_count == of_second_world

    # Stopped between the worlds.
    train(tmp_path / "part", settings, lambda run: run.schedule.stage == 1 and run.stop.ask())
    assert rows(go_on(tmp_path / "part", settings)) == rows(run)


def test_a_finished_run_begins_further_worlds_as_its_curriculum_says(tmp_path: Path) -> None:
    settings = tiny(episodes=[Stage("A", 3)])
    settings.curriculum.carry = False
    train(tmp_path, settings).close()
    state = read_checkpoint(tmp_path)
    settings.curriculum.stages.append(Stage("B", 2))
    resumed = TrainingRun(settings, tmp_path, state)
    assert resumed.robots.elapsed() >= state["robots"]["seconds"]
    assert resumed.learner.updates == len(resumed.buffer) == 0
    assert resumed.train()
    resumed.close()
    assert len(resumed.buffer) == sum(record.steps for record in resumed.records[3:])


def test_two_stages_in_one_world_have_other_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds, begin = [], Robots.begin

    def kept(self: Robots, *args: object, seed: int) -> None:
        seeds.append(seed)
        begin(self, *args, seed=seed)

    monkeypatch.setattr(Robots, "begin", kept)
    train(tmp_path, tiny("uniform", episodes=[Stage("A", 1), Stage("A", 1)]))
    assert len({*seeds}) == 2


def test_the_episodes_that_another_stage_cuts_short_are_counted(tmp_path: Path) -> None:
    settings = tiny(episodes=[Stage("A", actions=30), Stage("B", actions=90)], robots=3)
    settings.environment.max_steps = 200
    run = train(tmp_path / "whole", settings)
    before = [record for record in run.records if record.total_steps <= 30]
    assert before == []
    status = json.loads((tmp_path / "whole" / "status.json").read_text())
    assert status["given_up"] == 3

    # The same if the run was stopped in between, or ended there at first.
    stop_after(60, tmp_path, settings)
    assert read_checkpoint(tmp_path)["robots"]["given_up"] == 3
    shorter = tiny(episodes=[Stage("A", actions=30)], robots=3)
    shorter.environment.max_steps = 200
    train(tmp_path / "more", shorter)
    resumed = TrainingRun(settings, tmp_path / "more", read_checkpoint(tmp_path / "more"))
    assert resumed.robots.given_up == 3
    resumed.close()


def test_the_random_numbers_of_a_gpu_are_kept_with_those_of_the_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    on_gpu = {"cuda:1": torch.tensor([7])}
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device: on_gpu[device].clone())
    monkeypatch.setattr(
        torch.cuda, "set_rng_state", lambda state, device: on_gpu.update({device: state})
    )
    kept = random_state("cuda:1")
    expected = torch.rand(3)
    on_gpu["cuda:1"] = torch.tensor([8])
    set_random_state("cuda:1", kept)
    assert torch.equal(torch.rand(3), expected)
    assert on_gpu["cuda:1"].item() == 7


@pytest.mark.parametrize("learner", sorted({*GROUPS["learner"]} - {"dqn", "q_learning"}))
def test_the_policy_file_acts_as_the_trained_policy(tmp_path: Path, learner: str) -> None:
    run = train(tmp_path, tiny(learner=learner))
    policy = load_policy(tmp_path)
    observation = torch.rand(5, 24)
    trained = run.learner.policy.outputs({"observation": observation})["action"]
    np.testing.assert_allclose(policy(observation.numpy()), trained.detach().numpy(), atol=1e-5)
    assert policy.card["episodes"] == 6
    assert policy.card["steps"] == run.actions
    assert policy.env_arguments["closeness_distance"] == pytest.approx(0.25)


def test_a_checkpoint_of_another_version_or_a_damaged_one_is_rejected(tmp_path: Path) -> None:
    save_atomically({"format": 3}, tmp_path / CHECKPOINT)
    with pytest.raises(ValueError, match=r"format 3, this version reads 7"):
        read_checkpoint(tmp_path)
    (tmp_path / CHECKPOINT).write_bytes(b"no checkpoint")
    with pytest.raises(ValueError, match=CHECKPOINT):
        read_checkpoint(tmp_path)
    with pytest.raises(FileNotFoundError, match="resume"):
        read_checkpoint(tmp_path / "elsewhere")


def test_networks_that_an_error_broke_are_not_saved(tmp_path: Path) -> None:
    settings = tiny()
    settings.checkpoint_every = 20

    def fail(run: TrainingRun) -> None:
        if run.actions == 35:
            for weight in run.learner.networks.parameters():
                weight.data.fill_(math.nan)
            raise RuntimeError("something broke")

    with pytest.raises(RuntimeError, match="something broke"):
        train(tmp_path, settings, fail)
    assert read_checkpoint(tmp_path)["schedule"]["actions"] == 20
    assert rows(go_on(tmp_path, settings)) == rows(train(tmp_path / "whole", tiny()))


def test_the_policy_of_a_run_is_the_best_of_its_evaluations_if_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = loop.evaluate_policy
    # Of equal successes the one with the highest SCT, whatever its SPL.
    scores = iter(((0.2, 0.9, 0.9), (0.9, 0.5, 0.1), (0.9, 0.4, 0.8)))

    def evaluated(*arguments: Any, **named: Any) -> tuple[EvaluationRecord, Drives]:
        success, sct, spl = next(scores, (0.5, 0.9, 0.9))
        record, driven = found(*arguments, **named)
        return replace(record, success=success, sct=sct, spl=spl), driven

    monkeypatch.setattr(loop, "evaluate_policy", evaluated)
    settings = tiny()
    settings.evaluation.every, settings.evaluation.episodes = 10, 4
    settings.evaluation.choose = True
    kept: list[dict[str, torch.Tensor]] = []
    run = train(
        tmp_path,
        settings,
        lambda run: (
            len(run.evaluations) > len(kept)
            and kept.append({k: v.clone() for k, v in run.learner.policy.state_dict().items()})
        ),
    )
    best = 1
    observation = np.random.default_rng(0).random((5, 24), dtype=np.float32)
    assert len(run.evaluations) > 3
    chosen = run.evaluations[best]
    card = load_policy(tmp_path).card
    assert (card["steps"], card["episodes"]) == (chosen.total_steps, chosen.episode)
    run.learner.policy.load_state_dict(kept[best])
    expected = run.learner.policy.outputs({"observation": torch.from_numpy(observation)})["action"]
    np.testing.assert_allclose(
        load_policy(tmp_path)(observation), expected.detach().numpy(), atol=1e-5
    )
    run.settings.evaluation.choose = False
    assert kept_policy(run).card["steps"] == run.actions != chosen.total_steps


@pytest.mark.parametrize(("share", "needed"), [(1.0, True), (0.5, False), (0.0, False)])
def test_a_policy_needs_the_filter_if_all_robots_had_it(share: float, needed: bool) -> None:
    settings = tiny()
    settings.environment.robot, settings.environment.filter = "kobuki", share
    policy = mpfa.make_actor(24, 2, width=8)
    assert exported_policy(policy, settings).card["filter"] is needed


def test_logs_are_written_before_the_checkpoint_that_does_not_make_them_again(
    tmp_path: Path,
) -> None:
    run, there = TrainingRun(tiny(), tmp_path), []
    checkpoint = tmp_path / CHECKPOINT
    run.tracker.flush = lambda: there.append(checkpoint.exists())  # type: ignore[method-assign]
    run.save()
    run.close()
    assert there == [False] and checkpoint.exists()


def test_a_run_that_is_closed_has_no_simulation_left(tmp_path: Path) -> None:
    run, ended = TrainingRun(tiny(), tmp_path), []
    close = run.robots.close
    run.robots.close = lambda: (ended.append(True), close())  # type: ignore[method-assign]
    run.close()
    assert ended


def test_rates_fall_linearly_in_long_runs_and_with_the_cube_in_short_ones(tmp_path: Path) -> None:
    def rate_at_half(episodes: int) -> float:
        run = TrainingRun(tiny(episodes=[Stage("A", episodes)]), tmp_path)
        run.schedule.count(actions=1, episodes=episodes // 2)
        run._anneal()
        run.close()
        return float(run.learner.optimizer.param_groups[0]["lr"])

    assert rate_at_half(100) == pytest.approx(1e-4 / 8)
    assert rate_at_half(1000) == pytest.approx(1e-4 / 2)


@pytest.mark.parametrize("method", ["la3p", "mpfa_per"])
def test_the_log_has_what_critic_and_actor_gave_whoever_learned_last(
    tmp_path: Path, method: str
) -> None:
    settings = tiny(method)
    settings.tracking.log_every = 1
    logged = []

    class Log(Hook):
        def on_update(self, run: TrainingRun, losses: Any, batch: Any) -> None:
            logged.append({"loss_value", "loss_actor", "td_error"} <= set(losses))
            assert "td_error" in batch["signals"].keys()  # noqa: SIM118

    run = TrainingRun(settings, tmp_path, hooks=[Log()])
    run.train()
    run.close()
    assert logged
    assert all(logged)


def test_klper_is_told_the_noise_of_the_episode_that_acts(tmp_path: Path) -> None:
    run = TrainingRun(tiny("klper"), tmp_path)
    run.explorer.shares.fill_(0.25)
    assert run.explorer.sigma == pytest.approx(0.25 * run.settings.exploration.sigma)
    run.close()
