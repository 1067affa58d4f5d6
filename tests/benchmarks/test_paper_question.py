"""The answer to the paper's question, made again from the kept rows by code of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.benchmarks.test_paper_recomputed import (
    METHODS,
    ROWS,
    bootstrapped,
    collisions,
    in_steps,
    numbers,
    read,
    section,
    success,
)


def by_sampled_deals(ours: list[float], theirs: list[float]) -> float:
    """p of 20,000 random deals of the runs to two sides."""
    rng = np.random.default_rng(2)
    together, gap = np.array(ours + theirs), abs(np.mean(ours) - np.mean(theirs))
    deals = rng.permuted(np.tile(together, (20_000, 1)), axis=1)
    gaps = deals[:, : len(ours)].mean(1) - deals[:, len(ours) :].mean(1)
    return float(np.mean(np.abs(gaps) >= gap - 1e-9))


def test_answer_of_the_question_is_that_of_the_rows_of_36_new_seeds() -> None:
    missed: dict[str, dict[str, dict[int, int]]] = {
        "failures": {},
        "collisions": {},
        "out of time": {},
    }
    for row in read(ROWS / "question/tests.csv.gz"):
        name, seed = row["arm"].removeprefix("ddpg-"), int(row["seed"])
        missed_it, hit = row["success"] != "1", row["collision"] == "1"
        here = {"failures": missed_it, "collisions": hit, "out of time": missed_it and not hit}
        for kind, counts in here.items():
            runs = missed[kind].setdefault(name, {})
            runs[seed] = runs.get(seed, 0) + counts
    assert {tuple(sorted(runs)) for runs in missed["failures"].values()} == {tuple(range(110, 146))}
    table = {cells[0]: cells for cells in section("Does MPFA-PER fail")}
    ps = []
    for pair, kind in (
        ("MPFA-PER / PER", "failures, primary"),
        ("MPFA-PER / uniform", "failures, secondary"),
        ("PER / uniform", "failures, secondary"),
        ("MPFA-PER / PER", "collisions, exploratory"),
        ("MPFA-PER / uniform", "collisions, exploratory"),
        ("MPFA-PER / uniform", "out of time, exploratory"),
    ):
        cells = table[f"{pair}, {kind}"]
        new, old = missed[kind.split(",")[0]], [METHODS[name] for name in pair.split(" / ")]
        sides = [[count / 200 for count in new[name].values()] for name in old]
        assert cells[2] == " and ".join(f"{np.mean(side):.2%}" for side in sides)
        ratio = bootstrapped(*sides, paired=False)
        assert numbers(cells[3])[0] == pytest.approx(ratio[0], abs=0.00501)
        assert numbers(cells[3])[1:] == pytest.approx(ratio[1:], rel=0.05)
        ps.append(by_sampled_deals(*sides))
        error = math.sqrt(ps[-1] * (1 - ps[-1]) / 20_000)
        assert float(cells[4]) == pytest.approx(ps[-1], abs=0.001 + 4 * error)
        before = []
        for name in old:
            lost = [200 * (1 - share) for share in success(f"ddpg-{name}").values()]
            hits = collisions(f"ddpg-{name}")
            late = [all_lost - hit for all_lost, hit in zip(lost, hits, strict=True)]
            before.append(
                {"failures": lost, "collisions": hits, "out of time": late}[kind.split(",")[0]]
            )
        whole = [
            np.mean([*side, *(count / 200 for count in ten)])
            for side, ten in zip(sides, before, strict=True)
        ]
        assert numbers(cells[6])[0] == pytest.approx(whole[0] / whole[1], abs=0.00501)
    for (pair, kind), p in zip(
        (("MPFA-PER / uniform", "failures, secondary"), ("PER / uniform", "failures, secondary")),
        in_steps(ps[1:3]),
        strict=True,
    ):
        assert float(table[f"{pair}, {kind}"][5]) == pytest.approx(p, abs=0.005)
