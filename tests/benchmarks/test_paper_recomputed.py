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
from scipy import optimize, stats

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
    "KLPER†": "klper",
    "DDPG + RAdam†": "ddpg_radam",
    "HVPER†": "hvper",
    "Averaged-DDPG†": "averaged_ddpg",
    "MW-MADDPG†": "mw",
    "uniform": "uniform",
}


PUBLISHED = {
    "MPFA-PER": 90.5,
    "PER": 85.5,
    "TD-error + reward": 88.0,
    "TD-error + loss": 87.5,
    "MPF-PER": 89.5,
    "Raise priority": 89.0,
    "Decay priority": 88.5,
    "KLPER†": 88.0,
    "DDPG + RAdam†": 87.5,
    "HVPER†": 86.5,
    "Averaged-DDPG†": 86.0,
    "MW-MADDPG†": 86.5,
}
"""Success in the paper's Tables 2 and 4, in per cent."""


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


def test_training_times_are_those_of_the_rows() -> None:
    with (ROWS / "times.csv").open() as file:
        rows = list(csv.DictReader(file))
    means = {}
    for name, *_, time, runs in section("Table 3"):
        minutes = [float(r["minutes"]) for r in rows if r["arm"] == f"ddpg-{METHODS[name]}"]
        assert_printed(time, minutes, 2)
        assert int(runs) == len(minutes)
        means[name] = np.mean(minutes)
    slowest = sorted(means, key=lambda name: means[name])[-2:]
    assert slowest == ["KLPER†", "DDPG + RAdam†"]  # as the text below the table says
    own = means.pop("MPFA-PER")
    least, most = min(means.values()), max(means.values())
    words = f"{own:.1f}, {least:.1f} to {most:.1f}"
    assert claimed()["minutes of training, MPFA-PER and the others†"] == words


