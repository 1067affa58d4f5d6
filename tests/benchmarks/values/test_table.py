"""Table G: its rows are made once, its differences are paired, its page is made of kept rows."""

from __future__ import annotations

import re
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.values import FrozenBuffer, compare, running
from benchmarks.values.__main__ import main
from benchmarks.values.arms import ARMS, PLANNED
from benchmarks.values.frozen import FOLDER, frozen_buffers
from benchmarks.values.learning import Measure, learn
from benchmarks.values.report import differences, page
from benchmarks.values.running import make_rows, read_rows
from torchrl_mpfa.methods import METHODS


def made_up(gaps: dict[str, float], *, buffers: int = 4, seeds: int = 3) -> pd.DataFrame:
    """Measures whose logarithm of the RMSE differs by a gap, and by luck that seeds share."""
    rng = np.random.default_rng(0)
    rows = []
    for buffer in range(buffers):
        for seed in range(seeds):
            luck = rng.normal(scale=0.5)
            for method, gap in gaps.items():
                for updates in (10, 20):
                    own = 0.001 * rng.normal()
                    numbers = {each.name: 0.5 for each in fields(Measure)}
                    numbers |= {"rmse": np.exp(luck + gap + own), "rank": 0.5 + gap + luck + own}
                    numbers |= {"returns_rmse": numbers["rmse"], "returns_rank": numbers["rank"]}
                    where = {"buffer": f"b{buffer}", "method": method, "seed": seed}
                    rows.append({**numbers, **where, "updates": updates})
    return pd.DataFrame(rows)


def test_differences_are_of_the_same_buffers_and_seeds() -> None:
    found = differences(made_up({"per": 0.0, "a": -0.05, "b": 0.1}), against="per")
    assert list(found.index) == ["a", "b"]
    assert found["rmse"].tolist() == pytest.approx([np.expm1(-0.05), np.expm1(0.1)], abs=2e-3)
    assert (found["rmse_low"] < found["rmse"]).all() and (found["rmse"] < found["rmse_high"]).all()
    # Luck is ten times as large as the difference, and in both.
    assert (found["rmse_high"] - found["rmse_low"]).max() < 0.01
    assert found["rank"].tolist() == pytest.approx([-0.05, 0.1], abs=2e-3)
    assert found["units"].tolist() == [4, 4]
    assert found["rmse_p"].tolist() == [2 / 2**4] * 2


def test_with_one_buffer_the_unit_is_the_training() -> None:
    found = differences(made_up({"per": 0.0, "a": -0.05}, buffers=1, seeds=6), against="per")
    assert found["units"].tolist() == [6]
    assert found["rmse_p"].tolist() == [2 / 2**6]


def test_methods_are_compared_on_a_buffer(walk: FrozenBuffer, monkeypatch) -> None:
    def shortly(*arguments, **options):
        return learn(*arguments, **options, marks=(4, 8))

    monkeypatch.setattr(running, "learn", shortly)
    found = compare(["per", METHODS["uniform"]], [walk], seeds=range(2))
    assert list(found.index) == ["uniform"]
    assert found["units"].tolist() == [2]
    with pytest.raises(ValueError, match="against must be one of the methods, uniform, got 'per'"):
        compare(["uniform"], [walk])


def test_the_ten_lines_of_the_page_compare_a_signal_of_ones_own(monkeypatch, capsys) -> None:
    monkeypatch.setattr(running, "learn", partial(learn, marks=(4, 8)))
    text = (FOLDER.parent / "values.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    exec(code.replace("seeds=range(6)", "seeds=range(2)"), names := {})
    assert list(names["found"].index) == ["mine"]
    assert "rmse_low" in capsys.readouterr().out


def test_trainings_that_have_rows_are_not_made_again(
    walk: FrozenBuffer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk.save(tmp_path)
    path = tmp_path / "rows.csv"
    assert not len(read_rows(path))
    made = []

    def train(folder: Path, arm: str, seed: int, names: list[str]) -> list[dict[str, object]]:
        made.append((arm, seed, names))
        measure = Measure(names[0], arm, seed, 10, *[0.5] * 8)
        return [vars(measure)]

    monkeypatch.setattr(running, "_train", train)
    monkeypatch.setattr(running, "ProcessPoolExecutor", Here)
    make_rows(path, ["per"], [0, 1], jobs=1, folder=tmp_path)
    make_rows(path, ["per", "uniform"], [0, 1], jobs=1, folder=tmp_path)
    assert made == [(arm, seed, ["walk"]) for arm in ("per", "uniform") for seed in (0, 1)]
    rows = read_rows(path)
    assert list(rows.columns) == [each.name for each in fields(Measure)]
    assert len(rows) == 4


class Here:
    """An executor that runs what it gets at once, in this process."""

    def __init__(self, *arguments: object, **options: object) -> None:
        pass

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def submit(self, function, *arguments):
        from concurrent.futures import Future

        future: Future[object] = Future()
        future.set_result(function(*arguments))
        return future


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "--seeds", "0"], "--seeds must be at least 1, got 0"),
        (["run", "pre"], "unknown arm 'pre'"),
        (["report", "--folder", "{}"], "no frozen buffers in"),
    ],
)
def test_what_cannot_be_made_is_rejected(arguments, message, tmp_path, capsys) -> None:
    with pytest.raises(SystemExit):
        main([each.format(tmp_path) for each in arguments])
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_the_page_of_the_table_is_made_of_the_kept_rows() -> None:
    rows = read_rows(FOLDER / "rows.csv")
    retired = rows["method"].str.contains("/noise|^mixture")
    assert set(PLANNED) < set(rows["method"][~retired]) <= set(ARMS)
    assert page(rows, frozen_buffers()) == (FOLDER / "G.md").read_text("utf-8")
