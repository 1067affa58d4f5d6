"""Learned policies and planners side by side: rows of evaluations, and the tables of the page."""

import json
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import drivers
from mpfa_envs.policies.policy import policy_file
from training import files

ROOT = Path(__file__).parents[2]


def write_evaluation(folder, successes, scts=(0.5, 0.5, 0.5), **settings):
    """Episodes of two kinds of worlds; what does not succeed collides."""
    folder.mkdir(parents=True)
    rows = pd.DataFrame({"success": successes, "spl": [float(each) for each in successes]})
    rows["collision"], rows["timeout"], rows["standstill"] = ~rows["success"], False, False
    rows["sct"], rows["time_s"], rows["decision_s"] = scts, 9.0, 0.002
    rows["episode"], rows["world"] = [0, 0, 3], ["bars-test-0", "bars-test-1", "barn-3"]
    rows.to_csv(folder / "episodes.csv", index=False)
    (folder / "settings.json").write_text(json.dumps({"words": ["bars:test", "barn"], **settings}))


@pytest.fixture
def evaluations(tmp_path):
    for seed, successes in ((4, [True, True, True]), (5, [True, False, True])):
        run = tmp_path / "kobuki" / f"td3-per-{seed}"
        card = {"learner": "td3", "seed": seed}
        write_evaluation(run / "evaluation-a", successes, card=card, filter={"clearance": 0.03})
        robot = json.dumps({"environment": {"robot": "kobuki"}})
        (run / "settings.json").write_text(robot)
        (run / "episodes.csv").write_text("episode,world\n0,bars\n")  # Of the training.
    planner = {"policy": "dwa", "memory": "map", "robot": "burger", "seed": 0}
    write_evaluation(tmp_path / "dwa", [False, True, True], **planner)
    return tmp_path


def test_every_evaluation_becomes_a_row_for_each_kind_of_worlds(evaluations, capsys):
    kept = evaluations / "rows.csv"
    assert drivers.main([str(evaluations), "--keep", str(kept)]) == 0
    rows = pd.read_csv(kept)
    columns = ["robot", "driver", "seed", "filter", "worlds", "episodes", "success", "collision"]
    assert rows[columns].to_numpy().tolist() == [
        ["burger", "dwa map", 0, False, "bars:test", 2, 0.5, 0.5],
        ["burger", "dwa map", 0, False, "barn", 1, 1.0, 0.0],
        ["kobuki", "td3", 4, True, "bars:test", 2, 1.0, 0.0],
        ["kobuki", "td3", 4, True, "barn", 1, 1.0, 0.0],
        ["kobuki", "td3", 5, True, "bars:test", 2, 0.5, 0.5],
        ["kobuki", "td3", 5, True, "barn", 1, 1.0, 0.0],
    ]
    printed = capsys.readouterr().out
    assert "| `kobuki` | TD3 | yes | 75.0% [50%] | 100.0% [100%] | 16.67% |" in printed
    assert drivers.main([str(kept)]) == 0
    assert capsys.readouterr().out == printed


def test_time_is_that_over_the_bound_of_the_tasks_that_a_driver_reaches(tmp_path, capsys):
    planner = {"policy": "mpc", "memory": "none", "plan": "known", "robot": "kobuki", "seed": 0}
    write_evaluation(tmp_path / "mpc", [True, True, True], (0.8, 0.2, 0.5), **planner)
    write_evaluation(
        tmp_path / "dwa", [True, False, True], (0.8, 0.2, 0.5), **dict(planner, policy="dwa")
    )
    rows = drivers.rows_of(tmp_path)
    assert [row["time_over_bound"] for row in rows] == pytest.approx([1.25, 2.0, 2.5, 2.0])
    drivers.main([str(tmp_path)])
    printed = capsys.readouterr().out
    # SPL, a decision, and times in five kinds and in all generators, among which BARN is none.
    assert "| `kobuki` | `mpc --plan known` | no | 1.000 | 2.00 | 2.500 | 2.500 |" in printed


def test_errors_and_delays_stand_in_a_table_of_their_own(tmp_path, capsys):
    planner = {"policy": "dwa", "memory": "map", "robot": "kobuki", "seed": 0}
    every = [True, True, True]
    write_evaluation(tmp_path / "clean", every, **planner)
    write_evaluation(tmp_path / "late", [True, False, True], latency=0.3, **planner)
    write_evaluation(tmp_path / "slip", every, noise={"slip": 0.05, "drift": 0.0}, **planner)
    for folder in ("late", "slip"):
        episodes = pd.read_csv(tmp_path / folder / "episodes.csv")
        episodes.loc[2, "world"] = "mazes-test-0"
        episodes.to_csv(tmp_path / folder / "episodes.csv", index=False)
    drivers.main([str(tmp_path)])
    clean, conditions = capsys.readouterr().out.rsplit("\n\n", 1)
    assert "`dwa --memory map` | no | 100.0% | 100.0% | 0.00% | 0.00% | 0.00% |" in clean
    late = "| 0.3 s late | 50.0%, 50.0%, 2.00 | 100.0%, 0.0%, 2.00 |"
    assert late in conditions
    assert "| slip 0.05 | 100.0%, 0.0%, 2.00 | 100.0%, 0.0%, 2.00 |" in conditions


def test_a_policy_of_the_package_drives_the_robot_that_it_was_trained_with(tmp_path):
    sha = files.digest(policy_file("td3-burger"))
    settings = {"card": {"learner": "td3", "seed": 102}, "sha256": sha, "filter": {}}
    write_evaluation(tmp_path / "td3-burger", [True, True, True], **settings)
    assert {(row["robot"], row["driver"]) for row in drivers.rows_of(tmp_path)} == {
        ("burger", "td3-burger")
    }


def test_a_folder_without_evaluations_is_rejected(tmp_path, capsys):
    with pytest.raises(SystemExit):
        drivers.main([str(tmp_path)])
    assert f"{tmp_path} has no evaluations" in capsys.readouterr().err


@pytest.mark.parametrize("kept", ["drivers.csv"])
def test_the_page_has_the_tables_of_the_kept_rows(kept, capsys):
    drivers.main([str(ROOT / "docs/results/rooms" / kept)])
    page = (ROOT / "docs/results/drivers.md").read_text(encoding="utf-8")
    for table in capsys.readouterr().out.strip().split("\n\n"):
        assert table in page
