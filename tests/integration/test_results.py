"""The results that the documentation reports follow from the rows that are kept beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

import report

DOCS = Path(__file__).parents[2] / "docs"


STUDIES = {"results.md": "results", "first_study.md": "results/first"}


@pytest.mark.parametrize(("page", "study"), STUDIES.items())
def test_every_table_of_the_results_is_made_of_the_rows_that_are_kept(
    page: str, study: str, tmp_path: Path
) -> None:
    report.main([str(DOCS / study), "--output", str(tmp_path)])
    text = (DOCS / page).read_text(encoding="utf-8")
    tables = (tmp_path / "tables.md").read_text(encoding="utf-8").strip().splitlines()
    assert len([line for line in tables if line.startswith("|")]) > 20
    assert [line for line in tables if line and line not in text] == []


@pytest.mark.parametrize("runs", ["results/more", "results/overlap"])
def test_the_tables_of_the_further_runs_are_made_of_their_rows(runs: str, tmp_path: Path) -> None:
    report.main([str(DOCS / runs), "--output", str(tmp_path)])
    text = (DOCS / "results.md").read_text(encoding="utf-8")
    tables = (tmp_path / "tables.md").read_text(encoding="utf-8").splitlines()
    found = [line for line in tables if line.startswith("| ddpg | mpfa_per |")]
    assert len(found) == 2
    assert [line for line in found if line not in text] == []
    (further,) = report.by_method(report.read_rows(DOCS / runs / "episodes.csv")).values()
    study = report.by_method(report.read_rows(DOCS / "results/episodes.csv"))
    of_study = next(iter(next(iter(study.values())).values()))
    assert len(further) == 3
    for rows in further.values():
        assert [r["shortest_path"] for r in rows] == [r["shortest_path"] for r in of_study]


@pytest.mark.parametrize("study", STUDIES.values())
def test_every_run_of_a_study_was_tested_on_the_same_two_hundred_pairs(study: str) -> None:
    methods = report.by_method(report.read_rows(DOCS / study / "episodes.csv"))
    assert len(methods) >= 4
    runs = [rows for seeds in methods.values() for rows in seeds.values()]
    assert all(len(seeds) == 3 for seeds in methods.values())
    assert all(len(rows) == 200 for rows in runs)
    pairs = [[row["shortest_path"] for row in rows] for rows in runs]
    assert all(each == pairs[0] for each in pairs)
