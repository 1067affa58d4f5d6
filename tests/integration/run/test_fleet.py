"""Training with robots on a Ray cluster: the same files, lost workers, and going on."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests.integration.tiny_runs import OVERRIDES, Look, tiny, train
from training import files
from training.records import read_table
from training.run.checkpoints import read_checkpoint
from training.run.loop import TrainingRun
from training.settings.train import RaySettings, Stage, TrainSettings

TRAIN = Path(__file__).parents[3] / "examples" / "train.py"


def on_ray(actions: int) -> TrainSettings:
    settings = tiny(episodes=[Stage("A", actions=actions)], robots=8, updates=2)
    settings.ray = RaySettings(workers=2, steps=8)
    settings.method.capacity, settings.method.batch_size = 100, 16
    settings.environment.max_steps = 25
    return settings


def test_a_checkpoint_without_the_places_of_the_robots_begins_new_episodes(tmp_path: Path) -> None:
    settings = tiny(episodes=[Stage("A", actions=160)], robots=8, updates=2)
    run = train(tmp_path, settings)
    state = read_checkpoint(tmp_path)
    # As a run with two workers leaves it.
    state["robots"] = {**state["robots"], "environment": None}
    del state["robots"]["observation"]
    state["explorer"]["shares"] = state["explorer"]["shares"][:4]
    settings.curriculum.stages[0].actions = 320
    again = TrainingRun(settings, tmp_path, state)
    assert again.robots.given_up == 8 - int((run.robots._steps == 0).sum())
    assert again.train()
    again.close()
    assert again.updates - run.updates == 2 * (again.actions - run.actions) // 8
    assert [record.episode for record in again.records] == list(range(len(again.records)))


@pytest.mark.slow
def test_a_run_on_ray_loses_a_worker_keeps_its_files_and_goes_on_anywhere(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray", reason="an extra: pip install 'torchrl-mpfa[ray]'")
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    settings = on_ray(640)
    try:
        killed: list[int] = []

        def kill(run: TrainingRun) -> None:
            if run.actions >= 256 and not killed:
                killed.append(run.actions)
                ray.kill(run.robots._collector.remote_collectors[1])

        run = TrainingRun(settings, tmp_path, hooks=[Look(kill)])
        assert run.train()
        assert killed
        assert run.robots.losses == 1
        assert len(run.buffer) == 100
        # One update for four actions, but for those before the first batch.
        assert run.updates == pytest.approx(run.actions / 4, abs=16)
        rewards = run.buffer.rewards()
        run.close()
        assert run.robots.given_up > 0
        names = {files.CHECKPOINT, files.POLICY, files.EPISODES, files.UPDATES, files.STATUS}
        assert names <= {path.name for path in tmp_path.iterdir()}
        records = read_table(tmp_path / files.EPISODES)
        assert (records["success"] ^ records["collision"] ^ records["timeout"]).all()
        assert records["steps"].max() <= 25
        assert list(records["episode"]) == list(range(len(records)))

        # A run that was begun on Ray goes on there, and in one process.
        state = read_checkpoint(tmp_path)
        for workers in (2, 0):
            longer = on_ray(settings.curriculum.stages[0].actions + 160)
            longer.ray.workers = workers
            again = TrainingRun(longer, tmp_path, state)
            assert again.actions == state["schedule"]["actions"]
            assert torch.equal(again.buffer.rewards(), rewards)
            if not workers:
                assert again.train()
                assert again.updates > state["updates"]
            again.close()
    finally:
        ray.shutdown()
        torch.set_flush_denormal(False)


@pytest.mark.slow
def test_a_run_on_ray_goes_on_at_its_last_checkpoint_after_its_learner_was_killed(
    tmp_path: Path,
) -> None:
    pytest.importorskip("ray", reason="an extra: pip install 'torchrl-mpfa[ray]'")
    folder = tmp_path / "run"
    words = [
        *OVERRIDES, "ray.workers=2", "ray.steps=8", "robots=8", "updates=2",
        "checkpoint_every=500", "curriculum.stages=[{world: A, actions: 4000}]",
        f"run_dir={folder}",
    ]  # fmt: skip
    learner = subprocess.Popen([sys.executable, TRAIN, *words])
    while not (folder / files.CHECKPOINT).exists():
        assert learner.poll() is None
        time.sleep(0.01)
    learner.kill()
    assert learner.wait() == -9
    state = read_checkpoint(folder)
    # A report of a worker is 32 actions.
    begun = state["schedule"]["actions"]
    assert begun % 500 < 32 <= begun < 4000
    assert state["updates"] == pytest.approx(begun / 4, abs=16)

    subprocess.run([sys.executable, TRAIN, f"resume={folder}"], check=True)
    after = read_checkpoint(folder)
    assert 4000 <= after["schedule"]["actions"] < 4032
    assert after["updates"] == pytest.approx(after["schedule"]["actions"] / 4, abs=16)
    # Nothing that the checkpoint had was done again, or forgotten.
    assert after["records"][: len(state["records"])] == state["records"]
    assert len(after["records"]) > len(state["records"])
    assert [record["episode"] for record in after["records"]] == list(range(len(after["records"])))
    assert after["robots"]["given_up"] > state["robots"]["given_up"]
