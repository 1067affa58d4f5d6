"""Runs of other methods with the settings of ``examples/sparse.yaml``, and their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import rivals, sparse
from training.settings.command_line import composed
from training.settings.train import register


@pytest.mark.parametrize("name", rivals.METHODS)
def test_arm_has_the_settings_of_the_file_but_for_its_method(name: str) -> None:
    method, goals = sparse.METHODS[name]
    words = (*sparse.SETTINGS, *sparse.REGIMES[rivals.REGIME], f"method={method}")
    register()
    [arm] = composed([*words, f"method.hindsight={goals}"])
    [file] = composed([f"settings={sparse.KEPT.parents[2] / 'examples/sparse.yaml'}"])
    # How a run is judged, logged and named is no part of what it learns.
    others = {name: getattr(arm, name) for name in ("evaluation", "tracking", "method", "run_dir")}
    assert replace(file, **others) == arm
    assert arm.method.hindsight == goals


def test_command_makes_only_runs_without_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: dict[str, list[int]] = {}

    def make(arm: str, folder: Path, seeds: Sequence[int], jobs: int) -> int:
        made.setdefault(arm, []).extend(seeds)
        return 0 if len(made) < 3 else 130

    def rows_of(arm: str, folder: Path) -> list[tuple[object, ...]]:
        name = arm.split(": ")[1]
        return [("simple, validation", name, seed, 2000, 0.5) for seed in made[arm][-5:]]

    monkeypatch.setattr(sparse, "make", make)
    monkeypatch.setattr(sparse, "rows_of", rows_of)
    kept = tmp_path / "kept.csv"
    # The third arm is interrupted: the rows of two are kept.
    assert rivals.make(tmp_path, kept, jobs=1) == 130
    rows = pd.read_csv(kept)
    assert rows.groupby("method")["seed"].apply(list).to_dict() == {
        "HER": [620, 621, 622, 623, 624],
        "PER with hindsight": [620, 621, 622, 623, 624],
    }
    made.clear()
    assert rivals.make(tmp_path, kept, jobs=1) == 130
    assert list(made) == [f"simple: {name}" for name in rivals.METHODS[2:]]


def test_the_tables_of_the_page_are_those_of_the_kept_rows() -> None:
    page = sparse.KEPT.with_suffix(".md").read_text(encoding="utf-8")
    arms, heading, differences = sparse.tables(rivals.KEPT)
    assert heading == "### Simple"
    for table in (rivals.answer(), arms, differences, rivals.mazes()):
        assert table in page


def test_answer_has_the_planned_differences_and_corrects_the_secondary_ones_alone() -> None:
    rows = [line.split(" | ") for line in rivals.answer().splitlines()[2:]]
    assert rows[0][0] == "| PER with hindsight − HER" and float(rows[0][4].strip(" |")) == 0.001
    kept = pd.read_csv(rivals.KEPT)
    last = kept[kept["task"] == "simple, test"].set_index(["method", "seed"])["score"]
    gap = (last["PER with hindsight"] - last["HER"]).mean()
    assert float(rows[4][2]) == pytest.approx(gap, abs=5e-4)
    assert len(rows) == 5
