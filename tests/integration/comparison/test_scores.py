"""Tables and a figure of scores that any script wrote."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

import report

Row = tuple[str, str, int, float, float]
HEAD = ["task", "method", "seed", "steps", "score"]


def rows_of(method: str, scores: Iterable[float], task: str = "Reacher") -> list[Row]:
    """Runs of a score at the end, which they reach in a straight line from zero."""
    return [
        (task, method, seed, steps, score * steps / 20)
        for seed, score in enumerate(scores)
        for steps in (0, 10, 20)
    ]


def reported(folder: Path, *tables: list[Row]) -> str:
    for number, rows in enumerate(tables):
        pd.DataFrame(rows, columns=HEAD).to_csv(folder / f"{number}.csv", index=False)
    assert report.main([str(folder)]) == 0
    return (folder / "tables.md").read_text(encoding="utf-8")


def test_methods_of_several_tables_are_compared_by_their_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.csv").write_text("steps,loss\n1,2\n")
    text = reported(tmp_path, rows_of("sac", [1, 2, 3]), rows_of("mine", [4, 5, 6]))
    assert "| method | score at 20 steps | 95 % | mean of the curve | 95 % |" in text
    line = "| sac | 2.000 | [-0.484, 4.484] | 1.000 | [-0.242, 2.242] | 1.000, 2.000, 3.000 |"
    assert line in text
    # Three against three: twenty ways to deal them out, two of which differ as much.
    assert "| sac − mine | -3.000 | [-5.267, -0.733] | 0.100 (least 0.100) |" in text
    assert capsys.readouterr().out.endswith(
        f"written: {tmp_path}/tables.md, {tmp_path}/curves.png\n"
    )
    assert "(curves.png)" in text
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width == 600


def test_the_same_six_seeds_are_paired(tmp_path: Path) -> None:
    # Seeds differ by much more than the methods, of which one is always ahead by one or two.
    sac = rows_of("sac", [0, 10, 20, 30, 40, 50])
    mine = rows_of("mine", [1, 12, 21, 32, 41, 52])
    assert "| sac − mine | -1.500 | [-2.075, -0.925] | 0.031 |" in reported(tmp_path, sac, mine)
    other = [(task, method, seed + 6, *rest) for task, method, seed, *rest in mine]
    assert "0.031" not in reported(tmp_path, sac, other)


def test_p_is_corrected_for_the_rows_of_its_table(tmp_path: Path) -> None:
    tables = [rows_of(name, [n, n + 1, n + 2, n + 3]) for name, n in (("a", 0), ("b", 9), ("c", 2))]
    text = reported(tmp_path, *tables)
    # Four against four: two of seventy ways, 0.029, and that three times.
    assert "| a − b | -9.000 | [-11.234, -6.766] | 0.086 (least 0.086) |" in text


def test_runs_are_compared_up_to_the_steps_that_all_have(tmp_path: Path) -> None:
    short = [row for row in rows_of("mine", [4, 5, 6]) if row[2] or row[3] < 20]
    text = reported(tmp_path, rows_of("sac", [1, 2, 3]), short)
    assert "score at 10 steps" in text
    assert "| mine | 2.500 |" in text


def test_each_task_has_tables_of_its_own(tmp_path: Path) -> None:
    text = reported(tmp_path, [*rows_of("sac", [1, 2]), *rows_of("sac", [7], "Swimmer")])
    first, second = text.split("## Swimmer")
    assert "| sac | 1.500 | two runs: no interval |" in first
    assert "| sac | 7.000 | one run |" in second
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width == 1200


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task,method,seed,steps\nR,sac,0,1\n", "must have the columns .*: no .'score'"),
        (
            "task,method,seed,steps,score\n",
            "neither episodes.csv of compare.py nor rows of task, method",
        ),
        ("task,method,seed,steps,score\nR,sac,0,1,2\nR,sac,0,2,many\n", ":3: score must be a fin"),
        ("task,method,seed,steps,score\nR,sac,0,1,2\nR,sac,0,1,3\n", "got two of task R, method"),
        (
            "task,method,seed,steps,score\nR,sac,0,1,2\nR,per,0,5,3\n",
            "must have steps in common, got one to 1, one from 5",
        ),
    ],
)
def test_what_is_no_table_of_scores_is_rejected(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scores.csv").write_text(text)
    with pytest.raises(SystemExit) as ended:
        report.main([str(tmp_path / "scores.csv")])
    assert ended.value.code == 2
    assert re.search(message, capsys.readouterr().err)


def test_comparisons_and_scores_are_not_mixed(
    comparison: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scores.csv").touch()
    for words, message in (
        ([comparison, tmp_path / "scores.csv"], "have reports of their own"),
        ([tmp_path / "nowhere"], "there is no"),
    ):
        with pytest.raises(SystemExit):
            report.main([str(word) for word in words])
        assert message in capsys.readouterr().err
