"""The export script: a file, a card with results, and what was compared."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

import evaluate
import export
from mpfa_envs import load_policy
from mpfa_envs.policies.policy import policy_file
from mpfa_envs.robots.model import ROBOTS

SHIPPED = "td3-paper"


def test_the_script_tells_what_it_compared_and_puts_known_results_on_the_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(policy_file(SHIPPED), tmp_path / "policy.npz")
    evaluate.main([str(tmp_path), *["--worlds", "B", "--episodes", "2", "--no-pictures"]])
    stale = tmp_path / "evaluation-stale"
    shutil.copytree(tmp_path / "evaluation-B-wheels", stale)
    settings = json.loads((stale / "settings.json").read_text())
    (stale / "settings.json").write_text(json.dumps(settings | {"sha256": "of another"}))
    file = export.main([str(tmp_path), "--episodes", "3"])
    assert file == tmp_path / "policy.onnx"
    known, compared = json.loads((tmp_path / "policy.json").read_text())["results"]
    assert known["worlds_asked"] == ["B"] and known["episodes"] == 2
    assert compared["episodes"] == compared["same"] == 3
    assert compared["exported"] == compared["before"]
    printed = capsys.readouterr().out
    assert "largest difference of an action, 1000 observations: " in printed
    assert "the same to the last digit: 3 of 3" in printed
    evaluate.main([str(file), *["--worlds", "B", "--episodes", "2", "--no-pictures"]])
    assert sorted(path.suffix for path in tmp_path.glob("policy.*")) == [".json", ".npz", ".onnx"]


def test_a_policy_that_needs_the_filter_is_driven_behind_it(tmp_path: Path) -> None:
    file = tmp_path / "policy.onnx"
    tasks = ["--world", "mazes:validation", "--episodes", "10"]
    export.main(["td3-rooms", *tasks, "--output", str(file)])
    compared = json.loads(file.with_suffix(".json").read_text())["results"][-1]
    assert compared["filter"] and compared["same"] == 10
    assert compared["exported"]["success"] == 1.0


def test_a_file_for_another_robot_has_its_numbers_and_results_on_the_card(tmp_path: Path) -> None:
    shutil.copy(policy_file("td3-rooms"), tmp_path / "policy.npz")
    how, robot = ["--worlds", "B", "--episodes", "2", "--no-pictures"], ["--robot", "turtlebot4"]
    for other in ([], robot):
        evaluate.main([str(tmp_path), *how, *other])
    export.main([str(tmp_path), "--episodes", "0", *robot])
    card = json.loads((tmp_path / "policy.json").read_text())
    assert card["robot"] == asdict(ROBOTS["turtlebot4"]) | {"lidar_mount": [0.0, 0.0, 0.0]}
    assert card["limits"]["linear_speed"] == [-0.306, 0.306]
    [known] = card["results"]
    [of_robot] = tmp_path.glob("evaluation-*-turtlebot4")
    assert known["time_s"] == json.loads((of_robot / "evaluation.json").read_text())["time_s"]


def test_a_file_that_differs_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "TOLERANCE", -1.0)
    with pytest.raises(SystemExit, match="the file differs from the policy by"):
        export.main([SHIPPED, "--output", str(tmp_path / "policy.onnx"), "--episodes", "0"])
    assert not list(tmp_path.iterdir())


def test_a_quantized_file_is_written_with_how_it_drives(tmp_path: Path) -> None:
    file = tmp_path / "small.onnx"
    export.main([SHIPPED, "--output", str(file), "--episodes", "1", "--quantize"])
    assert json.loads((tmp_path / "small.json").read_text())["precision"] == "int8"
    assert load_policy(file).observation_size == 24
