"""The training script: resuming, stopping, refusing; every part of it on tiny runs."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torchrl.data import RandomSampler

from methods import ALIASES
from process import prepare_process
from records import draw_learning_curve, load_policy
from settings import GROUPS, Stage, TrainSettings
from tests.integration.tiny_runs import rows, tiny, train
from torchrl_mpfa import SignalSampler, save_atomically
from training import CHECKPOINT, TrainingRun, read_checkpoint

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_training_treats_denormal_numbers_as_zero() -> None:
    threads, least = torch.get_num_threads(), torch.finfo(torch.float32).tiny
    try:
        prepare_process(TrainSettings(threads=1))
        assert (torch.tensor([least]) / 2).item() == 0.0
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(threads)
    assert (torch.tensor([least]) / 2).item() > 0.0


def test_evaluating_on_the_way_changes_nothing_in_the_training(tmp_path: Path) -> None:
    settings = tiny()
    settings.evaluation.every, settings.evaluation.episodes = 50, 2
    evaluated, plain = train(tmp_path / "evaluated", settings), train(tmp_path / "plain", tiny())
    assert rows(evaluated) == rows(plain)
    steps = [record.total_steps for record in evaluated.progress]
    # At the first end of an episode after each multiple of fifty.
    ends = [0, *(record.total_steps for record in evaluated.records)]
    assert steps == [end for before, end in pairwise(ends) if end // 50 > before // 50]
    for record in evaluated.progress:
        assert record.success + record.collision + record.timeout == pytest.approx(1.0)
        assert record.world == "validation"
    lines = (tmp_path / "evaluated" / "progress.csv").read_text().splitlines()
    assert len(lines) == 1 + len(steps)
    assert not (tmp_path / "plain" / "progress.csv").exists()


@pytest.mark.parametrize(
    ("method", "learner"),
    [
        ("mpfa_per", "ddpg"),
        ("mpfa_per", "td3"),
        *((method, "ddpg") for method in ("averaged_ddpg", "cer", "ddpg_radam", "hvper")),
        *((method, "ddpg") for method in ("klper", "mw", "rank_per")),
        ("la3p", "td3"),
        ("mpfa_per", "sac"),
    ],
)
def test_a_resumed_run_gives_the_numbers_of_an_uninterrupted_one(
    tmp_path: Path, method: str, learner: str
) -> None:
    whole = train(tmp_path / "whole", tiny(method, learner=learner))
    part = TrainingRun(tiny(method, learner=learner), tmp_path)
    part.train(on_episode=lambda record: setattr(part, "_stop", record.episode == 3))
    part.close()
    assert part.episode == 4

    resumed = TrainingRun(tiny(method, learner=learner), tmp_path)
    resumed.load(read_checkpoint(tmp_path))
    assert resumed.train()
    resumed.close()

    assert rows(resumed) == rows(whole)
    for mine, other in zip(
        resumed.learner.loss.state_dict().values(),
        whole.learner.loss.state_dict().values(),
        strict=True,
    ):
        assert torch.equal(mine, other)
    mine, other = resumed.buffer.state_dict(), whole.buffer.state_dict()
    assert torch.equal(mine["_rng"][0], other["_rng"][0])
    if "_sum_tree" in other["_sampler"]:
        assert torch.equal(mine["_sampler"]["_sum_tree"], other["_sampler"]["_sum_tree"])
    signals = [state["_storage"]["_signals"]["rows"] for state in (mine, other)]
    # NaN marks what is not known yet.
    torch.testing.assert_close(*signals, rtol=0, atol=0, equal_nan=True)


def test_the_same_seed_gives_the_same_run_and_another_seed_another(tmp_path: Path) -> None:
    first, again = train(tmp_path / "a", tiny()), train(tmp_path / "b", tiny())
    other = tiny()
    other.seed = 4
    assert rows(first) == rows(again)
    assert rows(first) != rows(train(tmp_path / "c", other))


@pytest.mark.parametrize("method", sorted(GROUPS["method"]))
def test_every_method_trains_and_uses_its_own_signals(tmp_path: Path, method: str) -> None:
    settings = tiny(method)
    run = train(tmp_path, settings)
    assert run.step > settings.method.batch_size
    assert all(math.isfinite(record.reward) for record in run.records)
    if not settings.method.signals:
        assert isinstance(run.buffer.sampler, RandomSampler)
    else:
        assert isinstance(run.buffer.sampler, SignalSampler)
        assert sorted(run.buffer.sampler.weights) == sorted(settings.method.signals)
        assert run.buffer.sampler.beta == settings.method.beta_end


@pytest.mark.parametrize("learner", ["sac", "td3"])
@pytest.mark.parametrize("method", sorted(GROUPS["method"]))
def test_every_method_works_with_every_learner(tmp_path: Path, method: str, learner: str) -> None:
    run = train(tmp_path, tiny(method, [Stage("A", 3)], learner))
    weights = [value for value in run.learner.loss.state_dict().values() if value.ndim > 0]
    assert run.step > run.settings.method.batch_size
    assert all(value.isfinite().all() for value in weights)


def test_no_two_methods_have_the_same_settings() -> None:
    methods = {name: m for name, m in GROUPS["method"].items() if name not in ALIASES}
    bare = [replace(method, name="") for method in methods.values()]
    assert all(one != other for place, one in enumerate(bare) for other in bare[:place])
    assert all(method.name == name for name, method in methods.items())


def test_the_reward_in_the_records_has_no_bonus_in_it(tmp_path: Path) -> None:
    settings = tiny("ddpg_radam")
    settings.method.curiosity_scale = 1e6
    # Nothing is learned in the first episodes, so that both runs drive the same way.
    settings.method.batch_size = settings.method.capacity = 1000
    without = replace(settings, method=replace(settings.method, curiosity=False))
    curious, plain = train(tmp_path / "curious", settings), train(tmp_path / "plain", without)
    assert [r.reward for r in curious.records] == [r.reward for r in plain.records]
    learned = tiny("ddpg_radam")
    learned.method.curiosity_scale = 1e6
    run = train(tmp_path / "learned", learned)
    assert max(abs(record.reward) for record in run.records) < 1e3
    assert run.buffer[:]["next", "reward"].abs().max() < 1e3


def test_a_curriculum_that_does_not_carry_starts_anew_on_each_map(tmp_path: Path) -> None:
    settings = tiny()
    settings.curriculum.carry = False
    run = train(tmp_path, settings)
    of_second_map = sum(record.steps for record in run.records[3:])
    assert len(run.buffer) == min(of_second_map, settings.method.capacity)
    assert run.buffer.write_count == of_second_map

    part = TrainingRun(settings, tmp_path / "part")
    (tmp_path / "part").mkdir()
    # Stopped between the maps.
    part.train(on_episode=lambda record: setattr(part, "_stop", record.episode == 2))
    part.close()
    resumed = TrainingRun(settings, tmp_path / "part")
    resumed.load(read_checkpoint(tmp_path / "part"))
    assert resumed.train()
    resumed.close()
    assert rows(resumed) == rows(run)


def test_the_records_say_how_every_episode_ended(tmp_path: Path) -> None:
    run = train(tmp_path, tiny())
    assert [record.world for record in run.records] == ["A"] * 3 + ["B"] * 3
    assert all(r.success + r.collision + r.timeout == 1 for r in run.records)
    assert sum(r.steps for r in run.records) == run.step == run.records[-1].total_steps
    assert (tmp_path / "episodes.csv").read_text().count("\n") == 1 + len(run.records)


@pytest.mark.parametrize("learner", sorted(GROUPS["learner"]))
def test_the_policy_file_acts_as_the_trained_policy(tmp_path: Path, learner: str) -> None:
    run = train(tmp_path, tiny(learner=learner))
    policy, state = load_policy(tmp_path)
    observation = torch.rand(5, 24)
    trained = run.learner.policy.outputs({"observation": observation})["action"]
    assert torch.equal(policy.outputs({"observation": observation})["action"], trained)
    assert state["trained"]["episodes"] == 6


def test_a_policy_file_of_something_else_is_refused(tmp_path: Path) -> None:
    save_atomically({"format": 99}, tmp_path / "policy.pt")
    with pytest.raises(ValueError, match=r"no policy of format 3"):
        load_policy(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"train\.py writes policy\.pt"):
        load_policy(tmp_path / "elsewhere")


def test_a_checkpoint_of_another_version_is_refused(tmp_path: Path) -> None:
    save_atomically({"format": 99}, tmp_path / CHECKPOINT)
    with pytest.raises(ValueError, match=r"format 99, this version reads 3"):
        read_checkpoint(tmp_path)
    with pytest.raises(FileNotFoundError, match="resume"):
        read_checkpoint(tmp_path / "elsewhere")


def test_the_learning_curve_is_drawn(tmp_path: Path) -> None:
    run = train(tmp_path, tiny())
    draw_learning_curve(run.records, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes()[:4] == b"\x89PNG"


def script(folder: Path, *overrides: str) -> list[str]:
    stages = "curriculum.stages=[{world: A, episodes: 10000}]"
    sizes = ["method.capacity=100", "method.batch_size=16", "learner.width=16"]
    return [
        sys.executable,
        str(EXAMPLES / "train.py"),
        *(f"run_dir={folder}", stages, "environment.physics=kinematic", "environment.max_steps=20"),
        *sizes,
        *("tracking=off", "checkpoint_every=1", *overrides),
    ]


def start(command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(file: Path, process: subprocess.Popen[str], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not file.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, f"{file} did not appear"
        time.sleep(0.05)


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_a_killed_run_goes_on_and_ctrl_c_says_how(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    killed = start(script(folder, "overlap=true"))
    wait_for(folder / CHECKPOINT, killed)
    killed.send_signal(signal.SIGKILL)
    # Returns when nobody holds the other end anymore: a second process must have ended, too.
    killed.communicate(timeout=60)
    episode = read_checkpoint(folder)["episode"]
    assert episode >= 1

    refused = subprocess.run(script(folder), capture_output=True, text=True, timeout=120)
    assert refused.returncode != 0
    assert f"go on with it by resume={folder}" in refused.stderr

    (folder / "policy.pt").unlink(missing_ok=True)
    command = [*script(tmp_path / "other"), f"resume={folder}"]
    resumed = start(command)
    wait_for(folder / "policy.pt", resumed)
    resumed.send_signal(signal.SIGINT)
    out, err = resumed.communicate(timeout=120)
    assert resumed.returncode == 130, err
    assert f"go on with: train.py resume={folder}" in out
    assert read_checkpoint(folder)["episode"] > episode
