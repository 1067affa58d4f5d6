"""Tables and a figure of scores that any script wrote."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import report
from training.comparison.scores import height

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


def test_the_height_of_a_curve_counts_what_is_between_its_ends() -> None:
    curve = np.array([0.0, 10.0, 20.0, 40.0]), np.array([0.0, 1.0, 0.0, 4.0])
    assert height(curve, 0.0, 20.0) == pytest.approx(0.5)
    assert height(curve, 5.0, 30.0) == pytest.approx((3.75 + 5.0 + 10.0) / 25.0)
    assert height(curve, 10.0, 10.0) == 1.0


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


def written(folder: Path, text: str, encoding: str = "utf-8") -> int:
    (folder / "scores.csv").write_text(text, encoding=encoding)
    return report.main([str(folder / "scores.csv")])


@pytest.mark.parametrize(
    ("row", "error"),
    [
        ("t,new,,0,1", "3: seed must not be empty"),
        ("t,  ,0,0,1", "3: method must not be empty"),
        ("t,new,0,0,", "3: score must be a finite number, got an empty cell"),
        ("t,new,0,0,good", "3: score must be a finite number, got 'good'"),
        ("t,new,0,1 000,1", "3: steps must be a finite number, got '1 000'"),
        ("t,old,0.0,0,1", "3: a run must have one score at each step, got two of task t"),
        ("\n\nt,new,,0,1", "5: seed must not be empty"),
        ("t,new,0,0,1,9,9\n1,2,3,4,5,6,7,8", "its rows cannot be read"),
    ],
)
def test_a_row_that_cannot_be_used_is_rejected_by_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], row: str, error: str
) -> None:
    with pytest.raises(SystemExit):
        written(tmp_path, f"task,method,seed,steps,score\nt,old,0,0,1\n{row}\n")
    assert f"scores.csv:{error}" in (said := capsys.readouterr().err) or error in said


ROWS = "task,method,seed,steps,score\nt,old,0,0,1\nt,old,0,10,2\n"


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (ROWS, "utf-8-sig"),
        (ROWS.replace(",", ";"), "utf-8"),
        (ROWS.replace(",", "\t"), "utf-8"),
        (ROWS.replace("\n", "\r\n"), "utf-8"),
        (ROWS.replace("old,0,", "old,0.00,"), "utf-8"),
        ("x,task,method,seed,steps,score\n9,t,old,0,0,1\n9,t,old,0,10,2\n", "utf-8"),
    ],
)
def test_other_forms_of_a_table_are_read_alike(tmp_path: Path, text: str, encoding: str) -> None:
    assert written(tmp_path, text, encoding) == 0
    assert "| old | 2.000 | one run |" in (tmp_path / "tables.md").read_text(encoding="utf-8")


def test_one_row_and_truth_values_are_scores(tmp_path: Path) -> None:
    assert written(tmp_path, "task,method,seed,steps,score\nt,a,0,5,True\nt,b,x,5,False\n") == 0
    text = (tmp_path / "tables.md").read_text(encoding="utf-8")
    assert "| a | 1.000 |" in text and "| b | 0.000 |" in text


def recipes() -> dict[str, Any]:
    """What the page on files defines to read the curves of other tools."""
    names: dict[str, Any] = {}
    page = Path(__file__).parents[3] / "docs" / "metrics.md"
    for block in re.findall(
        r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M
    ):
        exec(block, names)
    return names


def test_monitors_of_stable_baselines_are_read_as_on_the_page(tmp_path: Path) -> None:
    monitor = pytest.importorskip("stable_baselines3.common.monitor")
    gymnasium = pytest.importorskip("gymnasium")
    page, curves = recipes(), {}
    for seed in range(2):
        env = monitor.Monitor(gymnasium.make("CartPole-v1"), str(tmp_path / str(seed)))
        env.action_space.seed(seed)
        for episode in range(3):
            env.reset(seed=seed + 10 * episode)
            while not any(env.step(env.action_space.sample())[2:4]):
                pass
        env.close()
        curves["CartPole", "random", seed] = page["of_monitor"](tmp_path / f"{seed}.monitor.csv")
        assert len(curves["CartPole", "random", seed]) == 3
    page["write_scores"](curves, tmp_path / "scores.csv")
    assert report.main([str(tmp_path / "scores.csv")]) == 0
    assert "| random | " in (tmp_path / "tables.md").read_text(encoding="utf-8")


def test_exports_of_wandb_and_tensorboard_are_read_as_on_the_page(tmp_path: Path) -> None:
    page = recipes()
    (tmp_path / "wandb.csv").write_text(
        '"Step","a - eval","a - eval__MIN","a - eval__MAX","b - eval","b - eval__MIN"\n'
        '"0","1","1","1","",""\n"10","3","3","3","5","5"\n"20","4","4","4","7","7"\n'
    )
    (tmp_path / "board.csv").write_text("Wall time,Step,Value\n1.7e9,0,2\n1.7e9,20,6\n")
    curves = {("t", run, 0): page["of_wandb"](tmp_path / "wandb.csv", run) for run in "ab"}
    curves["t", "c", 0] = page["of_tensorboard"](tmp_path / "board.csv")
    page["write_scores"](curves, tmp_path / "scores.csv")
    assert report.main([str(tmp_path / "scores.csv")]) == 0
    text = (tmp_path / "tables.md").read_text(encoding="utf-8")
    assert all(
        f"| {name} | {score}.000 |" in text for name, score in zip("abc", "476", strict=True)
    )
