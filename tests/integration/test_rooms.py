"""Random rooms: who drives through them, and what is kept of it."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path

import pytest

import compare
import report
import rooms

POLICY = Path(rooms.__file__).parent / "policies" / "td3-mpfa_per.pt"
UNFINISHED = "ddpg-uniform-0"
RUNS = ("ddpg-per-3", "td3-mpfa_per-10")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for name in (*RUNS, "no-run", UNFINISHED):
        (tmp_path / name).mkdir()
        # A run that is on its way has a policy, too, that of its last checkpoint.
        shutil.copy(POLICY, tmp_path / name / "policy.pt")
        if name != UNFINISHED:
            (tmp_path / name / compare.DONE).touch()
    return tmp_path


def test_every_policy_drives_between_the_same_pairs_of_every_room(study: Path) -> None:
    assert rooms.main([str(study), "--rooms", "5", "3", "--pairs", "2"]) == 0
    rows = report.read_rows(study / "rooms.csv")
    assert [(row["learner"], row["seed"], row["world"], row["episode"]) for row in rows] == [
        (learner, seed, world, episode)
        for learner, seed in (("ddpg", "3"), ("td3", "10"))
        for world in ("random-5", "random-3")
        for episode in "01"
    ]
    results = compare.drive(study / RUNS[0], world="random-3", episodes=2)
    expected = [{name: str(value) for name, value in asdict(r).items()} for r in results]
    columns = set(expected[0])
    assert [{name: row[name] for name in columns} for row in rows[2:4]] == expected
    assert [row["shortest_path"] for row in rows[:4]] == [row["shortest_path"] for row in rows[4:]]


def test_the_report_has_a_table_of_the_rooms_apart_from_the_paper(study: Path) -> None:
    result = {"success": True, "collision": False, "timeout": False, "time_s": 9.0, "spl": 0.5}
    which = {"learner": "ddpg", "method": "per", "seed": 3}
    missed = {**which, "world": "random-3", **result, "success": False, "timeout": True, "spl": 0.0}
    columns = ["learner", "method", "seed", "world", *result]
    rooms.write_rows(
        [{**which, "world": "random-5", **result}, missed], columns, study / "rooms.csv"
    )
    rooms.write_rows([{**which, **result}], [*which, *result], study / "episodes.csv")
    for name in ("episodes.csv", "progress.csv"):
        row = {"total_steps": 10, "success": 1, "average_reward": 0.1}
        rooms.write_rows([row], list(row), study / RUNS[0] / name)
    report.main([str(study)])
    tables = (study / "tables.md").read_text(encoding="utf-8")
    assert "| ddpg | per | 50.0% | 50.0% | 0.0% | 50.0% | 0.250 | 9.0 |" in tables
    assert tables.count("| paper |") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rooms", "-1"], "seed must be an integer of at least 0, got -1"),
        (["--pairs", "0"], "--pairs must be at least 1, got 0"),
        (["--jobs", "0"], "--jobs must be at least 1, got 0"),
    ],
)
def test_numbers_that_cannot_be_are_named_before_anything_drives(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        rooms.main([str(tmp_path), *arguments])
    assert message in capsys.readouterr().err


def test_a_folder_without_runs_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rooms.main([str(tmp_path)]) == 1
    assert f"{tmp_path} has no LEARNER-METHOD-SEED/test.csv" in capsys.readouterr().out
