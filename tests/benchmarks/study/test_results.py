"""The results that the documentation reports follow from the rows that are kept beside them."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.study import pages as study_pages
from benchmarks.study import report, statistics, strength
from training.comparison.report import read_comparisons

pytestmark = pytest.mark.usefixtures("tables_alone")
DOCS = Path(__file__).parents[3] / "docs"
PAGES = {
    "results": "results/paper_task.md",
    "results/first": "results/paper_task.md",
}


def tables(folder: Path, *comparisons: str) -> str:
    statistics.main([*(str(DOCS / study) for study in comparisons), "--output", str(folder)])
    return (folder / "tables.md").read_text(encoding="utf-8")


def missing(text: str, page: str) -> list[str]:
    """Lines of a report that a page does not have."""
    written = (DOCS / page).read_text(encoding="utf-8").splitlines()
    lines = [line for line in text.splitlines() if line and not line.startswith("## ")]
    assert len(lines) >= 3
    return [line for line in lines if line not in written]


@pytest.mark.parametrize(("study", "page"), PAGES.items())
def test_every_table_of_a_study_is_made_of_its_rows(study: str, page: str, tmp_path: Path) -> None:
    assert missing(tables(tmp_path, study), page) == []


@pytest.mark.parametrize("runs", ["results/more", "results/overlap"])
def test_the_tables_of_the_further_runs_are_made_of_their_rows(runs: str, tmp_path: Path) -> None:
    text = tables(tmp_path, runs)
    found = [line for line in text.splitlines() if line.startswith("| ddpg | mpfa_per |")]
    # How it ended, how fast it learned, and when it first had each of two rates of success.
    assert len(found) == 4
    assert missing("\n".join(found), "results/paper_task.md") == []


def test_the_table_of_all_nine_runs_is_made_of_the_rows_of_three_folders(tmp_path: Path) -> None:
    text = tables(tmp_path, "results", "results/more", "results/overlap")
    test = text.split("## rooms")[0]
    assert "| ddpg/mpfa_per | 9 | success |" in test
    # Outcomes of single runs are in the tables of their folders.
    intervals = test[test.index("|  | runs |") :]
    assert missing(intervals, "results/paper_task.md") == []


def test_the_pages_of_the_study_are_made_of_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = sorted((DOCS / "results/study").glob("*.md"))
    figures = {page.stem: sorted(page.parent.glob(f"{page.stem}_*.png")) for page in pages}
    monkeypatch.setattr(study_pages, "plot_study", lambda table, *_: figures[table.name])
    report.main([str(DOCS / "results/study"), "--output", str(tmp_path)])
    assert [page.name for page in pages] == sorted(path.name for path in tmp_path.glob("*.md"))
    assert pages
    for page in pages:
        made = (tmp_path / page.name).read_text("utf-8")
        # The order of the figures is theirs who drew them.
        assert sorted(made.splitlines()) == sorted(page.read_text("utf-8").splitlines())


def test_the_numbers_of_the_study_in_the_results_are_those_of_its_pages() -> None:
    text = (DOCS / "results.md").read_text("utf-8")
    section = text.split("## When do priorities help?")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")]
    pages = (DOCS / "results/study").glob("*.md")
    known = {line for page in pages for line in page.read_text("utf-8").splitlines()}
    known |= set(strength.tables_of(pd.read_csv(DOCS / "results/strength.csv")).splitlines())
    assert len(rows) > 5
    assert [line for line in rows if line not in known] == []


@pytest.mark.parametrize("study", PAGES)
def test_every_run_of_a_study_was_tested_on_the_same_two_hundred_pairs(study: str) -> None:
    rows = read_comparisons([DOCS / study]).query("world == 'test'")
    assert rows["arm"].nunique() >= 4
    assert (rows.groupby("arm")["run"].nunique() == 3).all()
    assert (rows.groupby(["arm", "run"]).size() == 200).all()
    assert (rows.groupby("episode")["shortest_path"].nunique() == 1).all()
