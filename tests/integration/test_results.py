"""The results that the documentation reports follow from the rows that are kept beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

import report

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(("study", "more_than"), [("results", 20), ("results/second", 15)])
def test_every_table_of_the_results_is_made_of_the_rows_that_are_kept(
    study: str, more_than: int, tmp_path: Path
) -> None:
    report.main([str(DOCS / study), "--output", str(tmp_path)])
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    tables = (tmp_path / "tables.md").read_text(encoding="utf-8").strip().splitlines()
    assert len([line for line in tables if line.startswith("|")]) > more_than
    assert [line for line in tables if line and line not in page] == []


@pytest.mark.parametrize(("study", "at_least"), [("results", 4), ("results/second", 2)])
def test_every_run_of_a_study_was_tested_on_the_same_two_hundred_pairs(
    study: str, at_least: int
) -> None:
    methods = report.by_method(report.read_rows(DOCS / study / "episodes.csv"))
    assert len(methods) >= at_least
    runs = [rows for seeds in methods.values() for rows in seeds.values()]
    assert all(len(seeds) == 3 for seeds in methods.values())
    assert all(len(rows) == 200 for rows in runs)
    pairs = [[row["shortest_path"] for row in rows] for rows in runs]
    assert all(each == pairs[0] for each in pairs)
