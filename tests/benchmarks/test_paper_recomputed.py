"""Numbers of the paper's page, made again from the kept rows by code that imports none of ours."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy import optimize, stats

PAGE = Path(__file__).resolve().parents[2] / "docs/results/paper.md"
ROWS = PAGE.with_suffix("")
MPFA_PER, PER = "ddpg-mpfa_per", "ddpg-per"
METHODS = {
    **{"MPFA-PER": "mpfa_per", "PER": "per", "uniform": "uniform", "MPF-PER": "mpf_per"},
    **{"TD-error + reward": "td_reward", "TD-error + loss": "td_loss"},
    **{"Raise priority": "raise", "Decay priority": "decay", "KLPER†": "klper", "HVPER†": "hvper"},
    **{"DDPG + RAdam†": "ddpg_radam", "Averaged-DDPG†": "averaged_ddpg", "MW-MADDPG†": "mw"},
}
PUBLISHED = {
    **{"MPFA-PER": 90.5, "PER": 85.5, "TD-error + reward": 88.0, "TD-error + loss": 87.5},
    **{"MPF-PER": 89.5, "Raise priority": 89.0, "Decay priority": 88.5, "KLPER†": 88.0},
    **{"DDPG + RAdam†": 87.5, "HVPER†": 86.5, "Averaged-DDPG†": 86.0, "MW-MADDPG†": 86.5},
}
"""Success in the paper's Tables 2 and 4, in per cent."""
Runs = NDArray[np.float64]


def counted(path: Path) -> pd.DataFrame:
    """Per arm and seed: successes, collisions, other failures, mean time of a success."""
    rows = pd.read_csv(path)
    rows["late"] = 1 - rows["success"] - rows["collision"]
    rows["time"] = rows["time_s"].where(rows["success"] == 1)
    runs = rows.groupby(["arm", "seed"])
    assert runs.size().eq(200).all()
    counts = runs[["success", "collision", "late"]].sum()
    return counts.assign(time=runs["time"].mean(), failures=200 - counts["success"])


TESTED = counted(ROWS / "tests.csv.gz")


def arm_of(name: str) -> str:
    method, _, words = name.partition(", ")
    if words.startswith("φ"):
        return f"ddpg-{METHODS[method]}-phi{words[-1]}"
    form = {"closer to the paper": "plain-{}-letter", "one robot": "ddpg-{}-one_robot"}
    return form.get(words, "ddpg-{}").format(METHODS[method])


def section(title: str) -> Iterator[list[str]]:
    """Yield the cells of the rows of a section's tables."""
    text = PAGE.read_text(encoding="utf-8")
    for line in next(part for part in text.split("\n## ") if part.startswith(title)).splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and cells[0]:
            yield cells


def numbers(cell: str) -> list[float]:
    return [float(each.replace(",", "")) for each in re.findall(r"[-+]?\d[\d,]*\.?\d*", cell)]


def student(values: Runs) -> list[float]:
    ends = stats.ttest_1samp(values, 0.0).confidence_interval() if len(values) > 1 else ()
    return [float(np.mean(values)), *map(float, ends)]


def assert_printed(cell: str, values: Runs, digits: int, high: float = np.inf) -> None:
    mean, *ends = student(values)
    expected = [mean, *np.clip(ends, 0.0, high)]
    assert numbers(cell) == pytest.approx(expected, abs=0.5001 * 10**-digits), cell


OTHERS = [
    *("ddpg-uniform", *(f"{MPFA_PER}-phi{phi}" for phi in (2, 3, 4))),
    *(f"plain-{name}-letter" for name in ("mpfa_per", "per", "uniform")),
    *(f"ddpg-{name}{end}" for name in ("mpfa_per", "per") for end in ("-one_robot", "")),
]
"""Arms of the tables of other settings, in their order."""


@pytest.mark.parametrize(("title", "arms"), [("Table 2", 7), ("Table 4", 6), ("Uniform", 11)])
def test_tests_in_the_unseen_world_are_those_of_the_rows(title: str, arms: int) -> None:
    lines = list(section(title))
    for (name, *cells), other in zip(lines, OTHERS, strict=title == "Uniform"):
        _, hit, _, reached, _, time, runs = (
            cells if len(cells) > 4 else (*("", cells[1], ""), cells[0], "", *cells[2:])
        )
        rows = TESTED.loc[other if title == "Uniform" else arm_of(name)]
        assert_printed(reached, rows["success"].to_numpy() / 2, 1, 100.0)
        assert_printed(hit, rows["collision"].to_numpy(), 1, 200.0)
        assert_printed(time, rows["time"].to_numpy(), 1)
        assert int(runs) == len(rows)
    assert len(lines) == arms


