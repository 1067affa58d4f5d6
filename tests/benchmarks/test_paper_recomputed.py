"""Numbers of the paper's page, made again from the kept rows by code that imports none of ours."""

from __future__ import annotations

import csv
import gzip
import itertools
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

DOCS = Path(__file__).resolve().parents[2] / "docs"
ROWS = DOCS / "results/paper"
METHODS = {
    "MPFA-PER": "mpfa_per",
    "PER": "per",
    "TD-error + reward": "td_reward",
    "TD-error + loss": "td_loss",
    "MPF-PER": "mpf_per",
    "Raise priority": "raise",
    "Decay priority": "decay",
    "KLPER": "klper",
    "DDPG + RAdam": "ddpg_radam",
    "HVPER": "hvper",
    "Averaged-DDPG": "averaged_ddpg",
    "MW-MADDPG": "mw",
    "uniform": "uniform",
}


def read(path: Path) -> list[dict[str, str]]:
    with gzip.open(path, "rt") as file:
        return list(csv.DictReader(file))


def rows_of_runs() -> dict[str, dict[int, list[dict[str, str]]]]:
    found: dict[str, dict[int, list[dict[str, str]]]] = {}
    for row in read(ROWS / "tests.csv.gz"):
        found.setdefault(row["arm"], {}).setdefault(int(row["seed"]), []).append(row)
    return found


RUNS = rows_of_runs()


def success(arm: str) -> dict[int, float]:
    return {
        seed: sum(row["success"] == "1" for row in rows) / len(rows)
        for seed, rows in sorted(RUNS[arm].items())
    }


def collisions(arm: str) -> list[float]:
    return [sum(row["collision"] == "1" for row in rows) for _, rows in sorted(RUNS[arm].items())]


def times(arm: str) -> list[float]:
    reached = [
        [float(row["time_s"]) for row in rows if row["success"] == "1"]
        for _, rows in sorted(RUNS[arm].items())
    ]
    return [sum(each) / len(each) for each in reached]


def steps(arm: str) -> list[float]:
    return [
        float(read(ROWS / f"episodes/{arm}-{seed}.csv.gz")[-1]["total_steps"])
        for seed in sorted(RUNS[arm])
    ]


def student(values: list[float]) -> list[float]:
    mean = sum(values) / len(values)
    if len(values) < 2:
        return [mean]
    square = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    reach = stats.t.ppf(0.975, len(values) - 1) * math.sqrt(square / len(values))
    return [mean, mean - reach, mean + reach]


def text_of(title: str) -> str:
    page = (DOCS / "results/paper.md").read_text(encoding="utf-8")
    return next(part for part in page.split("\n## ") if part.startswith(title))


def section(title: str) -> Iterator[list[str]]:
    for line in text_of(title).splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and cells[0]:
            yield cells


def numbers(cell: str) -> list[float]:
    return [float(each.replace(",", "")) for each in re.findall(r"[-+]?\d[\d,]*\.?\d*", cell)]


def assert_printed(cell: str, values: list[float], digits: int, high: float = math.inf) -> None:
    mean, *ends = student(values)
    expected = [mean, *(min(max(end, 0.0), high) for end in ends)]
    assert numbers(cell) == pytest.approx(expected, abs=0.5001 * 10**-digits), cell


@pytest.mark.parametrize("table", ["Table 2", "Table 4"])
def test_tests_in_the_unseen_world_are_those_of_the_rows(table: str) -> None:
    count = 0
    for name, _, hit, _, reached, _, time, runs in section(table):
        if f"ddpg-{METHODS[name]}" in RUNS:
            arm = f"ddpg-{METHODS[name]}"
            assert_printed(hit, collisions(arm), 1, 200.0)
            assert_printed(reached, [100 * each for each in success(arm).values()], 1, 100.0)
            assert_printed(time, times(arm), 1)
            assert int(runs) == len(RUNS[arm])
            count += 1
    assert count == {"Table 2": 7, "Table 4": 6}[table]


def test_training_steps_are_those_of_the_rows() -> None:
    for name, _, ours, runs, *_ in section("Table 3"):
        assert_printed(ours, steps(f"ddpg-{METHODS[name]}"), 0)
        assert int(runs) == len(RUNS[f"ddpg-{METHODS[name]}"])


def arm_of(name: str) -> str:
    method, _, kind = name.partition(", ")
    if name.startswith("φ"):
        return f"ddpg-mpfa_per-phi{name[-1]}"
    if kind.startswith("φ"):
        return f"ddpg-{METHODS[method]}-phi{kind[-1]}"
    learner, end = {
        "": ("ddpg", ""),
        "sixteen robots": ("ddpg", ""),
        "to the letter": ("plain", "-letter"),
        "one robot": ("ddpg", "-one_robot"),
    }[kind]
    return f"{learner}-{METHODS[method]}{end}"


def by_signs(gaps: list[float]) -> list[float]:
    """Student's interval of the gaps and p of all choices of their signs."""
    signs = np.array(list(itertools.product((1, -1), repeat=len(gaps))))
    sizes = abs(signs @ np.array(gaps))
    return [*student(gaps), float((sizes >= abs(sum(gaps)) - 1e-9).mean())]


