"""The study's pictures and pages have the numbers of the kept rows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks import study
from training.comparison.scores import runs_by_task, score_tables
from training.records import area_under

STUDY = Path(__file__).resolve().parents[2] / "docs/results/study"
ROW = re.compile(r"^\| ([\w/-]+) \| (\d+) \| (\d\.\d{3})[ |]", re.MULTILINE)
"""A row of the table of arms: its name, runs and area."""


def page_of(table: str) -> str:
    page = (STUDY.parent / "tables.md").read_text(encoding="utf-8")
    return next(part for part in page.split("\n## ") if part.startswith(f"{table}: "))


@pytest.mark.parametrize("table", study.PANELS)
def test_every_area_of_a_table_is_that_of_the_kept_rows(table: str) -> None:
    areas = {
        arm: [area_under(*run) for run in runs] for arm, runs in study.read_curves(table).items()
    }
    expected = {name: (int(count), area) for name, count, area in ROW.findall(page_of(table))}
    found = {name: (len(areas[arm]), f"{np.mean(areas[arm]):.3f}") for arm, name in short(areas)}
    assert found == expected


@pytest.fixture(scope="module")
def numbers() -> pd.DataFrame:
    return pd.read_csv(STUDY / "numbers.csv.gz", dtype=str, keep_default_na=False)


@pytest.mark.parametrize("table", study.PANELS)
def test_numbers_of_a_table_are_those_of_the_file_of_numbers(
    table: str, numbers: pd.DataFrame
) -> None:
    mine = numbers[numbers["table"] == table]
    kept = set(mine[["of", "row", "column", "value"]].itertuples(index=False, name=None))
    count = 0
    for block in re.findall(r"(?:\*\*(\w+ \w+):\*\* .*\n\n)?((?:^\|.*\n?)+)", page_of(table), re.M):
        [head, _, *rows] = [
            [cell.strip() for cell in line[1:-1].split("|")] for line in block[1].splitlines()
        ]
        if head[:2] != ["", "runs"]:
            continue
        of = next(each for each in mine["of"] if each.startswith(block[0] or "Arms"))
        for name, *cells in rows:
            for column, cell in zip(head[1:], cells, strict=True):
                assert not cell or (of, name, column, cell) in kept
                count += bool(cell)
    assert count >= 12


def test_success_by_kind_of_world_is_that_of_the_kept_tests(numbers: pd.DataFrame) -> None:
    tests = pd.read_csv(STUDY / "tests.csv.gz")
    tests = tests[tests["table"] == "L"]
    kinds = tests["world"].str.partition("-")[0] + ":test"
    found = tests.groupby([tests["arm"], kinds])["success"].mean()
    mine = numbers[(numbers["table"] == "L") & numbers["of"].str.endswith("kind of world")]
    assert len(mine) == len(found) == 36
    for arm, name in short(set(tests["arm"])):
        for row in mine[mine["row"] == name].itertuples():
            # A mean that ends in 5 is rounded down where its floating-point number is below.
            assert float(row.value.rstrip("%")) == pytest.approx(
                100 * found[arm, row.column], abs=0.0501
            )


def short(arms: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Arms, and their names without the parts that all arms of their table have in common."""
    parts = {arm: arm.split("/") for arm in arms}
    for end in (0, -1):
        while min(map(len, parts.values())) > 1 and len({each[end] for each in parts.values()}) < 2:
            for each in parts.values():
                each.pop(end)
    return ((arm, "/".join(each)) for arm, each in parts.items())


@pytest.mark.parametrize("table", study.PANELS)
def test_the_arms_of_a_panel_have_rows_and_differ(table: str) -> None:
    curves = study.read_curves(table)
    for arms in study.PANELS[table].values():
        assert set(arms.values()) <= set(curves)
        assert len(set(arms.values())) == len(arms)


def test_the_tables_of_mujoco_are_those_of_the_kept_rows() -> None:
    page = (STUDY.parent / "mujoco.md").read_text(encoding="utf-8")
    for task, runs in runs_by_task([study.KEPT / "mujoco.csv"]).items():
        assert {len(seeds) for seeds in runs.values()} == {5}
        assert "\n\n".join((f"## {task}", *score_tables(runs)[1:])) in page


IMAGES = ("cliffwalk", "mujoco", "sparse")


def test_a_picture_is_made_of_the_kept_rows(tmp_path: Path) -> None:
    assert study.main(["L", *IMAGES, "--output", str(tmp_path)]) == 0
    images = (STUDY.parents[1] / f"images/{name}.png" for name in IMAGES)
    for kept in (STUDY / "L.png", *images):
        with Image.open(tmp_path / kept.name) as new, Image.open(kept) as old:
            assert new.size == old.size
            assert (np.asarray(new) == np.asarray(old)).mean() > 0.99