def test_steps_and_minutes_of_training_are_those_of_the_rows() -> None:
    episodes = pd.read_csv(ROWS / "episodes.csv.gz")
    steps = episodes.groupby(["arm", "seed"])["total_steps"].last()
    minutes = pd.read_csv(ROWS / "times.csv").groupby("arm")["minutes"]
    for name, _, ours, runs, *_, time, timed in section("Table 3"):
        assert_printed(ours, steps[arm_of(name)].to_numpy(), 0)
        assert_printed(time, minutes.get_group(arm_of(name)).to_numpy(), 2)
        assert (int(runs), int(timed)) == (len(steps[arm_of(name)]), minutes.size()[arm_of(name)])
    # The text below the table says so.
    assert set(minutes.mean().nlargest(2).index) == {"ddpg-klper", "ddpg-ddpg_radam"}


def ratio_of(ours: Runs, theirs: Runs, *, paired: bool) -> list[float]:
    """Ratio of two means, and the ends of its bootstrapped 95 % interval."""
    found = stats.bootstrap(
        (ours, theirs),
        lambda a, b, axis: a.mean(axis) / b.mean(axis),
        paired=paired,
        vectorized=True,
        n_resamples=4000,
        method="percentile",
        rng=1,
    )
    return [ours.mean() / theirs.mean(), *map(float, found.confidence_interval)]


def deals(ours: Runs, theirs: Runs, kind: str) -> float:
    """p of a permutation test of two means: exact below 20,000 deals."""
    return float(
        stats.permutation_test(
            (ours, theirs),
            lambda a, b, axis: np.round(abs(a.mean(axis) - b.mean(axis)), 9),
            permutation_type=kind,
            vectorized=True,
            alternative="greater",
            n_resamples=20_000,
            rng=2,
        ).pvalue
    )


def found_with_power(gaps: Runs, level: float) -> float:
    """The true difference that a t-test of the gaps finds in 80 % of all cases."""
    bound = stats.t.ppf(1 - level / 2, len(gaps) - 1)
    shift = optimize.brentq(lambda s: stats.nct.sf(bound, len(gaps) - 1, s) - 0.8, 0.1, 50.0)
    return float(shift * stats.sem(gaps))


def in_steps(ps: list[float]) -> list[float]:
    """Holm's corrected p: each is the largest of its own and of all smaller ones'."""
    own = {p: p * sum(other >= p for other in ps) for p in ps}
    return [min(1.0, max(own[other] for other in ps if other <= p)) for p in ps]


@pytest.mark.parametrize(("title", "pairs"), [("Neighbors", 11), ("Other comparisons", 18)])
def test_comparisons_are_those_of_the_rows(title: str, pairs: int) -> None:
    lines = [cells for cells in section(title) if " − " in cells[0]]
    ps = []
    for pair, paper, failed, points, gap, p, _, least, seeds in lines:
        names = pair.split(" − ")
        if paper:
            missed = [100 - PUBLISHED[name] for name in names]
            assert numbers(paper) == pytest.approx([missed[0] / missed[1]], abs=0.00501)
            assert numbers(points) == pytest.approx([missed[1] - missed[0]], abs=0.0501)
        a, b = (TESTED.loc[arm_of(name), "success"] / 2 for name in names)
        common = a.index.intersection(b.index)
        if len(common) >= 6:
            x, y = a[common].to_numpy(), b[common].to_numpy()
            interval = student(x - y)
            ps.append(deals(x, y, "samples"))
            ratio = ratio_of(100 - x, 100 - y, paired=True)
            assert numbers(failed)[1:] == pytest.approx(ratio[1:], abs=0.05, rel=0.03)
            power = found_with_power(x - y, 0.05 / len(lines))
            assert numbers(least) == pytest.approx([power], abs=0.0501)
        else:
            x, y = a.to_numpy(), b.to_numpy()
            welch = stats.ttest_ind(x, y, equal_var=False).confidence_interval()
            interval = [x.mean() - y.mean(), *welch]
            ps.append(deals(x, y, "independent"))
            assert least == "" and len(numbers(failed)) == 1
        expected = (100 - x).mean() / (100 - y).mean()
        assert numbers(failed)[0] == pytest.approx(expected, abs=0.00501)
        assert numbers(gap) == pytest.approx(interval, abs=0.0501)
        assert float(p) == pytest.approx(ps[-1], abs=0.000501)
        assert int(seeds) == min(len(x), len(y))
    assert len(lines) == pairs
    corrected = [float(cells[6]) for cells in lines]
    assert corrected == pytest.approx(in_steps(ps), abs=0.000501)


