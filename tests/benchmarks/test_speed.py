"""The benchmarks in miniature: what they report, not how fast anything is."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch
from tensordict import TensorDict

from benchmarks.speed import __main__ as run
from benchmarks.speed import (
    disk,
    gpu,
    method_steps,
    profile,
    replay,
    sbx_peer,
    start,
    timing,
    training,
    updates,
)
from benchmarks.speed.timing import Entry, Timing, entry
from torchrl_mpfa.methods import METHODS


def check_schema(entries: Sequence[Entry]) -> None:
    for found in entries:
        assert list(found) == ["name", "value", "unit", "ratio", "baseline"]
        assert math.isfinite(found["value"]) and found["value"] > 0
        assert found["unit"]
        assert (found["ratio"] is None) == (found["baseline"] is None)
        assert found["ratio"] is None or (math.isfinite(found["ratio"]) and found["ratio"] > 0)
    names = [found["name"] for found in entries]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    "measure",
    [replay.measure_sample_update, replay.measure_extend_one, replay.measure_iteration_4x256],
)
def test_replay_is_compared_with_that_of_torchrl(measure) -> None:
    stock, ours = measure("small", capacity=512, quick=True)
    check_schema([stock, ours])
    assert ours["name"] == "small"
    assert ours["baseline"] == stock["name"] == "small_torchrl"
    assert stock["ratio"] is None


def test_replay_on_disk_says_its_times_and_its_memory_and_leaves_no_file(tmp_path, capsys) -> None:
    disk.main(["--rows", "2000", "--folder", str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "2000 transitions, 262 bytes each in files"
    assert [line.split(":")[0] for line in lines[1:4]] == [
        "memory beside the files",
        "sample and update",
        "write one",
    ]
    assert not list(tmp_path.iterdir())


def test_the_run_prints_a_table_and_writes_what_it_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "latest.json"
    assert run.main(["--quick", "--only", "extend_16", "--output", str(path)]) == 0
    entries = json.loads(path.read_text(encoding="utf-8"))
    check_schema(entries)
    assert [found["name"] for found in entries] == ["extend_16_torchrl", "extend_16"]
    assert [file.name for file in tmp_path.iterdir()] == ["latest.json"]
    table = capsys.readouterr().out.splitlines()
    assert sum("extend_16_torchrl" in line for line in table) == 2


def test_check_fails_if_a_ratio_is_above_its_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ratio = run.TARGETS["extend_16"]

    def measure(*, quick: bool) -> list[Entry]:
        return [entry("extend_16", 1.0, "us", ratio=ratio, baseline="other")]

    monkeypatch.setattr(run, "BENCHMARKS", {"extend_16": measure})
    arguments = ["--check", "--output", str(tmp_path / "latest.json")]
    assert run.main(arguments) == 0
    ratio += 0.01
    assert run.main(arguments) == 1
    assert run.main(arguments[1:]) == 0
    sentence = f"extend_16: ratio {ratio:.2f} is above its target {run.TARGETS['extend_16']}"
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize("what", ["step", "replay"])
def test_profile_is_a_table_whose_parts_take_time(
    what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(profile, "has_compiler", lambda: False)
    profile.main([what, "--calls", "3"])
    head, line, *rows = (row.split(" | ") for row in capsys.readouterr().out.splitlines())
    parts = profile.STEP if what == "step" else profile.SAMPLE | profile.UPDATE
    assert {*parts} <= {row[0].removeprefix("| ") for row in rows}
    assert {len(head), len(line)} == {len(row) for row in rows} == {3}


def test_every_target_belongs_to_a_benchmark() -> None:
    assert set(run.TARGETS) <= {*run.BENCHMARKS, *start.COMMANDS}


def test_calls_take_turns_and_a_ratio_is_the_median_of_the_rounds() -> None:
    calls: list[str] = []
    timing.take_turns(
        {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3, seconds=1e-9
    )
    assert calls[-6:] == ["a", "b", "b", "a", "a", "b"]
    slow, fast = Timing((2.0, 9.0, 4.0)), Timing((1.0, 3.0, 2.0))
    assert (slow.median, slow.minimum, slow.ratio(fast)) == (4.0, 2.0, 2.0)


@pytest.mark.parametrize(
    ("measure", "name", "baseline"),
    [
        (training.measure_train_step, "train_step", "train_step_bare"),
        (training.measure_sb3_step, "sb3_step", "sb3_step_sb3"),
    ],
)
def test_a_training_step_is_compared_with_anothers(
    measure, name: str, baseline: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "sb3_step":
        pytest.importorskip("stable_baselines3")
    for constant, small in (("WIDTH", 16), ("THREADS", 1), ("_BLOCK", 4), ("BATCH_SIZE", 32)):
        monkeypatch.setattr(training, constant, small)
    other, ours = measure(quick=True)
    check_schema([other, ours])
    assert (ours["name"], ours["baseline"], other["name"]) == (name, baseline, baseline)


@pytest.mark.parametrize("name", ["update_td3_64", "loop_ddpg_64"])
def test_updates_are_compared_with_those_of_a_process_of_sbx(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\nwhile read calls; do echo 4.5e6; done\n", encoding="utf-8")
    python.chmod(0o700)
    for module, constant, small in ((sbx_peer, "UPDATES", 2), (updates, "_STEPS", 3)):
        monkeypatch.setattr(module, constant, small)
    monkeypatch.setenv("SBX_PYTHON", str(python))
    other, ours = updates.measure(name, quick=True)
    check_schema([other, ours])
    assert (ours["name"], ours["baseline"], other["name"]) == (name, f"{name}_sbx", f"{name}_sbx")
    blocks = {"update_td3_64": 2, "loop_ddpg_64": 3}
    assert other["value"] == pytest.approx(4.5e12 / blocks[name], rel=1e-6)
    assert ours["value"] < 1e9


def test_updates_are_not_compared_with_sbx_where_there_is_none(monkeypatch, capsys) -> None:
    monkeypatch.delenv("SBX_PYTHON", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert updates.measure("update_ddpg_64", quick=True) == []
    assert "update_ddpg_64: left out, no sbx-rl here" in capsys.readouterr().err


def test_both_training_steps_learn() -> None:
    agent = training.Agent(plain=False)
    before = [p.detach().clone() for p in agent.learner.networks.parameters()]
    agent.learn(training.make_transitions(1))
    after = list(agent.learner.networks.parameters())
    assert any(not a.equal(b) for a, b in zip(after, before, strict=True))
    assert agent.buffer.sampler.weights


@pytest.mark.slow
def test_a_step_of_each_method_is_compared_with_uniform_ddpg() -> None:
    found = method_steps.measure(quick=True)
    check_schema(found)
    names = [each["name"] for each in found]
    assert names[0] == "step_ddpg"
    assert found[0]["ratio"] == pytest.approx(1.0)
    assert {"step_mpfa_per", "step_la3p"} <= set(names)


@pytest.mark.parametrize("name", ["ref_er", "uniform_halves"])
def test_a_step_is_made_of_methods_that_store_or_choose_in_a_way_of_their_own(name: str) -> None:
    step = method_steps.make_step(replace(METHODS[name]))
    for _ in range(2):
        step()


@pytest.mark.skipif(torch.cuda.is_available(), reason="measures on the GPU")
def test_without_a_gpu_its_timings_say_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert gpu.main() == 1
    assert "no GPU was found" in capsys.readouterr().err


def test_a_round_on_its_devices_makes_its_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(gpu, "CAPACITY", 512)
    round_of_updates = gpu.make_updates("cpu", "cpu", width=8, batch_size=16)
    assert gpu.milliseconds(round_of_updates, rounds=1) > 0.0
    log, batch = cast(tuple[dict[str, torch.Tensor], TensorDict], round_of_updates())
    assert len(batch) == 16 and all(value.isfinite().all() for value in log.values())
