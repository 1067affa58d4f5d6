"""Hooks of a run: when they are called, what they see, and what an error of theirs does."""

from __future__ import annotations

import json
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.integration.tiny_runs import (
    OVERRIDES,
    assert_same_run,
    go_on,
    mostly_slow,
    tiny,
    train,
)
from torchrl_mpfa import Stop
from training import files
from training.evaluating import Drives
from training.records import EvaluationRecord, read_table
from training.run import loop
from training.run.checkpoints import read_checkpoint
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.settings.train import Stage, TrainSettings

PAGE = Path(__file__).parents[3] / "docs" / "tuning.md"


def of_all_events() -> TrainSettings:
    """Two stages of three robots, with updates and evaluations."""
    stages = [Stage("A", actions=60), Stage("B", actions=60)]
    settings = tiny(episodes=stages, robots=3, updates=2)
    settings.tracking.log_every, settings.checkpoint_every = 30, 30
    settings.tracking.csv = True
    settings.evaluation.every, settings.evaluation.episodes = 30, 2
    return settings


class Noted(Hook):
    """Notes which of its methods were called, and what the run was like then."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []
        self.saved: list[int] = []

    def on_begin(self, run: TrainingRun) -> None:
        self.calls.append(("begin", run.actions))

    def on_update(self, run: TrainingRun, losses: Any, batch: Any) -> None:
        assert losses["loss_value"].isfinite() and len(batch) == run.settings.method.batch_size
        self.calls.append(("update", run.actions))

    def on_episode(self, run: TrainingRun, record: Any) -> None:
        assert record in run.records
        self.calls.append(("episode", record.total_steps))

    def on_evaluation(self, run: TrainingRun, record: Any) -> None:
        assert record is run.evaluations[-1]
        self.calls.append(("evaluation", record.total_steps))

    def on_iteration(self, run: TrainingRun) -> None:
        self.calls.append(("iteration", run.actions))
        if run.crossed(30):
            # The run's own hooks were called before.
            self.saved.append(read_checkpoint(run.folder)["schedule"]["actions"])

    def on_end(self, run: TrainingRun) -> None:
        assert json.loads((run.folder / files.STATUS).read_text())["finished"]
        self.calls.append(("end", run.actions))

    def close(self) -> None:
        self.calls.append(("close", -1))


def test_a_hook_is_called_in_the_order_of_a_run_after_the_run_s_own(tmp_path: Path) -> None:
    noted = Noted()
    run = TrainingRun(of_all_events(), tmp_path, hooks=[noted])
    assert run.train()
    run.close()
    calls = noted.calls
    assert calls[0] == ("begin", 0) and calls[-2:] == [("end", 120), ("close", -1)]
    assert [actions for name, actions in calls if name == "iteration"] == list(range(3, 121, 3))
    assert [actions for name, actions in calls if name == "evaluation"] == [30, 60, 90, 120]
    assert noted.saved == [30, 60, 90, 120]
    counts = {name: len([each for each, _ in calls if each == name]) for name, _ in calls}
    assert counts["episode"] == len(run.records)
    assert min(counts["episode"], counts["update"]) > 1
    order = ["update", "episode", "evaluation", "iteration"]
    places = [(actions, order.index(name)) for name, actions in calls[1:-2]]
    assert places == sorted(places)


@pytest.mark.parametrize(
    "event",
    mostly_slow(["on_update", "on_episode", "on_evaluation", "on_iteration"], ["on_iteration"]),
)
def test_a_run_that_a_hook_s_error_ended_goes_on_as_if_it_had_not(
    tmp_path: Path, event: str
) -> None:
    settings = of_all_events()
    settings.checkpoint_every = 10_000
    # Whatever raises, an evaluation is due then.
    settings.evaluation.every, settings.evaluation.episodes = 3, 1

    def fail(run: TrainingRun, *_: object) -> None:
        # At the end of a stage.
        if run.actions >= 60:
            raise RuntimeError("a bug of a hook")

    (tmp_path / "part").mkdir()
    failing = Hook()
    setattr(failing, event, fail)
    run = TrainingRun(settings, tmp_path / "part", hooks=[failing])
    with pytest.raises(RuntimeError, match="a bug of a hook"):
        run.train()
    run.close()
    whole = train(tmp_path / "whole", settings)
    again = go_on(tmp_path / "part", settings)
    assert_same_run(again, whole)
    steps = [[each.total_steps for each in run.evaluations] for run in (again, whole)]
    assert steps[0] == steps[1]
    # The log has every row once, too.
    parts, wholes = (tmp_path / name / files.CSV for name in ("part", "whole"))
    for path in wholes.rglob("*.csv"):
        rows = [(folder / path.relative_to(wholes)).read_text() for folder in (parts, wholes)]
        assert path.parent.name == "time" or rows[0] == rows[1], path


@pytest.mark.parametrize("wrong", [Hook, lambda run: None, None])
def test_what_is_no_hook_is_rejected_before_the_run_begins(tmp_path: Path, wrong: Any) -> None:
    with pytest.raises(TypeError, match=re.escape(f"hooks: {wrong!r} is no object")):
        TrainingRun(tiny(), tmp_path, hooks=[wrong])
    assert not list(tmp_path.iterdir())


def test_hooks_that_ask_to_stop_end_the_run_without_a_signal_and_a_signal_counts_after_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    stop = Stop()
    stop.ask()
    stop.ask()
    assert (bool(stop), stop.exit_status, capsys.readouterr().out) == (True, 0, "")
    stop.ask(signal.SIGTERM)
    stop.ask()
    assert stop.exit_status == 128 + signal.SIGTERM
    with pytest.raises(KeyboardInterrupt):
        stop.ask(signal.SIGTERM)


def test_progress_in_a_file_is_a_line_a_minute_and_one_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train(tmp_path / "short", tiny())
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r"6 of 6 episodes, B: success \d+% of last 6, \d+ updates/s$", line)
    monkeypatch.setattr("training.run.hooks._LINE_EVERY", 0.0)
    monkeypatch.setattr("training.run.hooks._REPORT_EVERY", 0.0)
    train(tmp_path / "long", tiny())
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 6 and "\r" not in lines[0]


@pytest.mark.filterwarnings("ignore")
def test_the_script_on_the_page_stops_after_two_good_evaluations_in_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    evaluate, found = loop.evaluate_policy, iter((0.95, 0.9, 1.0, 0.95, 1.0))

    def evaluated(*arguments: Any, **named: Any) -> tuple[EvaluationRecord, Drives]:
        record, driven = evaluate(*arguments, **named)
        return replace(record, success=next(found)), driven

    monkeypatch.setattr(loop, "evaluate_policy", evaluated)
    folder = tmp_path / "run"
    words = [each for each in OVERRIDES if not each.startswith("evaluation.")]
    words += ["evaluation.every=10", "evaluation.episodes=1", f"run_dir={folder}"]
    stages = "curriculum.stages=[{world: A, actions: 1000}]"
    monkeypatch.setattr(sys, "argv", ["early.py", *words, stages])
    exec(code, {})
    assert "stopped after 40 actions; continue with" in capsys.readouterr().out
    rates = read_table(folder / files.EVALUATIONS)["success"]
    assert list(rates) == [0.95, 0.9, 1.0, 0.95]
    # A run that goes on is stopped by its next good evaluation.
    monkeypatch.setattr(sys, "argv", ["early.py", f"resume={folder}"])
    exec(code, {})
    assert read_checkpoint(folder)["schedule"]["actions"] == 50
