"""TorchRL's own SAC: it learns by either replay on any task, resumes, and leaves scores."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pandas as pd
import pytest
import torch

import report
import torchrl_sac
from mpfa_envs import load_policy
from training.evaluating import drive

pytestmark = [
    pytest.mark.filterwarnings("ignore:init_random_frames"),
    pytest.mark.filterwarnings("ignore:total_frames"),
    pytest.mark.filterwarnings("ignore:positive_above='mean'"),
]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchrl_sac, "RANDOM_ACTIONS", 48)
    monkeypatch.setattr(torchrl_sac, "BATCH_SIZE", 16)
    monkeypatch.setattr(torchrl_sac, "CAPACITY", 500)


def pendulum(folder: Path, *more: str, actions: int = 128) -> list[str]:
    words = f"--task Pendulum-v1 --actions {actions} --every 64 --episodes 1 --output {folder}"
    return [*words.split(), *more]


@pytest.mark.parametrize("replay", ["uniform", "mpfa"])
def test_a_trained_policy_is_one_of_this_project(tmp_path: Path, replay: str) -> None:
    words = f"--replay {replay} --task rooms --robots 4 --actions 96 --output {tmp_path}"
    folder = torchrl_sac.main([*words.split(), "--episodes", "2"])
    policy = load_policy(folder)
    assert policy.card["method"] == replay
    # As evaluate.py drives it, which has the robot from nowhere but its defaults.
    [driven] = drive(policy, ["A"], episodes=2, seed=0, physics=None, progress=False)
    assert len(driven.results) == 2


def test_runs_of_a_gymnasium_task_leave_scores_that_are_reported(tmp_path: Path) -> None:
    for replay in ("uniform", "mpfa"):
        torchrl_sac.main(pendulum(tmp_path / replay, "--replay", replay))
    rows = pd.read_csv(tmp_path / "mpfa" / "scores.csv")
    assert list(rows["steps"]) == [64, 128]
    assert set(rows["method"]) == {"sac/mpfa"} and (rows["score"] < 0).all()
    assert report.main([str(tmp_path)]) == 0
    text = (tmp_path / "tables.md").read_text("utf-8")
    assert "## Pendulum-v1" in text and "| sac/mpfa − sac/uniform |" in text


@pytest.mark.slow
def test_an_interrupted_run_saves_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    update = torchrl_sac.Training.update

    def interrupted(run: torchrl_sac.Training) -> dict[str, float]:
        if run.collected == 128 and not (tmp_path / "asked").exists():
            (tmp_path / "asked").touch()
            os.kill(os.getpid(), signal.SIGINT)
        return update(run)

    monkeypatch.setattr(torchrl_sac.Training, "update", interrupted)
    folder = tmp_path / "run"
    torchrl_sac.main(pendulum(folder, "--replay", "mpfa", actions=256))
    said = capsys.readouterr()
    assert "SIGINT: stopping and saving" in said.err
    assert f"continue with --resume {folder}" in said.out
    state = torchrl_sac.load_safely(folder / "run.pt")
    assert state["collected"] == 128
    # What resumes is what was saved, the generator of random numbers included.
    run = torchrl_sac.Training(state["settings"])
    run.load(folder, state)
    assert len(run.buffer) == 128
    assert torch.get_rng_state().equal(state["random"])
    saved = state["loss"]
    assert all(value.equal(saved[name]) for name, value in run.loss.state_dict().items())
    moments = run.optimizer.state_dict()["state"]
    assert moments
    for name, kept in state["optimizer"]["state"].items():
        assert moments[name]["exp_avg"].equal(kept["exp_avg"])
    torchrl_sac.main(["--resume", str(folder), "--actions", "256", "--every", "64"])
    assert list(pd.read_csv(folder / "scores.csv")["steps"]) == [64, 128, 192, 256]
    with pytest.raises(SystemExit):
        torchrl_sac.main(pendulum(folder))
    assert f"holds a run: --resume {folder}" in capsys.readouterr().err


def test_an_update_moves_targets_and_priorities_and_an_evaluation_has_no_noise() -> None:
    own = {"task": "Pendulum-v1", "replay": "mpfa", "robots": 1, "seed": 0}
    run = torchrl_sac.Training(own)
    run.buffer.extend(run.env.rollout(64))
    before = {k: v.clone() for k, v in run.loss.state_dict().items() if k.startswith("target")}
    run.update()
    after = run.loss.state_dict()
    assert any(not value.equal(after[name]) for name, value in before.items())
    assert all(each.grad is None for each in run.loss.parameters())
    assert run.buffer.stats()["share/td_error"] > 0
    assert run.evaluate(1) == run.evaluate(1)