def by_deals(ours: list[float], theirs: list[float]) -> list[float]:
    """Welch's interval of the difference and p of all deals of the runs to two sides."""
    together, gap = ours + theirs, sum(ours) / len(ours) - sum(theirs) / len(theirs)
    gaps = []
    for deal in itertools.combinations(range(len(together)), len(ours)):
        part = sum(together[place] for place in deal)
        rest = (sum(together) - part) / len(theirs)
        gaps.append(abs(part / len(ours) - rest))
    errors = [float(np.var(side, ddof=1)) / len(side) for side in (ours, theirs)]
    both = sum(errors)
    share = sum(e**2 / (len(s) - 1) for e, s in zip(errors, (ours, theirs), strict=True))
    reach = stats.t.ppf(0.975, both**2 / share) * math.sqrt(both) if both else 0.0
    p = sum(each >= abs(gap) - 1e-9 for each in gaps) / len(gaps)
    return [gap, gap - reach, gap + reach, p]


@pytest.mark.parametrize("title", ["Neighbors", "Other comparisons"])
def test_comparisons_are_those_of_the_rows(title: str) -> None:
    count = 0
    for cells in section(title):
        if " − " not in cells[0] or not cells[2]:
            continue
        a, b = (success(arm_of(name)) for name in cells[0].split(" − "))
        common = sorted(a.keys() & b.keys())
        if len(common) >= 6:
            *points, p = by_signs([a[seed] - b[seed] for seed in common])
        else:
            *points, p = by_deals(list(a.values()), list(b.values()))
        assert numbers(cells[2]) + numbers(cells[3]) == pytest.approx(
            [100 * each for each in points], abs=0.0501
        )
        assert numbers(cells[4]) == pytest.approx([p], abs=0.000501)
        count += 1
    assert count >= 11


def test_other_settings_are_those_of_the_rows() -> None:
    count, kind = 0, ""
    for line in text_of("Uniform replay").splitlines():
        kind = ", to the letter" if line.startswith("To the letter") else kind
        kind = "" if line.startswith("One robot") else kind
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if not line.startswith("| ") or not cells[0]:
            continue
        name, reached, hit, time, runs = cells
        arm = arm_of(name + ("" if name.startswith("φ") else kind))
        assert_printed(reached, [100 * each for each in success(arm).values()], 1, 100.0)
        assert_printed(hit, collisions(arm), 1, 200.0)
        assert_printed(time, times(arm), 1)
        assert int(runs) == len(RUNS[arm])
        count += 1
    assert count >= 9


def test_numbers_beside_the_papers_claims_are_those_of_the_rows() -> None:
    ours = {claim: number for claim, _, number in section("The paper's claims")}
    of_all = {name: 100 * np.mean([*success(f"ddpg-{m}").values()]) for name, m in METHODS.items()}
    a, b = success("ddpg-mpfa_per"), success("ddpg-per")
    common = sorted(a.keys() & b.keys())
    if len(common) >= 6:
        gap, low, high, p = by_signs([a[seed] - b[seed] for seed in common])
    else:
        gap, low, high, p = by_deals([*a.values()], [*b.values()])
    both = f"{of_all['MPFA-PER']:.1f}% and {of_all['PER']:.1f}%"
    assert ours["success of MPFA-PER and of PER"] == both
    interval = f"{100 * gap:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}], p = {p:.3f}"
    assert ours["MPFA-PER − PER [points], 95 %, p"] == interval
    ends = f"{min(of_all.values()):.1f}% to {max(of_all.values()):.1f}%"
    assert ours["success of the methods"] == ends
    spread = np.mean([np.var([*success(f"ddpg-{m}").values()], ddof=1) for m in METHODS.values()])
    deviation = ours["standard deviation of runs of one method [points]"]
    assert deviation == f"{100 * math.sqrt(spread):.1f}"
    arms = ("mpfa_per", "per", "uniform")
    for end, words in (
        ("plain-{}-letter", "success of methods to the letter of the paper"),
        ("ddpg-{}", "success of the same with what keeps DDPG from collapsing"),
    ):
        means = [100 * np.mean([*success(end.format(arm)).values()]) for arm in arms]
        assert ours[words] == f"{min(means):.1f}% to {max(means):.1f}%"
    for table in ("Table 2", "Table 4"):
        pairs = [(numbers(cells[3])[0], success(arm_of(cells[0]))) for cells in section(table)]
        tau, p = stats.kendalltau(
            [published for published, _ in pairs], [np.mean([*s.values()]) for _, s in pairs]
        )
        claim = f"Kendall's rank correlation with the order of {table}, exploratory"
        assert ours[claim] == f"{tau:+.2f}, p = {p:.3f}"
    longer = [np.mean(steps(f"ddpg-{METHODS[c[0]]}")) for c in section("Table 3")]
    *others, own = longer
    count = sum(each > own for each in others)
    claim = "methods of Table 3 with more training steps than MPFA-PER, in the mean"
    assert ours[claim] == f"{count} of 5"
