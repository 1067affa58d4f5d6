"""The search of settings: what it finds, prunes and keeps, and that it goes on where it was."""

from __future__ import annotations

import csv
import json
import math
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from optuna import Trial
from optuna.exceptions import StorageInternalError

import tune
from tests.integration.comparison.test_compare import InThisProcess, alive, descendants
from tests.integration.tiny_runs import OVERRIDES
from training import files
from training.comparison import execution
from training.comparison.arms import parse_arm
from training.comparison.jobs import Job
from training.records import read_table, write_table
from training.settings.command_line import composed

search = pytest.importorskip(
    "training.comparison.search", reason="an extra: pip install 'torchrl-mpfa[tune]'"
)

BEST_TAU = 0.005
RANGES = """
learner.tau: {low: 1e-4, high: 1e-1, log: true}
method.batch_size: [64, 128, 256]
"""
STEPS = [1000, 2000, 3000, 4000]


def success(settings: Mapping[str, str], step: int) -> float:
    """The closer tau is to its best value, the higher; batches and seeds matter a little."""
    off = abs(math.log10(float(settings.get("learner.tau", 1.0)) / BEST_TAU))
    height = 1.0 - 0.4 * off + 0.02 * (settings.get("method.batch_size") == "128")
    return round(max(height, 0.0) * step / STEPS[-1] + 0.001 * (int(settings["seed"]) % 10), 6)


class Pretends:
    """Does as if it trained, an evaluation at each look, without a step."""

    begun: ClassVar[list[Path]] = []
    stops = 0
    """Runs that were stopped on their way."""

    def ready(self) -> bool:
        return True

    def start(self, command: Sequence[str], log: Path) -> None:
        given = dict(word.split("=", 1) for word in command[1:])
        self.folder = Path(given.get("resume") or given["run_dir"])
        kept = self.folder / files.SETTINGS
        if "resume" not in given:
            kept.write_text(json.dumps(given))
        self.settings = json.loads(kept.read_text())
        self.begun.append(self.folder)
        self.running = True

    def ended(self) -> int | None:
        done = len(read_table(self.folder / files.EVALUATIONS))
        if done < len(STEPS):
            rows = [(step, success(self.settings, step)) for step in STEPS[: done + 1]]
            table = pd.DataFrame(rows, columns=["total_steps", "success"])
            write_table(table, self.folder / files.EVALUATIONS)
            (self.folder / files.CHECKPOINT).touch()
            return None
        for name in (files.POLICY, files.EPISODES):
            (self.folder / name).touch()
        (self.folder / files.STATUS).write_text('{"finished": true}')
        self.running = False
        return 0

    def stop(self) -> None:
        type(self).stops += getattr(self, "running", False)
        self.running = False

    def wait(self) -> None:
        pass


@pytest.fixture
def ranges(tmp_path: Path) -> Path:
    (tmp_path / "ranges.yaml").write_text(RANGES)
    return tmp_path / "ranges.yaml"


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "LocalWorker", Pretends)
    monkeypatch.setattr(execution, "_PAUSE", 0.0)
    monkeypatch.setattr(search, "plot_search", lambda *_, **__: None)
    monkeypatch.setattr(Pretends, "begun", [])
    monkeypatch.setattr(Pretends, "stops", 0)


def command(folder: Path, ranges: Path, *more: str, trials: int = 20) -> list[str]:
    return [
        *("learner=td3", "method=per", "curriculum.stages=[{world: A, actions: 4000}]"),
        *("environment.physics=kinematic", "evaluation.world=validation"),
        *("evaluation.every=1000", "--folder", str(folder), "--ranges", str(ranges)),
        *("--trials", str(trials), "--jobs", "1", *more),
    ]


def trials_of(folder: Path) -> pd.DataFrame:
    return read_table(folder / search.TRIALS).drop(columns="duration")


def written(folder: Path, column: str) -> list[float]:
    """A column to its last digit, which pandas 2 does not read."""
    with (folder / search.TRIALS).open(encoding="utf-8") as file:
        return [float(row[column]) for row in csv.DictReader(file)]


