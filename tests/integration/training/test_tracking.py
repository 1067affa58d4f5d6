"""What is logged, as wandb keeps it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from navigation.records import EpisodeRecord, EvaluationRecord
from navigation.settings.train import TrainSettings
from navigation.training import tracking
from navigation.training.tracking import Tracker


class Kept:
    """Entries as wandb keeps them: those of one step are one row, of each key the last value."""

    disabled = False

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, Any]] = {}
        self.axes: dict[str, str] = {}

    def log(self, entries: dict[str, Any], step: int | None = None) -> None:
        step = max(self.rows, default=-1) + 1 if step is None else step
        self.rows.setdefault(step, {}).update(entries)

    def define_metric(self, name: str, *, step_metric: str) -> None:
        self.axes[name] = step_metric


def episode(number: int, *, actions: int) -> EpisodeRecord:
    ended = {"success": True, "collision": False, "timeout": False}
    lengths = {"path_length": 1.0, "shortest_path": 1.0}
    return EpisodeRecord(number, "A", 10, actions, 5.0, 0.5, 1.0, **ended, **lengths)


def test_episodes_that_end_at_one_action_are_all_in_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept()
    monkeypatch.setattr(tracking.wandb, "init", lambda **_: kept)
    tracker = Tracker(TrainSettings(), tmp_path, run_id=None)
    for number, actions in enumerate((160, 160, 160, 176)):
        tracker.log_episode(episode(number, actions=actions))
    tracker.log_evaluation(EvaluationRecord(176, 4, "validation", 0.5, 0.5, 0.0, 0.4, 1.0, 2.0))
    rows = list(kept.rows.values())
    assert [row["train/episode"] for row in rows if "train/episode" in row] == [0, 1, 2, 3]
    # All are plotted over the actions of the run.
    assert [row[kept.axes["*"]] for row in rows] == [160, 160, 160, 176, 176]
