"""Tables and figures of a study, from rows that are made up here."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import report
from aggregates import interquartile_mean, probability_of_improvement, stratified_bootstrap


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Two methods, two seeds, four pairs: the first method fails once, the other always."""
    evaluation = []
    for method, failures in (("mpfa_per", {(1, 3)}), ("per", None)):
        for seed in (0, 1):
            for episode in range(4):
                good = failures is not None and (seed, episode) not in failures
                evaluation.append(
                    {
                        **{"learner": "ddpg", "method": method, "seed": seed, "episode": episode},
                        **{"success": good, "collision": not good, "timeout": False},
                        **{"time_s": 20.0 + seed, "spl": 0.8 * good},
                    }
                )
            folder = tmp_path / f"ddpg-{method}-{seed}"
            training = [
                {"total_steps": 10 * (n + 1), "success": n > 1, "average_reward": 0.1 * n}
                for n in range(5)
            ]
            write(folder / "episodes.csv", training)
            progress = [{"total_steps": 5000, "success": 0.5}, {"total_steps": 9000, "success": 1}]
            write(folder / "progress.csv", progress)
    write(tmp_path / "episodes.csv", evaluation)
    return tmp_path


def test_the_tables_say_what_the_rows_say(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main([str(study)]) == 0
    text = (study / "tables.md").read_text(encoding="utf-8")
    assert text.strip() == capsys.readouterr().out.strip()
    # Seven of eight pairs, of which four took 20 s and three 21 s.
    assert "| ddpg | mpfa_per | 87.5% | 100.0%, 75.0% | 12.5% | 0.0% | 0.700 | 20.4 |" in text
    assert "| ddpg | per | 0.0% | 0.0%, 0.0% | 100.0% | 0.0% | 0.000 |  |" in text
    assert "| paper | MPFA-PER | 90.5% |" in text
    # From zero to 0.5 in 5,000 steps, then to 1 in 4,000: (1250 + 3000) / 9000.
    assert "| ddpg | mpfa_per | 9,000; 9,000 | 0.472 | 0.472, 0.472 |" in text
    assert "| ddpg/mpfa_per > ddpg/per | 0.938 [" in text
    for name in ("training.png", "progress.png"):
        assert (study / name).stat().st_size > 5000


def test_the_figures_may_go_elsewhere(study: Path, tmp_path: Path) -> None:
    assert report.main([str(study), "--output", str(tmp_path / "images")]) == 0
    assert (tmp_path / "images" / "training.png").exists()


def test_a_folder_without_rows_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        report.main([str(tmp_path)])
    assert "has no episodes.csv with rows" in capsys.readouterr().err


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    scores = np.array([[100.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, -100.0]])
    assert interquartile_mean(scores) == pytest.approx((2 + 3 + 4 + 5) / 4)


def test_ties_count_half_in_the_probability_of_improvement() -> None:
    ours, theirs = np.array([[1.0, 5.0]]), np.array([[1.0, 4.0], [2.0, 4.0]])
    # First task: a tie and a loss; second task: two wins.
    assert probability_of_improvement(ours, theirs) == pytest.approx((0.25 + 1.0) / 2)


def test_the_bootstrap_draws_runs_and_keeps_tasks() -> None:
    # Runs agree on each task: whatever runs are drawn, the mean is the same.
    scores = np.array([[0.0, 1.0, 2.0]] * 4)
    rng = np.random.default_rng(0)
    assert stratified_bootstrap(lambda x: float(x.mean()), scores, rng=rng) == (1.0, 1.0)


def test_the_bootstrap_covers_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(200):
        scores = rng.normal(0.3, 1.0, (20, 3))
        low, high = stratified_bootstrap(lambda x: float(x.mean()), scores, rng=rng, draws=200)
        covered += low <= 0.3 <= high
    # 95 % but for the narrowness of twenty runs: 200 trials vary by 3 %.
    assert 0.86 <= covered / 200 <= 0.99
