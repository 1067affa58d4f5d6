"""The page on people has the numbers of the kept rows, and the bench drives what it says."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from benchmarks import people

DOCS = Path(__file__).parents[2] / "docs"


def kept() -> dict[tuple[str, ...], dict[str, str]]:
    """Numbers by what was driven: place, driver, approach, latency, plan, count."""
    found: dict[tuple[str, ...], dict[str, str]] = {}
    with (DOCS / "results" / "people.csv").open() as file:
        for row in csv.DictReader(file):
            key = tuple(row[name] for name in people.COLUMNS[:-2])
            found.setdefault(key, {})[row["number"]] = row["value"]
    return found


def table(title: str) -> list[list[str]]:
    """Cells of the rows of the table that begins with a column."""
    lines = (DOCS / "results/people.md").read_text(encoding="utf-8").splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith(f"| {title} |"))
    rows = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip("` ") for cell in line.strip("|").split("|")])
    return rows


def test_the_table_of_walkers_that_aim_is_that_of_the_rows() -> None:
    rows, found = kept(), table("walkers [m/s]")
    assert [row[0] for row in found] == [f"{speed:g}" for speed in people.SPEEDS]
    for speed, count, still, safe, share in found:
        place, number = f"aimed {speed}", count.replace(",", "")
        at = {
            approach: rows[place, "random", approach, "0.0", "unknown", number]
            for approach in ("0.0", str(float(speed)))
        }
        without, with_it = at["0.0"], at[str(float(speed))]
        assert (still.replace(",", ""), safe) == (without["driving"], with_it["driving"])
        driven = float(with_it["length"]) / float(without["length"])
        assert share == f"{100 * driven:.0f} %"


@pytest.mark.parametrize(("title", "late"), [("place", "0.0"), ("place, 0.3 s late", "0.3")])
def test_the_table_of_tasks_is_that_of_the_rows(title: str, late: str) -> None:
    rows, found = kept(), table(title)
    shown = set()
    for place, driver, plan, *cells in found:
        for approach, *numbers in zip(*(cell.split(", ") for cell in cells), strict=True):
            key = place, driver, str(float(approach)), late, plan, "20"
            names = "arrived", "touched driving", "touched standing", "time up", "time [s]"
            assert numbers == [rows[key][name] for name in names], key
            shown.add(key)
    assert shown == {key for key in rows if key[3] == late and key[5] == "20"}


def test_the_commands_of_the_page_are_those_of_the_bench() -> None:
    text = (DOCS / "results/people.md").read_text(encoding="utf-8")
    places = re.findall(r"--places ((?:\w+ |\"[\w. ]+\" ?|\w+\n)+)", text)
    assert places
    for words in places:
        for name in re.findall(r'"([^"]+)"|(\w+)', words):
            assert "".join(name) in people.PLACES


def test_tasks_behind_a_filter_that_allows_for_people_end_as_counted() -> None:
    found = people.drive_tasks("td3-rooms", "hall", approach=0.5, tasks=2)
    ends = ("arrived", "touched driving", "touched standing", "time up")
    assert sum(found[name] for name in ends) == 2 and found["touched driving"] == 0


@pytest.mark.slow
def test_a_million_decisions_are_touched_by_nobody_while_they_drive() -> None:
    for speed in people.SPEEDS:
        found = people.drive_among_walkers(250_000, approach=speed, speed=speed, seed=3)
        assert found.driving == 0
