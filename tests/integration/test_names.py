"""Names that are too long: shortened where scripts make them, one line where a user does."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pytest

import compare
import evaluate
import export
import report
import tune
from mpfa_envs import RobotNoise
from training.comparison.arms import Arm
from training.comparison.jobs import Job
from training.evaluating import Conditions
from training.files import check_folder, full_disk, run_script, short_name
from training.settings.train import _one_folder

LONG = "a" * 300


def test_name_within_the_limit_stays_and_longer_ones_end_in_a_digest_of_the_whole() -> None:
    assert short_name("a" * 240) == "a" * 240
    one, other = short_name("é" * 121), short_name("é" * 120 + "e")
    assert one != other
    assert len(one.encode()) <= 240
    assert one.startswith("é" * 100)


def test_folder_of_a_run_with_many_settings_has_a_short_name_of_its_own() -> None:
    words = ",".join(f"method.setting_{number}=0.123456" for number in range(12))
    names = {_one_folder(f"{words},seed={seed}") for seed in (0, 1)}
    assert len(names) == 2
    assert max(len(name) for name in names) <= 240


def test_folder_of_an_evaluation_in_many_worlds_has_a_short_name() -> None:
    words = [f"rooms:{number}-{number}" for number in range(100, 160)]
    noises = (RobotNoise(slip=slip) for slip in (0.1, 0.2))
    names = {Conditions(tuple(words), "wheels", noise=noise).folder for noise in noises}
    assert len(names) == 2
    assert max(len(name) for name in names) <= 240


def test_groups_of_arms_that_begin_alike_are_two_groups(tmp_path: Path) -> None:
    jobs = [Job("ddpg", "per", 0, tmp_path, Arm("a" * 150 + end)) for end in "xy"]
    groups = [next(w for w in job.overrides([]) if w.startswith("tracking.group")) for job in jobs]
    assert groups[0] != groups[1]
    assert max(len(group.partition("=")[2]) for group in groups) <= 128


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (evaluate, [LONG]),
        (evaluate, ["td3-rooms", "--output", LONG]),
        (evaluate, ["td3-rooms", "--worlds", f"{LONG}.yaml"]),
        (evaluate, ["td3-rooms", "--plugin", f"{LONG}.py"]),
        (export, [LONG]),
        (export, ["td3-rooms", "--output", f"{'b' * 248}.onnx"]),
        (export, ["td3-rooms", "--output", f"{LONG}/small.onnx"]),
        (export, ["td3-rooms", "--world", f"{LONG}.yaml"]),
        (report, [LONG]),
        (report, [".", "--output", LONG]),
        (compare, ["--folder", LONG]),
        (compare, ["--plugin", f"{LONG}.py"]),
        (tune, ["--folder", LONG]),
        (tune, ["--ranges", f"{LONG}.yaml"]),
    ],
    ids=lambda value: value.__name__ if hasattr(value, "main") else value[0][:9],
)
def test_name_for_other_scripts_that_is_too_long_is_an_error_of_the_command_line(
    script: Any,
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        script.main(words)
    assert caught.value.code == 2
    assert "error: " in capsys.readouterr().err.splitlines()[-1]


def test_arm_whose_runs_have_names_that_are_too_long_is_rejected_before_any_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "runs"
    assert compare.main(["--folder", str(folder), "--arm", f"{'a' * 250}:robots=1"]) == 2
    assert "a name may have 255" in capsys.readouterr().err
    assert not folder.exists()


def test_folder_with_the_longest_name_can_be_made(tmp_path: Path) -> None:
    check_folder(tmp_path / ("a" * 255))
    with pytest.raises(ValueError, match="has 256 bytes: a name may have 255"):
        check_folder(tmp_path / ("é" * 128))


def test_script_passes_other_errors_on_and_returns_its_status() -> None:
    def denied() -> None:
        raise PermissionError(errno.EACCES, "no")

    with pytest.raises(PermissionError):
        run_script(denied)
    with pytest.raises(SystemExit) as caught:
        run_script(lambda: 3)
    assert caught.value.code == 3
    assert full_disk(ValueError("no")) is None
