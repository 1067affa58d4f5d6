"""Training of MPFA-PER, PER and uniform replay, compared seed by seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import convergence
from benchmarks.paper.looks import looks
from benchmarks.paper.rows import FOLDER, QUESTION, read_rows
from benchmarks.paper.runs import CLAIMS

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def found() -> convergence.Trained:
    rows = ROOT / FOLDER
    return convergence.trained(read_rows(rows), read_rows(rows / QUESTION))


def test_measures_of_a_run_are_those_of_its_kept_episodes(found: convergence.Trained) -> None:
    episodes = pd.read_csv(ROOT / FOLDER / QUESTION / "episodes.csv.gz")
    episodes = episodes[(episodes["arm"] == "ddpg-mpfa_per") & (episodes["seed"] == 112)]
    row = found["mpfa_per"].loc[112]
    assert row["steps of the training"] == episodes["total_steps"].max()
    assert row["reward per step"] == pytest.approx(
        episodes["reward"].sum() / episodes["steps"].sum()
    )
    last = episodes.groupby("world")["success"].mean()["D"]
    assert row["success in training, world D"] == pytest.approx(last)


def test_page_has_the_table_of_46_seeds(found: convergence.Trained) -> None:
    assert {name: len(runs) for name, runs in found.items()} == dict.fromkeys(CLAIMS, 46)
    page = (ROOT / "docs/results/paper.md").read_text(encoding="utf-8")
    assert convergence.convergence_table(found) in page


def test_sentence_names_only_differences_that_survive_the_correction() -> None:
    rng = np.random.default_rng(0)
    runs = pd.DataFrame({name: rng.normal(size=20) for name in convergence.MEASURES})
    better = runs.assign(**{"reward per step": runs["reward per step"] + 3.0})
    said = convergence.said({"mpfa_per": better, "per": better, "uniform": runs})
    assert said == (
        "In the training of 20 seeds MPFA-PER shows no difference from PER and differs from "
        "uniform in reward per step (exploratory)."
    )


def test_page_has_the_six_earlier_looks() -> None:
    page = (ROOT / "docs/results/paper.md").read_text(encoding="utf-8")
    table = next(text for text in looks() if text.startswith("|"))
    assert table in page
    rows = [("73.3 %", "89.7 %", "91.0 %"), ("94.8 %", "97.0 %", "93.8 %")]
    for row in [*rows, ("97.0 %", "97.8 %", "95.7 %")]:
        assert " | ".join(row) in table
        changes = (ROOT / "docs/results/study.md").read_text(encoding="utf-8")
        assert " | ".join(row) in changes