@pytest.mark.slow
def test_a_search_finds_what_does_best_and_prunes_what_does_badly(
    tmp_path: Path,
    ranges: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, plotted = tmp_path / "tune", []
    monkeypatch.setattr(search, "plot_search", lambda *arguments, **_: plotted.append(arguments))
    ranges.write_text(f"{RANGES}learner.gamma: {{low: 0.9, high: 0.99}}\n")
    assert tune.main(command(folder, ranges, trials=40)) == 0
    found = trials_of(folder)
    assert len(found) == 40
    # Of values that are sampled at random half are more than 0.7 off.
    off = np.log10(found["learner.tau"] / BEST_TAU).abs()
    assert off[20:].median() < 0.4
    best = found.loc[found.query("state == 'COMPLETE'")["value"].idxmax()]
    assert best["learner.tau"] == pytest.approx(BEST_TAU, rel=0.15)
    # The area of a straight line is half of its height.
    height = 1.0 - 0.4 * abs(math.log10(best["learner.tau"] / BEST_TAU))
    height += 0.02 * (best["method.batch_size"] == 128)
    assert best["value"] == pytest.approx(height / 2, abs=1e-4)

    pruned, ended = (found.query(f"state == '{s}'")["value"] for s in ("PRUNED", "COMPLETE"))
    assert len(pruned) + len(ended) == 40
    assert Pretends.stops == len(pruned) > 5
    assert list(found["state"][:5]) == ["COMPLETE"] * 5
    for number in pruned.index:
        rows = read_table(folder / f"trial-{number:04}/td3-per-3000" / files.EVALUATIONS)
        assert 3 <= len(rows) < len(STEPS)
    # Gamma matters nothing here, and the batch little.
    ((table, importances, path),) = plotted
    assert len(table) == 40 and path == folder / search.PICTURE
    assert max(importances.values()) == importances["learner.tau"] > 0.6
    # What is over can not go on, and takes no room.
    assert not list(folder.rglob(files.CHECKPOINT))
    assert str(folder / search.BEST) in capsys.readouterr().out


def test_train_reads_the_best_settings_and_its_command_line_wins(
    tmp_path: Path, ranges: Path
) -> None:
    folder = tmp_path / "tune"
    assert tune.main(command(folder, ranges, trials=6)) == 0
    found = trials_of(folder)
    best = found.loc[found["value"].idxmax()]
    (settings,) = composed([f"settings={folder / search.BEST}", "learner=td3"])
    tau = settings.learner.tau
    assert tau == written(folder, "learner.tau")[best.name]
    assert settings.method.batch_size == best["method.batch_size"]
    assert (settings.learner.name, settings.method.name) == ("td3", "mpfa_per")
    # And an arm of a comparison may have them.
    arm = parse_arm(f"tuned:settings={folder / search.BEST}")
    assert Job("ddpg", "per", 0, tmp_path, arm).asked(()).learner.tau == tau
    (settings,) = composed(["learner.tau=0.5", f"settings={folder / search.BEST}"])
    assert settings.learner.tau == 0.5
    assert settings.method.batch_size == best["method.batch_size"]


@pytest.mark.slow
def test_a_search_that_broke_off_goes_on_to_the_trials_that_it_would_have_had(
    tmp_path: Path, ranges: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Breaks(Pretends):
        """Is the end of the whole search at one of its looks."""

        left = 28

        def ended(self) -> int | None:
            Breaks.left -= 1
            if not Breaks.left:
                raise RuntimeError("the machine is gone")
            return super().ended()

    monkeypatch.setattr(execution, "LocalWorker", Breaks)
    with pytest.raises(RuntimeError, match="the machine is gone"):
        tune.main(command(tmp_path / "broken", ranges, trials=8))
    done = len(Pretends.begun)
    assert 0 < done < 8
    assert tune.main(command(tmp_path / "broken", ranges, trials=8)) == 0
    # The one that was under way has gone on; those that were done are left alone.
    assert Pretends.begun[done] == Pretends.begun[done - 1]
    assert len(set(Pretends.begun)) == 8 == len(Pretends.begun) - 1
    assert tune.main(command(tmp_path / "whole", ranges, trials=8)) == 0
    assert trials_of(tmp_path / "broken").equals(trials_of(tmp_path / "whole"))

    # More trials are those that a longer search would have had; no trial is made again.
    Pretends.begun.clear()
    assert tune.main(command(tmp_path / "whole", ranges, trials=8)) == 0
    assert not Pretends.begun
    assert tune.main(command(tmp_path / "whole", ranges, trials=9)) == 0
    assert len(Pretends.begun) == 1
    assert tune.main(command(tmp_path / "longer", ranges, trials=9)) == 0
    assert trials_of(tmp_path / "whole").equals(trials_of(tmp_path / "longer"))


@pytest.mark.parametrize(("objective", "share"), [("area", 0.5), ("last", 1.0)])
def test_a_trial_is_the_mean_of_a_run_with_each_seed(
    objective: str, share: float, tmp_path: Path, ranges: Path
) -> None:
    more = ["--objective", objective, "--seeds", "3001", "3003"]
    assert tune.main(command(tmp_path / "tune", ranges, *more, trials=2)) == 0
    assert [path.name for path in Pretends.begun] == ["td3-per-3001", "td3-per-3003"] * 2
    for number, row in trials_of(tmp_path / "tune").iterrows():
        curves = [
            read_table(tmp_path / f"tune/trial-{number:04}/td3-per-{seed}" / files.EVALUATIONS)
            for seed in (3001, 3003)
        ]
        last = sum(curve["success"].iloc[-1] for curve in curves) / 2
        assert row["value"] == pytest.approx(share * last, abs=2e-3)


@pytest.mark.slow
def test_the_learner_and_the_method_may_be_searched(tmp_path: Path) -> None:
    ranges = tmp_path / "ranges.yaml"
    ranges.write_text("method: [per, uniform]\nlearner: [ddpg, td3]\n")
    arguments = command(tmp_path / "tune", ranges, trials=8)[2:]
    assert tune.main(arguments) == 0
    found = trials_of(tmp_path / "tune")
    named = [f"{row['learner']}-{row['method']}-3000" for _, row in found.iterrows()]
    assert [path.name for path in Pretends.begun] == named
    assert len(set(named)) > 2


def test_trials_that_fail_are_told_and_three_in_a_row_end_the_search(
    tmp_path: Path,
    ranges: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fails: list[int] = [1, 3, 4, 5, 6]

    class Fails(Pretends):
        def ended(self) -> int | None:
            return 1 if int(self.folder.parent.name[-4:]) in fails else super().ended()

    monkeypatch.setattr(execution, "LocalWorker", Fails)
    assert tune.main(command(tmp_path / "tune", ranges, trials=9)) == 1
    states = list(trials_of(tmp_path / "tune")["state"])
    assert states == ["COMPLETE", "FAIL", "COMPLETE", "FAIL", "FAIL", "FAIL"]
    assert "trial-0001: failed, see" in capsys.readouterr().out
    # Once the cause is gone, the same command goes on.
    fails.clear()
    assert tune.main(command(tmp_path / "tune", ranges, trials=9)) == 0
    assert list(trials_of(tmp_path / "tune")["state"][6:]) == ["COMPLETE"] * 3


@pytest.mark.slow
def test_a_study_on_a_full_disk_ends_in_one_line_and_goes_on_as_if_never_stopped(
    tmp_path: Path,
    ranges: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def without_room(*_: object) -> None:
        database = sqlite3.connect(":memory:")
        database.execute("PRAGMA max_page_count = 1")
        try:
            database.execute("CREATE TABLE trials (number)")
        except sqlite3.OperationalError as error:
            raise StorageInternalError("in the commit") from error

    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    words = command(tmp_path / "study", ranges, trials=3)
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(Trial, "report", without_room)
        files.run_script(lambda: tune.main(words))
    assert ended.value.code == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert f"{tmp_path / 'study' / search.STUDY} cannot be written, No space left" in line
    assert tune.main(words) == 0
    assert tune.main(command(tmp_path / "whole", ranges, trials=3)) == 0
    assert trials_of(tmp_path / "study").equals(trials_of(tmp_path / "whole"))


def test_another_search_in_the_same_folder_is_rejected_by_what_is_other(
    tmp_path: Path, ranges: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "tune"
    assert tune.main(command(folder, ranges, trials=1)) == 0
    assert tune.main(command(folder, ranges, "--seeds", "7")) == 2
    message = capsys.readouterr().err
    assert "holds a search with other seeds, [3000], asked for is [7]" in message
    assert tune.main(["robots=8", *command(folder, ranges)]) == 2
    assert "holds a search with other settings" in capsys.readouterr().err
    ranges.write_text(RANGES.replace("1e-4", "1e-3"))
    assert tune.main(command(folder, ranges)) == 2
    assert "holds a search with other ranges" in capsys.readouterr().err
    (folder / search.STUDY).unlink()
    assert tune.main(command(folder, ranges)) == 2
    assert "has trials, but not their study.db" in capsys.readouterr().err
    assert len(Pretends.begun) == 1


def tiny(folder: Path) -> list[str]:
    """Three trials of real training, with two evaluations each."""
    ranges = folder.parent / "tiny.yaml"
    ranges.write_text("learner.actor_lr: {low: 1e-5, high: 1e-2, log: true}\n")
    return [
        *OVERRIDES,
        *("curriculum.stages=[{world: A, actions: 60}]", "evaluation.every=30"),
        *("evaluation.episodes=2", "evaluation.world=validation"),
        *("--folder", str(folder), "--ranges", str(ranges), "--trials", "3", "--jobs", "1"),
    ]


def settled(arguments: list[str]) -> list[str]:
    """The same without the setting that stands there twice."""
    return [word for word in arguments if word != "evaluation.every=0"]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").exists(), reason="children are listed in /proc")
def test_a_killed_search_leaves_no_training_behind_and_goes_on_to_the_same_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = settled(tiny(tmp_path / "killed"))
    process = subprocess.Popen(
        [sys.executable, tune.__file__ or "", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    run = tmp_path / "killed/trial-0001/ddpg-mpfa_per-3000"
    deadline = time.monotonic() + 600
    while not (run / files.CHECKPOINT).exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    started = descendants(process.pid)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -9
    while any(map(alive, started)):
        assert time.monotonic() < deadline, "a training outlived the search"
        time.sleep(0.05)
    first = tmp_path / "killed/trial-0000/ddpg-mpfa_per-3000" / files.POLICY
    before = first.stat().st_mtime_ns

    monkeypatch.setattr(execution, "LocalWorker", InThisProcess)
    assert tune.main(arguments) == 0
    assert first.stat().st_mtime_ns == before
    # It was not begun again.
    assert not (run / files.PREVIOUS).exists()
    assert tune.main(settled(tiny(tmp_path / "whole"))) == 0
    assert trials_of(tmp_path / "killed").equals(trials_of(tmp_path / "whole"))
