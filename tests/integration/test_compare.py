"""The study: what is trained, what is left alone, what goes on, and what is kept of it."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import compare

EXAMPLES = Path(compare.__file__).parent
TINY = [
    "learner.width=8",
    "method.batch_size=8",
    "method.capacity=200",
    "environment.physics=kinematic",
    "environment.max_steps=20",
    "evaluation.every=0",
    "curriculum.stages=[{world: A, episodes: 2}]",
]


def study(
    folder: Path, *more: str, methods: tuple[str, ...] = ("mpfa_per", "uniform")
) -> list[str]:
    return [
        *("--folder", str(folder), "--methods", *methods, "--seeds", "0"),
        *("--world", "B", "--episodes", "3", *more, "--", *TINY),
    ]


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "episodes.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_study_keeps_every_episode_and_a_second_call_does_nothing(tmp_path: Path) -> None:
    assert compare.main(study(tmp_path)) == 0
    found = rows(tmp_path)
    assert [(row["method"], row["episode"]) for row in found] == [
        (method, str(number)) for method in ("mpfa_per", "uniform") for number in range(3)
    ]
    for row in found:
        ends = [row[name] == "True" for name in ("success", "collision", "timeout")]
        assert sum(ends) == 1
    before = (tmp_path / "ddpg-mpfa_per-0" / "checkpoint.pt").stat().st_mtime_ns
    assert compare.main(study(tmp_path)) == 0
    assert (tmp_path / "ddpg-mpfa_per-0" / "checkpoint.pt").stat().st_mtime_ns == before
    assert rows(tmp_path) == found


def test_a_killed_study_goes_on_to_the_same_rows(tmp_path: Path) -> None:
    arguments = study(tmp_path / "killed", methods=("mpfa_per",))
    arguments[-1] = "curriculum.stages=[{world: A, episodes: 30}]"
    arguments.append("checkpoint_every=1")
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLES / "compare.py"), *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    checkpoint = tmp_path / "killed" / "ddpg-mpfa_per-0" / "checkpoint.pt"
    deadline = time.monotonic() + 120
    while not checkpoint.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed" / "episodes.csv").exists()
    assert compare.main(arguments) == 0
    arguments[1] = str(tmp_path / "whole")
    assert compare.main(arguments) == 0
    assert rows(tmp_path / "killed") == rows(tmp_path / "whole")


def test_a_run_that_fails_is_named_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = study(tmp_path, "--jobs", "1")
    # A file where the run wants its checkpoint, which is no checkpoint.
    (tmp_path / "ddpg-mpfa_per-0").mkdir()
    (tmp_path / "ddpg-mpfa_per-0" / "checkpoint.pt").write_bytes(b"no checkpoint")
    assert compare.main(arguments) == 1
    assert "ddpg-mpfa_per-0: failed, see" in capsys.readouterr().out
    assert {row["method"] for row in rows(tmp_path)} == {"uniform"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "pre"], "unknown method 'pre'"),
        (["--learners", "ddgp"], "unknown learner 'ddgp'"),
        (["--jobs", "0"], "--jobs must be at least 1, got 0"),
    ],
)
def test_a_wrong_command_line_is_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        compare.main(arguments)
    assert message in capsys.readouterr().err