def arm_of(name: str) -> str:
    method, _, kind = name.partition(", ")
    if name.startswith("φ"):
        return f"ddpg-mpfa_per-phi{name[-1]}"
    if kind.startswith("φ"):
        return f"ddpg-{METHODS[method]}-phi{kind[-1]}"
    learner, end = {
        "": ("ddpg", ""),
        "sixteen robots": ("ddpg", ""),
        "closer to the paper": ("plain", "-letter"),
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


def bootstrapped(
    ours: list[float], theirs: list[float], *, paired: bool, odds: bool = False
) -> list[float]:
    """Ratio of two means of failures, or of their odds, and the ends of its 95 % interval."""
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(4000):
        rows = rng.integers(len(ours), size=len(ours))
        others = rows if paired else rng.integers(len(theirs), size=len(theirs))
        a, b = (np.mean([side[i] for i in at]) for side, at in ((ours, rows), (theirs, others)))
        ratios.append(a / b if not odds else a * (1 - b) / (b * (1 - a)))
    a, b = np.mean(ours), np.mean(theirs)
    whole = a / b if not odds else a * (1 - b) / (b * (1 - a))
    return [float(whole), *np.percentile(ratios, [2.5, 97.5]).tolist()]


def found_with_power(gaps: list[float], level: float) -> float:
    """The true difference that a t-test of the gaps finds in 80 % of all cases."""
    error = math.sqrt(float(np.var(gaps, ddof=1)) / len(gaps))
    bound = stats.t.ppf(1 - level / 2, len(gaps) - 1)
    shift = optimize.brentq(lambda s: stats.nct.sf(bound, len(gaps) - 1, s) - 0.8, 0.1, 50.0)
    return float(error * shift)


def in_steps(ps: list[float]) -> list[float]:
    """Holm's corrected p: each is the largest of its own and of all smaller ones'."""
    own = {p: p * sum(other >= p for other in ps) for p in ps}
    return [min(1.0, max(own[other] for other in ps if other <= p)) for p in ps]


@pytest.mark.parametrize("title", ["Neighbors", "Other comparisons"])
def test_comparisons_are_those_of_the_rows(title: str) -> None:
    count = 0
    lines = [cells for cells in section(title) if " − " in cells[0]]
    tests = len(lines)
    ps, corrected = [], []
    for cells in lines:
        if not cells[2]:
            ps.append(1.0)
            continue
        if cells[1]:
            better, worse = (PUBLISHED[name] for name in cells[0].split(" − "))
            assert numbers(cells[1]) == pytest.approx([(100 - better) / (100 - worse)], abs=0.00501)
            assert numbers(cells[3]) == pytest.approx([better - worse], abs=0.0501)
        a, b = (success(arm_of(name)) for name in cells[0].split(" − "))
        common = sorted(a.keys() & b.keys())
        if len(common) >= 6:
            gaps = [a[seed] - b[seed] for seed in common]
            *points, p = by_signs(gaps)
            least = 100 * found_with_power(gaps, 0.05 / tests)
            assert numbers(cells[7]) == pytest.approx([least], abs=0.0501)
            assert cells[8] == str(len(common))
            ratio = bootstrapped(*([1 - x[seed] for seed in common] for x in (a, b)), paired=True)
            assert numbers(cells[2])[0] == pytest.approx(ratio[0], abs=0.00501)
            assert numbers(cells[2])[1:] == pytest.approx(ratio[1:], abs=0.05, rel=0.03)
        else:
            *points, p = by_deals(list(a.values()), list(b.values()))
            assert cells[7] == ""
            assert cells[8] == str(min(len(a), len(b)))
            failed = [np.mean([1 - share for share in x.values()]) for x in (a, b)]
            assert numbers(cells[2]) == pytest.approx([failed[0] / failed[1]], abs=0.00501)
        assert numbers(cells[4]) == pytest.approx([100 * each for each in points], abs=0.0501)
        assert numbers(cells[5]) == pytest.approx([p], abs=0.000501)
        ps.append(p)
        corrected.append(numbers(cells[6])[0])
        count += 1
    assert count >= 11
    made = [p for p, cells in zip(in_steps(ps), lines, strict=True) if cells[2]]
    assert corrected == pytest.approx(made, abs=0.000501)


def test_other_settings_are_those_of_the_rows() -> None:
    count, kind = 0, ""
    for line in text_of("Uniform replay").splitlines():
        kind = ", closer to the paper" if line.startswith("Closer to the paper") else kind
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


def claimed() -> dict[str, str]:
    return {claim: number for claim, _, number in section("The paper's claims")}


def whole_page() -> str:
    return " ".join((DOCS / "results/paper.md").read_text(encoding="utf-8").split())


def success_of_methods() -> dict[str, list[float]]:
    """Success of each run of each method, in per cent."""
    return {
        name: [100 * each for each in success(f"ddpg-{method}").values()]
        for name, method in METHODS.items()
    }


def test_failures_of_mpfa_per_and_per_are_those_of_the_rows() -> None:
    ours, (a, b) = claimed(), (success_of_methods()[name] for name in ("MPFA-PER", "PER"))
    failed = [[1 - share / 100 for share in runs] for runs in (a, b)]
    means = [100 * np.mean(runs) for runs in failed]
    assert ours["failures of MPFA-PER and of PER"] == f"{means[0]:.1f}% and {means[1]:.1f}%"
    for claim, odds in (
        ("ratio of failures MPFA-PER / PER, 95 %", False),
        ("ratio of the odds of failure, 95 %", True),
    ):
        ratio = bootstrapped(*failed, paired=True, odds=odds)
        assert numbers(ours[claim])[0] == pytest.approx(ratio[0], abs=0.00501)
        assert numbers(ours[claim])[1:] == pytest.approx(ratio[1:], abs=0.03)
    hits = [[count / 200 for count in collisions(f"ddpg-{name}")] for name in ("mpfa_per", "per")]
    ratio = bootstrapped(*hits, paired=True)
    assert numbers(ours["the same of collisions alone"])[0] == pytest.approx(ratio[0], abs=0.00501)
    assert numbers(ours["the same of collisions alone"])[1:] == pytest.approx(ratio[1:], rel=0.05)
    gaps = [x - y for x, y in zip(times("ddpg-mpfa_per"), times("ddpg-per"), strict=True)]
    claim = "time of a successful test, MPFA-PER − PER [s], 95 %"
    assert numbers(ours[claim]) == pytest.approx(student(gaps), abs=0.0501)
    counts = [0] * 200
    for arm in ("ddpg-mpfa_per", "ddpg-per"):
        for row in itertools.chain(*RUNS[arm].values()):
            counts[int(row["episode"])] += row["success"] != "1"
    share = sum(sorted(counts)[-10:]) / sum(counts)
    claim = "failures of MPFA-PER and PER in the ten hardest of 200 tests"
    assert ours[claim] == f"{share:.0%}"
    left = ours["from PER's success to the ceiling of 100 % [points]"]
    assert left == f"{100 - np.mean(b):.1f}"


def test_difference_of_mpfa_per_and_per_is_that_of_the_rows() -> None:
    ours, (a, b) = claimed(), (success_of_methods()[name] for name in ("MPFA-PER", "PER"))
    gaps = [x - y for x, y in zip(a, b, strict=True)]
    gap, low, high, p = by_signs(gaps)
    interval = f"{gap:+.1f} [{low:+.1f}, {high:+.1f}], p = {p:.3f}"
    assert ours["success, MPFA-PER − PER [points], 95 %, p"] == interval
    enough = int(ours["pairs of seeds that find one point with 80 % power, at a level of 5 %"])
    for seeds, found in ((enough, True), (enough - 1, False)):
        bound = stats.t.ppf(0.975, seeds - 1)
        shift = math.sqrt(seeds) / np.std(gaps, ddof=1)
        assert (stats.nct.sf(bound, seeds - 1, shift) >= 0.8) == found


def test_spread_of_methods_and_of_their_runs_is_that_of_the_rows() -> None:
    ours, runs = claimed(), success_of_methods()
    means = [np.mean(each) for each in runs.values()]
    assert ours["success of the methods†"] == f"{min(means):.1f}% to {max(means):.1f}%"
    variance = np.mean([np.var(each, ddof=1) for each in runs.values()])
    deviation = ours["standard deviation of runs of one method† [points]"]
    assert deviation == f"{math.sqrt(variance):.1f}"
    test = stats.f_oneway(*runs.values())
    share = 1 - 117 * variance / (129 * np.var(np.concatenate([*runs.values()]), ddof=1))
    words = "variance that the method† explains, and by chance alone, exploratory"
    assert ours[words] == f"{share:.1%} and {12 / 129:.1%}, p = {test.pvalue:.3f}"
    said = f"found beyond chance: {1 - share:.0%} lies between runs of one method"
    assert said in whole_page()
    ranges = []
    for name in ("plain-{}-letter", "ddpg-{}"):
        every = [success(name.format(each)).values() for each in ("mpfa_per", "per", "uniform")]
        ends = [100 * end(np.mean([*each]) for each in every) for end in (min, max)]
        ranges.append("{:.1f}% to {:.1f}%".format(*ends))
    words = "success closer to the paper, and with our additions to DDPG"
    assert ours[words] == ", and ".join(ranges)


def test_order_of_methods_is_that_of_the_rows() -> None:
    ours = claimed()
    two, four = ([cells[0] for cells in section(table)] for table in ("Table 2", "Table 4"))
    orders = {"Table 2": two, "Table 4†": four, "both tables†": two + four[:-1]}
    for table, names in orders.items():
        pairs = [(PUBLISHED[name], success(arm_of(name))) for name in names]
        tau, p = stats.kendalltau(
            [published for published, _ in pairs],
            [round(sum(200 * share for share in s.values())) / len(s) for _, s in pairs],
        )
        claim = f"Kendall's rank correlation with the order of {table}, exploratory"
        assert ours[claim] == f"{tau:+.2f}, p = {p:.3f}"
    lines = list(section("Neighbors"))
    better = [numbers(c[4])[0] > 0 and numbers(c[6])[0] < 0.05 for c in lines]
    published = {claim: paper for claim, paper, _ in section("The paper's claims")}
    for table, part in (("2", slice(6)), ("4†", slice(6, 11))):
        claim = (
            f"neighbors of Table {table} of which the paper's better one is better; "
            "ours: corrected p < 0.05"
        )
        assert ours[claim] == f"{sum(better[part])} of {len(better[part])}"
        ahead = [numbers(cells[3])[0] > 0 for cells in lines[part]]
        assert published[claim] == f"{sum(ahead)} of {len(ahead)}, untested"
    small = [numbers(c[3])[0] < numbers(c[7])[0] for c in lines]
    claim = "neighbors† whose difference in the paper is below what we find with 80 % power"
    assert ours[claim] == f"{sum(small)} of {len(small)}"
    none = 1.0
    for cells in lines:
        a, b = (success(arm_of(name)) for name in cells[0].split(" − "))
        gaps = [100 * (a[seed] - b[seed]) for seed in sorted(a)]
        error, bound = np.std(gaps, ddof=1) / math.sqrt(10), stats.t.ppf(1 - 0.05 / 22, 9)
        better, worse = (100 - PUBLISHED[name] for name in cells[0].split(" − "))
        gone = 100 * (1 - np.mean([*b.values()])) * (1 - better / worse)
        none *= 1 - stats.nct.sf(bound, 9, gone / error)
    claim = "chance to find no neighbors† that differ, if the paper's ratios of failures hold"
    assert ours[claim] == f"{none:.0%}"
    assert f"the chance to find none would be {none:.0%}, were the steps" in whole_page()
    *others, own = (np.mean(steps(f"ddpg-{METHODS[c[0]]}")) for c in section("Table 3"))
    count = sum(each > own for each in others)
    claim = "methods† of Table 3 with more training steps than MPFA-PER, in the mean"
    assert ours[claim] == f"{count} of 5"
