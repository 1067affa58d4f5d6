"""The pages on policies and on decisions say what the kept rows have."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks import decisions, drivers, shipped
from mpfa_envs import POLICIES

DOCS = Path(__file__).parents[2] / "docs"


def test_page_of_policies_has_the_table_of_the_kept_rows() -> None:
    page = (DOCS / "policies.md").read_text(encoding="utf-8")
    made = shipped.shipped_table()
    assert made in page
    assert all(f"`{name}`" in made for name in POLICIES)


def test_page_of_policies_warns_first_of_those_that_touch() -> None:
    page = (DOCS / "policies.md").read_text(encoding="utf-8")
    warning = page[page.index("**") : page.index(" touch obstacles")]
    rows = [line.split(" | ") for line in shipped.shipped_table().splitlines()[2:]]
    for cells in rows:
        name, touched = cells[0].removeprefix("| "), float(cells[4].rstrip("%"))
        assert (name in warning) == (touched > 0.0), name


def test_page_of_drivers_has_the_times_of_the_kept_decisions() -> None:
    page = (DOCS / "results/drivers.md").read_text(encoding="utf-8")
    assert decisions.decision_table() in page


def test_time_of_a_decision_is_compared_at_equal_numbers_of_robots(tmp_path: Path) -> None:
    times = {("td3-rooms", 1): 0.5, ("td3-rooms", 16): 0.05, ("mpc", 1): 5.0, ("mpc", 16): 4.0}
    times |= {("ddpg-rooms", robots): times["td3-rooms", robots] for robots in (1, 16)}
    rows = [
        (name, robots, drive, time * (drive + 1) / 2)
        for (name, robots), time in times.items()
        for drive in range(3)
    ]
    kept = tmp_path / "rows.csv"
    pd.DataFrame(rows, columns=["driver", "robots", "drive", "decision_ms"]).to_csv(kept)
    assert "| `td3-rooms` | 0.50 | 10 | 0.05 | 80 |" in decisions.decision_table(kept)


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
def test_pages_count_runs_and_failures_of_a_learner_as_the_rows_do(learner: str) -> None:
    rows = pd.read_csv(shipped.DRIVERS)
    rows = rows[(rows["robot"] == "kobuki") & (rows["driver"] == learner)]
    rows = rows[(rows["condition"] == "clean") & (rows["worlds"] != "barn")]
    reached = (rows["success"] * rows["episodes"]).groupby(rows["seed"]).sum().round()
    assert list(reached) == [299.0] * 6
    for page in ("drivers", "rooms"):
        text = (DOCS / f"results/{page}.md").read_text(encoding="utf-8")
        assert "six runs of each learner" in text and "299 of 300" in text
    share = reached.sum() / rows["episodes"].sum()
    assert f"**Answer.** {share:.1%}".replace("%", " %") in (DOCS / "results/rooms.md").read_text(
        encoding="utf-8"
    )


def test_time_over_control_on_slower_robots_is_that_of_the_page(
    capsys: pytest.CaptureFixture[str],
) -> None:
    drivers.main([str(shipped.DRIVERS)])
    times = capsys.readouterr().out.strip().split("\n\n")[1].splitlines()
    found = {}
    for line in times[2:]:
        cells = [cell.strip() for cell in line.split("|")]
        found[cells[1].strip("`"), cells[2].strip("`"), cells[3]] = float(cells[-2])
    over = {
        robot: 100 * (found[robot, driver, has] / found[robot, "mpc", has] - 1)
        for robot, driver, has in (
            *((robot, "TD3", "yes") for robot in ("kobuki", "burger", "turtlebot4", "waffle")),
            ("turtlebot2", "td3-turtlebot2", "no"),
        )
    }
    # "3 to 4 % more than mpc", "0 to 1 %", "3 % more", "17 % more time".
    assert {robot: round(more) for robot, more in over.items()} == {
        **{"kobuki": 4, "burger": 0, "turtlebot4": 1},
        **{"waffle": 3, "turtlebot2": 17},
    }