def test_claims_are_those_of_the_rows() -> None:
    ours = {claim: number for claim, _, number in section("The paper's claims")}
    sides = [TESTED.loc[arm] for arm in (MPFA_PER, PER)]
    a, b = (side["failures"].to_numpy() / 2 for side in sides)
    assert ours["failures of MPFA-PER and of PER"] == f"{a.mean():.1f}% and {b.mean():.1f}%"
    for claim, column in (
        ("ratio of failures MPFA-PER / PER, 95 %", "failures"),
        ("the same of collisions alone", "collision"),
    ):
        ratio = ratio_of(*(side[column].to_numpy() for side in sides), paired=True)
        assert numbers(ours[claim])[0] == pytest.approx(ratio[0], abs=0.00501)
        assert numbers(ours[claim])[1:] == pytest.approx(ratio[1:], rel=0.05)
    gap, low, high = student(b - a)
    said = f"{gap:+.1f} [{low:+.1f}, {high:+.1f}], p = {deals(b, a, 'samples'):.3f}"
    assert ours["success, MPFA-PER − PER [points], 95 %, p"] == said
    slower = student((sides[0]["time"] - sides[1]["time"]).to_numpy())
    claim = "time of a successful test, MPFA-PER − PER [s], 95 %"
    assert numbers(ours[claim]) == pytest.approx(slower, abs=0.0501)
    runs = [TESTED.loc[f"ddpg-{name}", "success"].to_numpy() / 2 for name in METHODS.values()]
    within = np.mean([np.var(each, ddof=1) for each in runs])
    share = 1 - 117 * within / (129 * np.var(np.concatenate(runs), ddof=1))
    said = f"{share:.1%} and {12 / 129:.1%}, p = {stats.f_oneway(*runs).pvalue:.3f}"
    assert ours["variance that the method† explains, and by chance alone, exploratory"] == said
    both = [(PUBLISHED[name], TESTED.loc[arm_of(name), "success"].mean()) for name in PUBLISHED]
    tau, p = stats.kendalltau(*np.round(np.array(both).T, 9))
    claim = "Kendall's rank correlation with the order of both tables†, exploratory"
    assert ours[claim] == f"{tau:+.2f}, p = {p:.3f}"


def test_answer_of_the_question_is_that_of_the_rows_of_36_new_seeds() -> None:
    new = counted(ROWS / "question/tests.csv.gz")
    table = {cells[0]: cells for cells in section("Does MPFA-PER fail")}
    ps = {}
    columns = {"failures": "failures", "collisions": "collision", "out of time": "late"}
    for words in (
        *("MPFA-PER / PER, failures, primary", "MPFA-PER / uniform, failures, secondary"),
        *("PER / uniform, failures, secondary", "MPFA-PER / PER, collisions, exploratory"),
        *("MPFA-PER / uniform, collisions, exploratory",),
        *("MPFA-PER / uniform, out of time, exploratory",),
    ):
        pair, kind, _ = words.split(", ")
        arms = [f"ddpg-{METHODS[name]}" for name in pair.split(" / ")]
        x, y = (new.loc[arm, columns[kind]] for arm in arms)
        assert tuple(x.index) == tuple(y.index) == tuple(range(110, 146))
        _, _, shares, ratio, p, _, whole = table[words]
        assert shares == f"{x.mean() / 2:.2f}% and {y.mean() / 2:.2f}%"
        found = ratio_of(x.to_numpy(), y.to_numpy(), paired=False)
        assert numbers(ratio)[0] == pytest.approx(found[0], abs=0.00501)
        assert numbers(ratio)[1:] == pytest.approx(found[1:], rel=0.05)
        ps[words] = made = deals(x.to_numpy(), y.to_numpy(), "independent")
        assert float(p) == pytest.approx(made, abs=0.001 + 4 * np.sqrt(made * (1 - made) / 2e4))
        of_all = [
            pd.concat([new.loc[arm, columns[kind]], TESTED.loc[arm, columns[kind]]]).mean()
            for arm in arms
        ]
        assert numbers(whole)[0] == pytest.approx(of_all[0] / of_all[1], abs=0.00501)
    secondary = [words for words in ps if words.endswith("secondary")]
    for words, p in zip(secondary, in_steps([ps[each] for each in secondary]), strict=True):
        assert float(table[words][5]) == pytest.approx(p, abs=0.005)
