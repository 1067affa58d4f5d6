"""The tables that `python -m benchmarks.study statistics` writes of a comparison."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.study import statistics
from training.records import write_table


@pytest.mark.usefixtures("tables_alone")
def test_every_statistic_of_a_comparison_is_in_its_tables(comparison: Path) -> None:
    assert statistics.main([str(comparison)]) == 0
    text = (comparison / "tables.md").read_text(encoding="utf-8")
    no = "none, no spread"
    assert "| ddpg | mpfa_per | 87.5% | 100.0%, 75.0% | 12.5% | 0.0% | 0.700 | 20.4 |" in text
    assert f"| ddpg/per | 2 | success | 0.000 | {no} | {no} | {no} |  |" in text
    assert f"| ddpg/per | 2 | SPL | 0.000 | {no} | {no} | {no} | 0.000 {no} |" in text
    # From zero to 0.5 in 5,000 steps, then to 1 in 4,000: (1250 + 3000) / 9000.
    assert "| ddpg | mpfa_per | 9,000; 9,000 | 0.472 | 0.472, 0.472 |" in text
    assert "| ddpg/mpfa_per − ddpg/per | +0.875, p = 0.333 | +0.700, p = 0.333 | 0.333 |" in text
    assert "Success of ddpg varies from run to run by 12.50 points" in text


@pytest.mark.usefixtures("tables_alone")
def test_runs_that_differ_much_have_their_tables(comparison: Path) -> None:
    rows = pd.read_csv(comparison / "episodes.csv")
    good = rows["seed"] == 1
    rows = rows.assign(success=good, collision=~good)
    write_table(rows, comparison / "episodes.csv")
    assert statistics.main([str(comparison)]) == 0
    text = (comparison / "tables.md").read_text(encoding="utf-8")
    assert "from run to run by 70.71 points" in text
    assert "80 % power: more than 10,000 for 2 points, 3141 for 5 points." in text
