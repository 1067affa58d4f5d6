"""Learned policies and planners side by side: rows of evaluations, and the tables of the page."""

import json
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import drivers
from mpfa_envs.policies.files import policy_file
from training import files

ROOT = Path(__file__).parents[2]


def write_evaluation(folder, successes, times=(9.0, 9.0, 9.0), **settings):
    """Episodes of two kinds of worlds; what does not succeed collides."""
    folder.mkdir(parents=True)
    rows = pd.DataFrame({"success": successes, "spl": [float(each) for each in successes]})
    rows["collision"], rows["timeout"], rows["time_s"] = ~rows["success"], False, times
    rows["sct"], rows["path_length"], rows["episode"] = 0.5 * rows["spl"], 3.5, [0, 0, 3]
    rows["world"] = ["bars-test-0", "bars-test-1", "barn-3"]
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


def test_times_are_those_beside_a_dynamic_window_on_tasks_that_both_reach(evaluations, capsys):
    every = [True, True, True]
    planner = {"policy": "dwa", "memory": "map", "robot": "kobuki", "seed": 0}
    write_evaluation(evaluations / "slow", every, (99.0, 99.0, 99.0), **planner)
    write_evaluation(
        evaluations / "dwa-filter", every, (10.0, 20.0, 30.0), filter={"clearance": 0.03}, **planner
    )
    assert drivers.main([str(evaluations), "--keep", str(evaluations / "rows.csv")]) == 0
    rows = pd.read_csv(evaluations / "rows.csv").set_index(["robot", "driver", "seed", "worlds"])
    # 9 s each beside 10 and 20 s; seed 5 has not reached the second. 3.5 m take 5 s at 0.7 m/s.
    ratios = rows.loc["kobuki", "td3"][["time_ratio", "bound_ratio"]]
    assert ratios.loc[4, "bars:test"].tolist() == [0.6, 0.3333]
    assert ratios.loc[5, "bars:test"].tolist() == [0.9, 0.5]
    assert ratios.loc[5, "barn"].tolist() == [0.3, 0.1667]
    assert "| `kobuki` | TD3 | yes | 0.750 (0.42) | 0.300 (0.17) | 0.750 (0.42) |" in (
        capsys.readouterr().out
    )


def test_a_policy_of_the_package_drives_the_robot_that_it_was_trained_with(tmp_path):
    sha = files.digest(policy_file("td3-burger"))
    settings = {"card": {"learner": "td3", "seed": 102}, "sha256": sha, "filter": {}}
    write_evaluation(tmp_path / "td3-burger", [True, True, True], **settings)
    assert {row["robot"] for row in drivers.rows_of(tmp_path)} == {"burger"}


def test_a_folder_without_evaluations_is_rejected(tmp_path, capsys):
    with pytest.raises(SystemExit):
        drivers.main([str(tmp_path)])
    assert f"{tmp_path} has no evaluations" in capsys.readouterr().err


@pytest.mark.parametrize("kept", ["drivers.csv", "shipped.csv"])
def test_the_page_has_the_tables_of_the_kept_rows(kept, capsys):
    drivers.main([str(ROOT / "docs/results/rooms" / kept)])
    page = (ROOT / "docs/results/drivers.md").read_text(encoding="utf-8")
    for table in capsys.readouterr().out.strip().split("\n\n"):
        assert table in page
