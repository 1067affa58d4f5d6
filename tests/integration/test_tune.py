"""The search of settings: what it finds, prunes and keeps, and that it continues where it was."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

import tune
from torchrl_mpfa import Stop
from training import files
from training.records import EvaluationRecord, as_table, read_table
from training.run import script
from training.settings.command_line import composed

optuna = pytest.importorskip("optuna", reason="an extra: pip install 'torchrl-mpfa[tune]'")

BEST_TAU = 0.005
STEPS = range(1000, 5000, 1000)
RANGES = "learner.tau: {low: 1.0e-4, high: 1.0e-1, log: true}\nmethod.batch_size: [64, 128]\n"
SETTINGS = (
    *("learner=td3", "method=per", "curriculum.stages=[{world: A, actions: 4000}]"),
    *("environment.physics=kinematic", "evaluation.world=validation", "evaluation.every=1000"),
)


class Pretended:
    """Takes the place of ``train``: success is the higher, the closer tau is to its best value."""

    def __init__(self) -> None:
        self.words: list[list[str]] = []
        self.stops_at: int | None = None
        """Evaluation after which the run is stopped by a signal."""

    def __call__(self, words: list[str], hooks: list) -> None:
        self.words.append(words)
        given = dict(word.split("=", 1) for word in words)
        folder = Path(given.get("resume") or given["run_dir"])
        folder.mkdir(parents=True, exist_ok=True)
        kept = folder / files.SETTINGS
        if "resume" not in given:
            kept.write_text(f"{given['learner.tau']} {given['seed']}")
        tau, seed = map(float, kept.read_text().split())
        height = 1.0 - 0.4 * abs(math.log10(tau / BEST_TAU)) + 0.001 * (seed % 10)
        rows: list[EvaluationRecord] = []
        stop = Stop("saving")
        for step in STEPS:
            rows.append(
                EvaluationRecord(step, 0, "A", max(height, 0.0) * step / 4000, 0, 0, 0, 0, 0, 0)
            )
            schedule = SimpleNamespace(finished=step == STEPS[-1])
            run = SimpleNamespace(evaluations=rows, schedule=schedule, stop=stop)
            for hook in hooks:
                hook.on_evaluation(run, rows[-1])
            as_table(rows, EvaluationRecord).to_csv(folder / files.EVALUATIONS, index=False)
            (folder / files.CHECKPOINT).touch()
            if len(rows) == self.stops_at:
                self.stops_at = None
                raise SystemExit(128 + signal.SIGINT)
            if stop:
                return
        for name in (files.POLICY, files.EPISODES):
            (folder / name).touch()
        (folder / files.STATUS).write_text('{"finished": true}')


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pretended]:
    pretended = Pretended()
    monkeypatch.setattr(script, "train", pretended)
    yield pretended


def command(folder: Path, *more: str, trials: int = 3) -> list[str]:
    ranges = folder.parent / "ranges.yaml"
    if not ranges.exists():
        ranges.write_text(RANGES)
    options = ("--folder", str(folder), "--ranges", str(ranges), "--trials", str(trials))
    settings = [word for word in more if "=" in word]
    return [*SETTINGS, *settings, *options, *(word for word in more if "=" not in word)]


def trials_of(folder: Path) -> pd.DataFrame:
    return read_table(folder / tune.TRIALS)


@pytest.mark.slow
def test_a_search_finds_what_does_best_and_prunes_what_does_badly(
    tmp_path: Path, trained: Pretended
) -> None:
    assert tune.main(command(tmp_path / "tune", trials=40)) == 0
    found = trials_of(tmp_path / "tune")
    assert len(found) == len(trained.words) == 40
    best = found.loc[found.query("state == 'COMPLETE'")["value"].idxmax()]
    assert best["learner.tau"] == pytest.approx(BEST_TAU, rel=0.3)
    # The area of a straight line is half of its height.
    height = 1.0 - 0.4 * abs(math.log10(best["learner.tau"] / BEST_TAU))
    assert best["value"] == pytest.approx(height / 2, abs=1e-6)
    pruned = found.query("state == 'PRUNED'")
    assert len(pruned) >= 5 and pruned["number"].min() >= 5
    ended = found.query("state == 'COMPLETE'")["learner.tau"]
    assert (pruned["learner.tau"] / BEST_TAU).map(math.log10).abs().median() > (
        (ended / BEST_TAU).map(math.log10).abs().median()
    )
    assert not list((tmp_path / "tune").glob("trial-*/*/checkpoint.pt"))


def test_train_reads_the_best_settings_and_its_command_line_wins(
    tmp_path: Path, trained: Pretended
) -> None:
    folder = tmp_path / "tune"
    assert tune.main(command(folder)) == 0
    found = trials_of(folder)
    [settings] = composed([f"settings={folder / tune.BEST}", "method.batch_size=32"])
    assert settings.learner.tau == found.loc[found["value"].idxmax(), "learner.tau"]
    assert settings.method.batch_size == 32


def test_a_search_that_was_stopped_resumes_its_run_and_makes_so_many_trials_in_all(
    tmp_path: Path, trained: Pretended
) -> None:
    folder = tmp_path / "tune"
    trained.stops_at = 2
    assert tune.main(command(folder)) == 128 + signal.SIGINT
    assert tune.main(command(folder)) == 0
    first = folder / f"trial-0000/seed-{tune.FIRST_SEED}"
    assert [f"resume={first}" in words for words in trained.words] == [False, True, False, False]
    assert trials_of(folder)["state"].tolist() == ["FAIL", *["COMPLETE"] * 3]
    assert tune.main(command(folder)) == 0 and len(trained.words) == 4
    assert tune.main(command(folder, trials=4)) == 0 and len(trained.words) == 5


@pytest.mark.parametrize(
    ("objective", "share"), [("area", 0.5), ("last", 1.0)], ids=["area", "last"]
)
def test_a_trial_is_the_mean_of_a_run_with_each_seed(
    tmp_path: Path, trained: Pretended, objective: str, share: float
) -> None:
    seeds = ("--seeds", "3001", "3003", "--objective", objective)
    assert tune.main(command(tmp_path / "tune", *seeds, trials=1)) == 0
    [row] = trials_of(tmp_path / "tune").to_dict("records")
    height = 1.0 - 0.4 * abs(math.log10(row["learner.tau"] / BEST_TAU)) + 0.002
    assert row["value"] == pytest.approx(share * height)
    assert [words[-2] for words in trained.words] == ["seed=3001", "seed=3003"]


@pytest.mark.parametrize(
    ("more", "name"),
    [(["updates=2"], "settings"), (["--seeds", "5"], "seeds"), (["--objective", "last"], "obj")],
)
def test_another_search_in_the_same_folder_is_rejected_by_what_is_other(
    tmp_path: Path,
    trained: Pretended,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    name: str,
) -> None:
    assert tune.main(command(tmp_path / "tune", trials=1)) == 0
    assert tune.main(command(tmp_path / "tune", *more)) == 2
    assert f"holds a search with other {name}" in capsys.readouterr().err
    assert len(trained.words) == 1


def test_a_run_that_fails_ends_the_search_and_the_next_trial_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(words: list[str], hooks: list) -> None:
        raise SystemExit(1)

    monkeypatch.setattr(script, "train", fail)
    assert tune.main(command(tmp_path / "tune")) == 1
    assert "trial-0000/seed-3000 ended with status 1" in capsys.readouterr().err
    monkeypatch.setattr(script, "train", Pretended())
    assert tune.main(command(tmp_path / "tune", trials=1)) == 0
    assert trials_of(tmp_path / "tune")["state"].tolist() == ["FAIL", "COMPLETE"]


@pytest.mark.slow
def test_a_killed_search_resumes_its_run(tmp_path: Path) -> None:
    (tmp_path / "ranges.yaml").write_text("learner.tau: {low: 1.0e-4, high: 1.0e-1, log: true}\n")
    small = ["regime=paper", "robots=2", "updates=1", "learner.width=8", "learner.compile=false"]
    small += ["method.batch_size=8", "method.capacity=2000", "environment.max_steps=20"]
    small += ["evaluation.every=2000", "evaluation.episodes=2", "checkpoint_every=100"]
    words = command(tmp_path / "tune", *small, "tracking=off", trials=1)
    code = "import sys, tune; tune._SILENT = 2; sys.exit(tune.main())"
    search = subprocess.Popen([sys.executable, "-c", code, *words])
    run = tmp_path / f"tune/trial-0000/seed-{tune.FIRST_SEED}"
    try:
        for _ in range(1200):
            if (run / files.CHECKPOINT).exists():
                break
            time.sleep(0.1)
    finally:
        search.kill()
        search.wait()
    time.sleep(3.0)
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert trials_of(tmp_path / "tune")["state"].tolist() == ["FAIL", "COMPLETE"]
    assert [path.name for path in (tmp_path / "tune").glob("trial-*")] == ["trial-0000"]
    assert read_table(run / files.EVALUATIONS)["total_steps"].tolist() == [2000, 4000]
