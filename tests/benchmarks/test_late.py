"""The bench of late orders: its buildings and robot, and its rows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("onnxruntime", reason="exported policies are of the extra onnx")

from benchmarks.late import __main__ as late
from benchmarks.late.building import Planner, Task, building, clearance, ranges, sample_tasks
from mpfa_envs import ROBOTS

KOBUKI = ROBOTS["kobuki"]
KEPT = Path(__file__).parents[2] / "docs/results/late.csv"


def test_every_second_task_leads_through_a_door_hardly_wider_than_the_robot() -> None:
    narrow = 2 * (KOBUKI.radius + 0.05)
    grid = building(3, narrow)
    tasks = sample_tasks(grid, KOBUKI.radius, 6, seed=3, narrow=narrow)
    assert [task.narrow for task in tasks] == [True, False] * 3
    planner = Planner(grid, KOBUKI.radius)
    for task in tasks:
        path = planner.path(task.start, task.goal)
        assert path is not None
        least = min(clearance(grid, x, y, 5.0) for x, y in path)
        assert (least < narrow / 2 + 0.03) == task.narrow
        assert math.dist(task.start, task.goal) >= 4.0


def test_rays_end_at_walls() -> None:
    grid = building(0, 0.5)
    grid[:], grid[100:140, 100:140] = True, False  # A square of 2 m.
    x = y = 100 * 0.05 - 0.2 + 1.0
    found = ranges(grid, x, y, 0.0, math.pi / 4, 8, 9.0)
    assert found == pytest.approx(np.tile([1.0, math.sqrt(2.0)], 4), abs=1e-6)
    assert clearance(grid, x, y, 3.0) == pytest.approx(1.0)
    assert ranges(grid, x, y, 0.0, 1.0, 1, 0.7)[0] == 0.7


def test_order_acts_after_its_latency() -> None:
    task = Task((9.0, 6.0), 0.0, (12.0, 6.0), 3.0, narrow=False)
    robot = late.Robot(building(0, 0.5), KOBUKI, task, latency=0.1)
    robot.order(0.5, 0.0)
    moved = []
    for _ in range(15):
        robot.step(10.0)
        moved.append(robot.x > 9.0)
    # The order is there at the eleventh tick.
    assert moved == [False] * 10 + [True] * 5


@pytest.mark.parametrize("driver", ["pilot", "node"])
def test_told_pilot_reaches_goals_and_its_rows_have_the_columns_of_the_kept(
    driver: str, tmp_path: Path
) -> None:
    kept = tmp_path / "rows.csv"
    words = ["td3-rooms", "--latency", "0.1", "--tasks", "1", "--keep", str(kept)]
    late.main([*words, *(["--node"] if driver == "node" else [])])
    rows, before = pd.read_csv(kept), pd.read_csv(KEPT)
    assert list(rows) == list(before)
    [row] = rows.to_dict("records")
    assert (row["arrived"], row["touched"], row["told"]) == (1, 0, 0.1)
    assert row["driver"] == driver and row["driver"] in set(before["driver"])
