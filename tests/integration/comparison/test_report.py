"""Tables and figures of a comparison, from rows that are made up here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

import report
from training.comparison.report import HOW_TO_READ, read_comparisons
from training.records import write_table

TWO = "two runs: no interval"
LINE = f"| ddpg | mpfa_per | 87.5% | {TWO} | 100.0%, 75.0% | 12.5% | 0.0% | 0.700 | 20.4 |"
NO = "none, no spread"


def test_the_tables_say_what_the_rows_say(
    comparison: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report.main([str(comparison)]) == 0
    text = (comparison / "tables.md").read_text(encoding="utf-8")
    made = f"{comparison}/tables.md, {comparison}/evaluations.png"
    assert capsys.readouterr().out == f"{text}written: {made}\n"
    assert "(evaluations.png)" in text and HOW_TO_READ in text
    # Seven of eight pairs, of which four took 20 s and three 21 s.
    assert LINE in text
    assert f"| ddpg | per | 0.0% | {TWO} | 0.0%, 0.0% | 100.0% | 0.0% | 0.000 |  |" in text
    # Two runs against two: six ways to deal them out, two of which differ as much.
    assert f"| ddpg/mpfa_per − ddpg/per | +0.875 | {TWO} | 0.333 (least 0.333) |" in text
    with Image.open(comparison / "evaluations.png") as picture:
        assert picture.width == 840


def tables_of(folder: Path, change: Callable[[pd.DataFrame], pd.DataFrame]) -> str:
    """The tables of a comparison whose rows are changed before."""
    write_table(change(pd.read_csv(folder / "episodes.csv")), folder / "episodes.csv")
    assert report.main([str(folder)]) == 0
    return (folder / "tables.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("tables_alone")
def test_the_arms_of_a_comparison_have_rows_of_their_own(comparison: Path) -> None:
    for seed in (0, 1):
        (comparison / f"ddpg-per-{seed}").rename(comparison / f"ddpg-per-None-{seed}")
    text = tables_of(comparison, lambda rows: rows.assign(arm=rows["method"].map({"per": "None"})))
    assert "| learner | method | arm | success | 95 % | of each run |" in text
    assert "| ddpg | mpfa_per |  | 87.5% |" in text
    assert "| ddpg | per | None | 0.0% |" in text
    assert "| ddpg/mpfa_per − ddpg/per/None |" in text
    assert "| ddpg | per | None | 90% | 9,000 |" in text


@pytest.mark.usefixtures("tables_alone")
def test_generators_and_barn_have_a_row_each_with_the_worst_run(comparison: Path) -> None:
    names = ["bars-test-5", "bars-validation-5", "barn-3", "barn-4"]
    text = tables_of(comparison, lambda rows: rows.assign(world=names * (len(rows) // 4)))
    assert "| mean of the runs (the worst one) | ddpg/mpfa_per | ddpg/per |" in text
    assert "| bars:test | 100.0% (0: 100.0%) | 0.0% (0: 0.0%) |" in text
    assert "| bars:validation | 100.0% (0: 100.0%) | 0.0% (0: 0.0%) |" in text
    # One of the two pairs in the second run.
    assert "| barn | 75.0% (1: 50.0%) | 0.0% (0: 0.0%) |" in text
    assert "| all | 87.5% (1: 75.0%) | 0.0% (0: 0.0%) |" in text


@pytest.mark.usefixtures("tables_alone")
def test_the_time_to_a_rate_of_success_is_that_of_the_median_run(comparison: Path) -> None:
    steps = [1000, 2000, 3000]
    of_runs = {"mpfa_per": ([0.9, 0.2, 0.96], [0.1, 0.9, 0.94]), "per": ([0.9, 1, 1], [0, 0, 0.8])}
    for method, runs in of_runs.items():
        for seed, success in enumerate(runs):
            table = pd.DataFrame({"total_steps": steps, "success": success})
            table["trained_for"] = table["total_steps"] / 100
            write_table(table, comparison / f"ddpg-{method}-{seed}" / "evaluations.csv")
    report.main([str(comparison)])
    text = (comparison / "tables.md").read_text(encoding="utf-8")
    assert "| ddpg | mpfa_per | 90% | 1,000 | 10 | 0 of 2 |" in text
    assert "| ddpg | mpfa_per | 95% | 3,000 | 30 | 1 of 2 |" in text
    assert "| ddpg | per | 90% | 1,000 | 10 | 1 of 2 |" in text
    assert "| ddpg | per | 95% | 2,000 | 20 | 1 of 2 |" in text
    # Runs of which their time is not known.
    table = pd.DataFrame({"total_steps": steps, "success": [0, 1, 1]})
    for seed in (0, 1):
        write_table(table, comparison / f"ddpg-per-{seed}" / "evaluations.csv")
    report.main([str(comparison)])
    assert "| ddpg | per | 90% | 2,000 |  | 0 of 2 |" in (comparison / "tables.md").read_text(
        "utf-8"
    )


@pytest.mark.usefixtures("tables_alone")
def test_two_comparisons_of_one_name_have_the_runs_of_both(
    comparison: Path, tmp_path: Path
) -> None:
    rows = pd.read_csv(comparison / "episodes.csv").query("method == 'per'")
    folders = [tmp_path / parent / "cmp" for parent in "ab"]
    for folder in folders:
        folder.mkdir(parents=True)
        write_table(rows, folder / "episodes.csv")
    assert report.main([*map(str, folders), "--output", str(tmp_path / "both")]) == 0
    text = (tmp_path / "both" / "tables.md").read_text("utf-8")
    # Four runs at zero say nothing of how far others are from it.
    assert f"| ddpg | per | 0.0% | {NO} | 0.0%, 0.0%, 0.0%, 0.0% |" in text
    assert set(read_comparisons(folders)["run"]) == {f"{f}/{n}" for f in folders for n in (0, 1)}
    assert set(read_comparisons([comparison, folders[0]])["run"]) == {
        *(f"{comparison.name}/{seed}" for seed in (0, 1)),
        *(f"cmp/{seed}" for seed in (0, 1)),
    }


@pytest.mark.usefixtures("tables_alone")
def test_runs_on_other_pairs_are_not_compared(
    comparison: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = pd.read_csv(comparison / "episodes.csv")
    write_table(rows.iloc[:-1], comparison / "episodes.csv")
    with pytest.raises(SystemExit) as ended:
        report.main([str(comparison)])
    assert ended.value.code == 2
    assert "not tested on the same pairs" in capsys.readouterr().err


@pytest.mark.usefixtures("tables_alone")
@pytest.mark.parametrize(
    ("column", "value", "error"),
    [
        ("method", "", r"episodes.csv:2: method must not be empty"),
        ("seed", "", r"episodes.csv:2: seed must not be empty"),
        ("success", "maybe", r"episodes.csv:2: success must be a finite number, got 'maybe'"),
        ("spl", "", r"episodes.csv:2: spl must be a finite number, got an empty cell"),
        ("episode", 1, r"a run must have one row for each episode, got two of arm"),
    ],
)
def test_a_row_of_a_comparison_that_cannot_be_used_is_rejected(
    comparison: Path, column: str, value: object, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = pd.read_csv(comparison / "episodes.csv").astype({column: object})
    rows.loc[0, column] = value
    write_table(rows, comparison / "episodes.csv")
    with pytest.raises(SystemExit):
        report.main([str(comparison)])
    assert error in capsys.readouterr().err
