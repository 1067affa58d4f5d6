"""What a training says of its robot at the end, and the rescue that it drives with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import evaluate
from mpfa_envs import ROBOTS, load_policy, save_policy
from training import files
from training.doors import door_tasks, drive_through_doors, is_asked
from training.settings.train import TrainSettings


def test_tasks_lead_through_the_door_from_both_sides() -> None:
    tasks = door_tasks(ROBOTS["kobuki"])
    assert len(tasks) == 10
    for each in tasks:
        assert each.task.start[0] * each.task.goal[0] == -9.0
        door = min(box.y_min for box in each.world.boxes if box.y_min > 0.0)
        assert door == pytest.approx(0.23)


def test_a_policy_of_the_package_passes_them_all(tmp_path: Path) -> None:
    save_policy(load_policy("td3-rooms"), tmp_path / files.POLICY)
    assert drive_through_doors(tmp_path) == (
        "doors 5 cm wider than the robot on each side: 10, 10, 10 of 10 passed with orders "
        "0, 0.1, 0.3 s late"
    )


def test_only_a_robot_with_a_map_behind_the_filter_is_asked() -> None:
    settings = TrainSettings()
    settings.environment.filter, settings.environment.memory = 1.0, "map"
    assert is_asked(settings)
    settings.environment.filter = 0.5
    assert not is_asked(settings)
    settings.environment.filter, settings.environment.memory = 1.0, "none"
    assert not is_asked(settings)


def test_an_evaluation_with_a_rescue_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stand(self: object, observations: np.ndarray) -> np.ndarray:
        return np.zeros((len(observations), 2), np.float32)

    monkeypatch.setattr("mpfa_envs.policies.policy.Policy.__call__", stand)
    words = ["td3-rooms", "--worlds", "D", "--episodes", "2", "--physics", "kinematic"]
    summary = evaluate.main([*words, "--no-pictures", "--rescue", "--output", str(tmp_path)])
    assert summary["success"].tolist()[-1] == 1.0
    assert json.loads((tmp_path / files.SETTINGS).read_text())["rescue"] is True


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["td3-rooms", "--no-filter"], "must come with --filter"),
        (["td3-paper", "--filter"], "must come with a map"),
    ],
)
def test_a_rescue_without_a_filter_or_a_map_is_rejected(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        evaluate.main([*words, "--rescue"])
    assert said in capsys.readouterr().err
