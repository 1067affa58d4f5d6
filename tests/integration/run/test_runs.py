"""Runs that cannot be mixed up: locks, signals, what may change on the way, and what may not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path

import pytest
import wandb
from PIL import Image

import train
from tests.integration.tiny_runs import OVERRIDES, mostly_slow
from tests.integration.tiny_runs import train as train_tiny
from torchrl_mpfa.stopping import SIGNALS
from training import files
from training.comparison.jobs import Job
from training.files import CHECKPOINT, FolderInUse, lock
from training.finished import after_the_end
from training.records import read_table
from training.run import hooks, loop, script
from training.run.checkpoints import read_checkpoint
from training.run.loop import TrainingRun
from training.run.script import Rejected, resume, start
from training.settings.command_line import composed, parse_overrides
from training.settings.resuming import changed

STAGES = "curriculum.stages=[{{world: A, episodes: {}}}]"


def begin(folder: Path, *overrides: str, episodes: int = 3) -> int:
    (settings,) = composed([*OVERRIDES, STAGES.format(episodes), *overrides])
    return start(settings, folder)


def go_on(folder: Path, *overrides: str) -> int:
    return resume(folder, parse_overrides(overrides))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.usefixtures("drawn_curves")
def test_a_run_leaves_its_settings_and_how_far_it_is_and_its_curve(tmp_path: Path) -> None:
    assert begin(tmp_path, "seed=4") == 0
    assert json.loads((tmp_path / files.SETTINGS).read_text())["seed"] == 4
    status = json.loads((tmp_path / files.STATUS).read_text())
    assert status["finished"] is True
    assert (status["unit"], status["done"], status["total"]) == ("episode", 3, 3)
    assert {path.name for path in tmp_path.iterdir()} == {
        *(files.CHECKPOINT, files.POLICY, files.SETTINGS, files.EPISODES, files.CURVE),
        *(files.STATUS, files.UPDATES, ".lock"),
    }
    with Image.open(tmp_path / files.CURVE) as picture:
        assert picture.size[0] > 400


@pytest.mark.parametrize("lost", mostly_slow(["save_atomically", "write_table"], ["write_table"]))
def test_a_run_is_not_finished_before_all_of_it_is_saved(
    lost: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left")

    job = Job("ddpg", "per", 0, tmp_path)
    assert begin(job.path, episodes=1) == 0
    assert job.is_trained()
    with monkeypatch.context() as patch:
        patch.setattr(loop, lost, full)
        patch.setattr(hooks, "_REPORT_EVERY", 0.0)
        with pytest.raises(OSError, match="no space"):
            go_on(job.path, STAGES.format(2))
    status = job.status()
    assert (status["done"], status["total"], status["finished"]) == (2, 2, False)
    assert not job.is_trained()
    assert go_on(job.path, STAGES.format(2)) == 0
    assert job.is_trained()
    (job.path / files.POLICY).unlink()
    assert not job.is_trained()


def test_a_finished_run_without_an_episode_has_no_curve_and_is_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begin(tmp_path, "curriculum.stages=[{world: A, actions: 2}]")
    assert not (tmp_path / files.CURVE).exists()
    monkeypatch.setattr(script, "TrainingRun", None)
    assert go_on(tmp_path) == 0
    assert "is finished, after 2 actions" in capsys.readouterr().out


def test_a_finished_run_that_shall_go_on_is_not_finished_before_it_has_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(_: TrainingRun) -> bool:
        raise SystemExit(137)

    job = Job("ddpg", "per", 0, tmp_path)
    assert begin(job.path, episodes=1) == 0
    monkeypatch.setattr(TrainingRun, "train", killed)
    with pytest.raises(SystemExit):
        go_on(job.path, STAGES.format(2))
    assert not job.is_trained()


def test_a_second_run_in_the_same_folder_is_rejected_while_the_first_is_at_work(
    tmp_path: Path,
) -> None:
    with lock(tmp_path):
        before = contents(tmp_path)
        for again in (lambda: begin(tmp_path, "overwrite=true"), lambda: go_on(tmp_path)):
            with pytest.raises(Rejected, match=f"another process is using {tmp_path}"):
                again()
        assert contents(tmp_path) == before
        with pytest.raises(FolderInUse), lock(tmp_path):
            pass
    assert begin(tmp_path, episodes=1) == 0


def test_what_a_killed_save_left_is_removed(tmp_path: Path) -> None:
    for name in (f".{CHECKPOINT}.99.tmp", f".{files.POLICY}.x1.tmp", f"{files.CSV}/.a.csv.7.tmp"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"half")
    begin(tmp_path, episodes=1)
    assert {path.name for path in tmp_path.rglob(".*")} == {".lock"}


def test_a_folder_with_a_run_is_not_written_over_unless_asked_to(tmp_path: Path) -> None:
    begin(tmp_path, "seed=1", episodes=1)
    before = contents(tmp_path)
    with pytest.raises(Rejected, match=f"{tmp_path} holds a run: continue it with resume="):
        begin(tmp_path, "seed=2", episodes=1)
    assert contents(tmp_path) == before


def test_a_run_begun_again_and_killed_at_once_cannot_resume_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path, "seed=1", episodes=2)
    old = (tmp_path / CHECKPOINT).read_bytes()

    def killed(run: TrainingRun) -> bool:
        raise SystemExit("as if killed before its first checkpoint")

    monkeypatch.setattr(TrainingRun, "train", killed)
    with pytest.raises(SystemExit):
        begin(tmp_path, "seed=2", "overwrite=true")
    monkeypatch.undo()
    with pytest.raises(Rejected, match=f"there is no {CHECKPOINT} in {tmp_path}"):
        go_on(tmp_path)
    assert not (tmp_path / files.POLICY).exists()
    # Nor does the next beginning put what saved nothing in the place of the old run.
    assert begin(tmp_path, "seed=3", "overwrite=true", episodes=1) == 0
    assert (tmp_path / files.PREVIOUS / CHECKPOINT).read_bytes() == old


def test_a_setting_that_the_parts_reject_leaves_the_old_run_in_its_place(tmp_path: Path) -> None:
    begin(tmp_path, episodes=1)
    before = contents(tmp_path)
    with pytest.raises(Rejected, match="layers must be at least 2"):
        begin(tmp_path, "overwrite=true", "learner.layers=1")
    assert contents(tmp_path) == before


def test_a_run_goes_on_with_more_episodes_and_in_another_world(tmp_path: Path) -> None:
    begin(tmp_path / "run", episodes=2)
    assert go_on(tmp_path / "run", STAGES.format(3), "evaluation.every=10") == 0
    more = "curriculum.stages=[{world: A, episodes: 3},{world: B, episodes: 1}]"
    assert go_on(tmp_path / "run", more, "checkpoint_every=50", "tracking=off", "threads=1") == 0
    assert list(read_table(tmp_path / "run" / files.EPISODES)["world"]) == ["A", "A", "A", "B"]
    settings = json.loads((tmp_path / "run" / files.SETTINGS).read_text())
    assert settings["curriculum"]["name"] == "A3+B1"
    assert settings["evaluation"]["every"] == 10
    # Nothing was written but in the run's own folder.
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_actions_of_a_resumed_run_lengthen_its_last_stage(tmp_path: Path) -> None:
    stages = "curriculum.stages=[{world: A}, {world: B}]"
    (settings,) = composed([*OVERRIDES, stages, "actions=30"])
    assert start(settings, tmp_path) == 0
    assert "actions=45" in after_the_end(tmp_path)
    assert go_on(tmp_path, "actions=45") == 0
    found = json.loads((tmp_path / files.SETTINGS).read_text())["curriculum"]["stages"]
    assert [(stage["world"], stage["actions"]) for stage in found] == [("A", 15), ("B", 30)]
    assert json.loads((tmp_path / files.STATUS).read_text())["steps"] == 45
    with pytest.raises(Rejected, match="actions must be at least the 45 of the run, got 40"):
        go_on(tmp_path, "actions=40")
    shorter = "curriculum.stages=[{world: A, actions: 15}, {world: B, actions: 25}]"
    with pytest.raises(Rejected, match=r"has \[A: 15, B: 30\], got \[A: 15, B: 25\]"):
        go_on(tmp_path, shorter)


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
def test_the_words_that_began_a_run_may_be_said_again_when_it_goes_on(learner: str) -> None:
    words = ["regime=rooms", f"learner={learner}", "curriculum=rooms", "method=per"]
    (settings,) = composed(words)
    assert changed(asdict(settings), parse_overrides(words)) == settings


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("learner.gamma=0.5", r"cannot change learner.gamma=0.5 \(it has 0.99\)"),
        ("method=per", "cannot change method.name=per"),
        ("regime=rooms", r"cannot change regime=rooms \(it has paper\)"),
        ("robots=4", r"cannot change robots=4 \(it has 1\)"),
        (STAGES.format(1), r"curriculum.stages may have more .* has \[A: 2\], got \[A: 1\]"),
        ("actions=900", "actions must be null in a run that counts episodes, got 900"),
        ("run_dir=elsewhere", "resume: run_dir has no effect, a run resumes in its folder"),
        # Sums over two threads have other last bits.
        ("threads=2", r"cannot change threads=2 \(it has 1\)"),
        ("tracking=csv,wandb", r"takes one value, got tracking=.*: several are tracking=\[csv,wan"),
    ],
)
def test_what_a_run_cannot_change_on_its_way_is_rejected_by_name(
    override: str, message: str, two_episodes: Path
) -> None:
    before = contents(two_episodes)
    with pytest.raises(Rejected, match=message) as caught:
        go_on(two_episodes, override)
    assert "\n" not in str(caught.value)
    assert contents(two_episodes) == before


@pytest.fixture(scope="module")
def two_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    begin(folder, episodes=2)
    return folder


def test_one_wandb_run_stays_one_through_resuming(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[dict[str, object]] = []
    init = wandb.init

    def remember(**arguments: object) -> object:
        started.append(arguments)
        return init(**{**arguments, "mode": "disabled"})

    monkeypatch.setattr(wandb, "init", remember)
    begin(tmp_path, "tracking=offline", "tracking.pictures_every=null", episodes=1)
    go_on(tmp_path, STAGES.format(2))
    go_on(tmp_path, STAGES.format(3))
    assert len({each["id"] for each in started}) == 1
    assert [each["resume"] for each in started] == ["allow"] * 3
    assert started[0]["group"] == "A1-mpfa_per-ddpg"
    assert started[0]["tags"] == ["A1", "mpfa_per", "ddpg", "paper"]
    assert started[0]["job_type"] == "train"
    assert read_checkpoint(tmp_path)["wandb"] == started[0]["id"]


def test_resuming_a_finished_run_says_so_and_what_else_there_is_to_do(
    two_episodes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(two_episodes)
    more = f"resume={two_episodes} 'curriculum.stages=[{{world: A, episodes: 4}}]'"
    said = (
        f"{two_episodes} is finished, after 2 episodes: evaluate it with evaluate.py "
        f"{two_episodes}, or train on with train.py {more}\n"
    )
    # At once: nothing of what takes seconds to import is.
    code = (
        "import runpy, sys; sys.modules['torch'] = sys.modules['omegaconf'] = None; "
        f"sys.argv = ['train.py', 'resume={two_episodes}']; "
        f"runpy.run_path({train.__file__!r}, run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, said, "")
    assert go_on(two_episodes, "tracking=off") == 0
    assert capsys.readouterr().out == said
    assert contents(two_episodes) == before


def exit_status(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> object:
    """What the script gives back in this process, which has all imported that it needs."""
    monkeypatch.setattr(sys, "argv", ["train.py", *arguments])
    with pytest.raises(SystemExit) as caught:
        train.main()
    return caught.value.code


def appears(file: Path, seconds: float = 120) -> bool:
    end = time.monotonic() + seconds
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.02)
    return file.exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_a_killed_run_goes_on_and_signals_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    words = [*OVERRIDES, STAGES.format(10_000), f"run_dir={folder}", "checkpoint_every=20"]
    killed = subprocess.Popen(
        [sys.executable, train.__file__ or "", *words], stderr=subprocess.PIPE, text=True
    )
    there = appears(folder / CHECKPOINT)
    killed.send_signal(signal.SIGKILL)
    _, err = killed.communicate(timeout=60)
    assert there, err
    assert killed.returncode == -signal.SIGKILL, err
    assert err.strip().startswith("0%"), err  # The bar comes first, no warning of any import.
    before = read_checkpoint(folder)["schedule"]["actions"]
    assert before >= 20

    (folder / files.STATUS).unlink(missing_ok=True)

    def end_once_at_work() -> None:
        appears(folder / files.STATUS)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=end_once_at_work, daemon=True).start()
    status = exit_status(monkeypatch, f"resume={folder}", "checkpoint_every=1000000")
    assert status == 128 + signal.SIGTERM
    assert f"continue with: train.py resume={folder}" in capsys.readouterr().out
    assert read_checkpoint(folder)["schedule"]["actions"] > before
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("saved", [False, True])
def test_a_run_stopped_at_once_says_what_there_is_to_go_on_with(
    saved: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(run: TrainingRun) -> bool:
        if saved:
            run.save()
        run.stop.ask(signal.SIGINT)
        run.stop.ask(signal.SIGINT)
        raise AssertionError("the second signal stops at once")

    monkeypatch.setattr(TrainingRun, "train", interrupted)
    assert begin(tmp_path) == 128 + signal.SIGINT
    out = capsys.readouterr().out
    assert (f"continue with: train.py resume={tmp_path}" in out) == saved
    assert ("nothing of it was saved" in out) == (not saved)


@pytest.mark.parametrize(
    "number", mostly_slow([*SIGNALS], [signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2])
)
def test_a_signal_stops_after_the_iteration_and_twice_at_once(number: int, tmp_path: Path) -> None:
    (settings,) = composed([*OVERRIDES, STAGES.format(50)])

    def stop(run: TrainingRun) -> None:
        if run.actions == 23:
            os.kill(os.getpid(), number)

    run = train_tiny(tmp_path, settings, stop)
    assert (run.actions, run.stop.exit_status) == (23, 128 + number)
    assert read_checkpoint(tmp_path)["schedule"]["actions"] == 23
    with pytest.raises(KeyboardInterrupt):
        run.stop.ask(number)


def test_the_help_has_all_choices_and_the_values_of_those_that_are_given(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["train.py", "--help", "learner=td3"])
    train.main()
    said = capsys.readouterr().out
    assert "learner: ddpg, dqn, plain, q_learning, sac, td3" in said
    assert "policy_noise: 0.4" in said
    assert "name: td3" in said
