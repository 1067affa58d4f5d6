"""Actions of 0.2 and 0.4 s: settings of the runs, rows that are kept, measures of rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import durations
from benchmarks.paper.rows import write_rows
from benchmarks.paper.runs import without
from training.settings.train import TrainSettings, register


def settings_of(arm: str) -> TrainSettings:
    """Settings of the first run of an arm."""
    planned = durations.comparison(Path("runs"), (640,))
    register()
    job = next(job for job in planned.jobs if job.arm.name == arm)
    return job.asked(planned.settings)


@pytest.mark.parametrize("arm", ["long", "near"])
def test_longer_actions_have_equal_seconds_updates_and_evaluations(arm: str) -> None:
    short, longer = settings_of("short"), settings_of(arm)
    [first], [second] = short.curriculum.stages, longer.curriculum.stages
    assert longer.environment.action_repeat == 4 and first.actions == 2 * second.actions
    assert first.actions * short.updates == second.actions * longer.updates
    assert short.evaluation.every == 2 * longer.evaluation.every
    assert short.exploration.random_steps == 2 * longer.exploration.random_steps
    assert short.exploration.annealing_steps == 2 * longer.exploration.annealing_steps
    assert longer.learner.gamma == pytest.approx({"long": 0.95, "near": 0.95**2}[arm])


def write_tests(folder: Path, times: dict[str, list[float]]) -> None:
    """Rows of one seed of each arm: two rooms and a maze that the planner does not reach."""
    tasks = [("rooms-test-0", 0), ("rooms-test-1", 0), ("mazes-test-0", 0), ("mazes-test-1", 0)]
    tables = []
    for arm, of_arm in times.items():
        table = pd.DataFrame(tasks, columns=["world", "episode"])
        table["time_s"], table["arm"], table["seed"] = of_arm, arm, 640
        table["success"] = [1, 1, 1, int(arm != "mpc")]
        table["collision"] = 0
        tables.append(table[durations.TESTS])
    write_rows(pd.concat(tables), folder / "tests.csv.gz")


def test_time_over_planner_counts_kinds_alike_and_tasks_that_both_reach(tmp_path: Path) -> None:
    arms = {
        "td3-mpfa_per-short": [20.0, 10.0, 30.0, 9.0],
        "td3-mpfa_per-long": [10.0, 10.0, 15.0, 9.0],
        "mpc": [10.0, 10.0, 15.0, 99.0],
    }
    write_tests(tmp_path, arms)
    found = durations.measures(pd.read_csv(tmp_path / "tests.csv.gz")).set_index("arm")
    assert found["time"]["td3-mpfa_per-long"] == pytest.approx(1.0)
    # Rooms: the root of 2 and 1; mazes: 2.
    assert found["time"]["td3-mpfa_per-short"] == pytest.approx(np.sqrt(np.sqrt(2.0) * 2.0))
    assert found["success"]["td3-mpfa_per-short"] == 1.0
    [outcomes, title, _] = durations.tables(tmp_path)[:3]
    assert "| TD3 | 0.4 s | 1 | 100.00% |" in outcomes and title == "### TD3"


def test_kept_rows_are_those_of_sixty_runs_each_task_once() -> None:
    rows = pd.read_csv(durations.KEPT / "tests.csv.gz")
    assert not rows.duplicated(["arm", "seed", "world", "episode"]).any()
    assert len(rows) == 61 * 6 * durations.EPISODES


def test_the_tables_of_the_page_are_those_of_the_kept_rows() -> None:
    page = Path("docs/results/drivers.md").read_text(encoding="utf-8")
    assert durations.tables()[0] in page and durations.answer() in page


def test_runs_that_are_missing_of_both_learners_are_made_once() -> None:
    planned = durations.comparison(Path("runs"), (640,))
    [part] = without(planned, {"td3-mpfa_per-short-640"})
    assert len({job.name for job in part.jobs}) == len(part.jobs) == 6


def test_answer_has_the_four_planned_differences(tmp_path: Path) -> None:
    slow, fast = [20.0, 10.0, 30.0, 9.0], [10.0, 10.0, 15.0, 9.0]
    arms = {
        f"{learner}-mpfa_per-{arm}": times
        for learner in durations.LEARNERS
        for arm, times in (("short", slow), ("long", fast))
    }
    write_tests(tmp_path, {**arms, "mpc": [10.0, 10.0, 15.0, 99.0]})
    rows = [line.split(" | ") for line in durations.answer(tmp_path).splitlines()[2:]]
    assert [row[0] for row in rows] == ["| TD3: 0.4 s − 0.2 s"] * 2 + ["| DDPG: 0.4 s − 0.2 s"] * 2
    assert float(rows[1][2]) == pytest.approx(-np.log(np.sqrt(np.sqrt(2.0) * 2.0)), abs=5e-4)
    assert float(rows[0][2]) == 0.0
