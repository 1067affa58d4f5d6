"""The page of the paper's tables: rows that are kept, numbers made of them, commands."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.paper import __main__ as command
from benchmarks.paper import figures
from benchmarks.paper.answers import answers
from benchmarks.paper.page import missing_runs, missing_table, question_text, write_page
from benchmarks.paper.published import NAMES
from benchmarks.paper.rows import Rows, keep, keep_time, read_rows
from benchmarks.paper.runs import CLAIMS, comparisons, question, without
from benchmarks.paper.tables import comparison_table, difference, measures
from tests.integration.tiny_runs import tiny, train
from training import files, statistics
from training.comparison.jobs import Job
from training.records import write_table
from training.settings.train import GROUPS, Stage

ROOT = Path(__file__).resolve().parents[2]


def made_up(folder: Path, successes: dict[str, list[float]]) -> Rows:
    """Write rows of runs whose shares of success are given, by arm; return them."""
    rng = np.random.default_rng(0)
    tests, trained = [], []
    for arm, shares in successes.items():
        for seed, share in enumerate(shares, start=100):
            reached = np.arange(200) < round(200 * share)
            tests.append(
                pd.DataFrame(
                    {
                        "arm": arm,
                        "seed": seed,
                        "episode": np.arange(200),
                        "success": reached.astype(int),
                        "collision": 1 - reached.astype(int),
                        "spl": 0.8,
                        "time_s": rng.uniform(10.0, 30.0, 200),
                    }
                )
            )
            episodes = pd.DataFrame(
                {
                    "arm": arm,
                    "seed": seed,
                    "world": list("AAABBBCCCDDD"),
                    "steps": 100,
                    "total_steps": np.arange(1, 13) * 2500,
                    "reward": rng.normal(size=12),
                    "success": 1,
                    "collision": 0,
                }
            )
            trained.append(episodes)
    folder.mkdir(parents=True, exist_ok=True)
    pd.concat(trained).to_csv(folder / "episodes.csv.gz", index=False)
    pd.concat(tests).to_csv(folder / "tests.csv.gz", index=False)
    return read_rows(folder)


@pytest.mark.usefixtures("reconstructed")
def test_comparisons_ask_for_every_run_that_is_planned() -> None:
    planned = [job for each in comparisons(Path("runs/paper")) for job in each.jobs]
    assert len({job.path for job in planned}) == len(planned) == 130 + 30 + 15 + 6
    assert set(NAMES) <= set(GROUPS["method"])
    first = comparisons(Path("runs/paper"), range(100, 105))
    assert sum(len(each.jobs) for each in first) == 65 + 15 + 15 + 6


def test_kept_runs_are_not_asked_for_again() -> None:
    for comparison in comparisons(Path("runs/paper")):
        kept = {job.name for job in comparison.jobs[::3]}
        left = [job for part in without(comparison, kept) for job in part.jobs]
        assert {job.path for job in left} == {
            job.path for job in comparison.jobs if job.name not in kept
        }
        assert len(left) == len(comparison.jobs) - len(kept)


def test_every_planned_run_that_is_kept_has_two_hundred_tests_and_its_episodes() -> None:
    rows = read_rows(ROOT / "docs/results/paper")
    assert rows.tests.groupby(["arm", "seed"]).size().eq(200).all()
    assert rows.curves.groupby(["arm", "seed"]).ngroups == len(rows.runs)
    for arm in rows.tests["arm"].unique():
        for episodes in rows.episodes(arm).values():
            assert len(episodes) >= (100 if "phi" in arm else 1000)
    planned = {job.name for comparison in comparisons(Path()) for job in comparison.jobs}
    assert rows.runs <= planned
    new = read_rows(ROOT / "docs/results/paper/question")
    assert new.runs <= {job.name for job in question(Path()).jobs}
    assert new.tests.groupby(["arm", "seed"]).size().eq(200).all()
    for arm in new.tests["arm"].unique():
        assert all(len(episodes) >= 1000 for episodes in new.episodes(arm).values())
    assert rows.runs.isdisjoint(missing_runs(rows))


def test_page_is_that_of_the_kept_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, alike = figures.finish, {f"figure_{number}" for number in (9, 10, 11)}

    def draw(figure: Any, axes: Sequence[Any], path: Path) -> None:
        """Draw one of the figures that are made alike, which takes longer than their lines."""
        if path.stem not in alike:
            drawn(figure, axes, path)
            return
        assert all(len(axis.get_lines()) >= 2 for axis in axes)
        with Image.open(ROOT / "docs/results/paper" / path.name) as kept:
            assert kept.size == tuple((120 * figure.get_size_inches()).astype(int))
        alike.remove(path.stem)

    monkeypatch.setattr(figures, "finish", draw)
    rows = read_rows(ROOT / "docs/results/paper")
    write_page(rows, tmp_path / "docs/results/paper.md", tmp_path / "docs/results/paper")
    made = (tmp_path / "docs/results/paper.md").read_text(encoding="utf-8")
    assert made == (ROOT / "docs/results/paper.md").read_text(encoding="utf-8")
    pictures = [*(tmp_path / "docs/results/paper").glob("*.png")]
    assert len(pictures) == 4 and not alike
    for path in pictures:
        with (
            Image.open(path) as picture,
            Image.open(ROOT / "docs/results/paper" / path.name) as kept,
        ):
            assert picture.size == kept.size
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 20


def test_five_seeds_are_compared_by_their_means(tmp_path: Path) -> None:
    rows = made_up(tmp_path, {"ddpg-per": [0.5] * 5, "ddpg-mpfa_per": [0.9] * 5})
    made = difference(measures(rows), "ddpg-mpfa_per", "ddpg-per")
    assert made is not None
    assert made.p == pytest.approx(2 / 252)
    table = comparison_table(
        measures(rows),
        [("ddpg-mpfa_per", "ddpg-per"), ("ddpg-mpfa_per", "ddpg-mw")],
        {"ddpg-mpfa_per": 0.905, "ddpg-per": 0.855},
    )
    assert (
        "| MPFA-PER − PER | 0.66 | 0.20 | +5.0 | +40.0 [+40.0, +40.0] | 0.008 | 0.016 |  | 5 |"
        in table
    )
    assert "| MPFA-PER − MW-MADDPG† |  |  |  |  |  |  |  |  |" in table


@pytest.mark.parametrize(
    ("gap", "sentences"),
    [
        (0.05, ["MPFA-PER fails less often than PER", "points lies inside our", "(2 of 11)"]),
        (0.0, ["no step of", "was not established", "lies outside of our", "find one point"]),
        (-0.05, ["no step of", "MPFA-PER fails more often", "lies outside of our interval"]),
    ],
)
def test_answers_say_where_the_ratio_of_the_paper_lies(
    tmp_path: Path, gap: float, sentences: list[str]
) -> None:
    noise = [0.01, -0.01] * 5
    arms = {f"ddpg-{name}": [0.85] * 10 for name in NAMES}
    arms["ddpg-mpfa_per"] = [0.85 + gap + each for each in noise]
    rows = made_up(tmp_path, arms)
    made = answers(rows, measures(rows), decided=False)
    text = str(made)
    for sentence in sentences:
        assert sentence in text
    assert "with more training steps than MPFA-PER, in the mean', '5 of 5', '0 of 5')" in text
    assert "of the paper's order of the methods† is confirmed." in text


def asked(folder: Path, shares: dict[str, list[float]]) -> Rows:
    """Write rows of the question's runs, and return them."""
    rows = made_up(folder, {f"ddpg-{name}": runs for name, runs in shares.items()})
    tests = rows.tests.assign(seed=rows.tests["seed"] + 10)
    tests.to_csv(folder / "tests.csv.gz", index=False)
    return read_rows(folder)


def test_question_with_a_run_missing_says_nothing_of_its_results(tmp_path: Path) -> None:
    table = measures(made_up(tmp_path / "ten", {f"ddpg-{name}": [0.9] * 10 for name in CLAIMS}))
    shares = {"mpfa_per": [0.99] * 36, "per": [0.5] * 36, "uniform": [0.5] * 35}
    text = question_text(asked(tmp_path / "new", shares), table)
    assert text == [
        "The planned test of MPFA-PER against PER waits for 1 of its 108 runs.",
        "107 of 108 runs are kept. None was looked at.",
    ]


def test_question_with_all_runs_compares_failures_of_new_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(statistics, "_PERMUTATIONS", 5_000)
    noise = np.resize([0.01, -0.01], 36)
    ten = {"ddpg-mpfa_per": [0.95] * 10, "ddpg-per": [0.95] * 10, "ddpg-uniform": [0.9] * 10}
    shares = {
        "mpfa_per": list(0.96 + noise),
        "per": list(0.92 + noise),
        "uniform": list(0.92 + noise[::-1]),
    }
    rows = asked(tmp_path / "new", shares)
    said, table, power = question_text(rows, measures(made_up(tmp_path / "ten", ten)))
    assert "In 36 new seeds MPFA-PER fails 0.50 times as often as PER, and the planned" in said
    assert "test does find a difference, p = 0.000." in said
    assert "The paper's 0.66 lies outside of it, but" in said
    assert "and PER fails 1.00 times as often (corrected p = 1.000)." in said
    assert said.endswith(
        "in those by the time limit no difference was found (exploratory, uncorrected)."
    )
    primary, second, third, collisions, late, *_ = table.splitlines()[2:]
    start = "| MPFA-PER / PER, failures, primary | 0.66 | 4.00% and 8.00% | 0.50 [0.4"
    assert primary.startswith(start)
    assert "| MPFA-PER / uniform, failures, secondary |  | 4.00% and 8.00% | 0.50 [" in second
    # Whatever fails in these rows collides.
    assert collisions.replace("collisions, exploratory", "failures, primary").startswith(start)
    assert (
        "PER, out of time, exploratory |  | 0.00% and 0.00% | nan [nan, nan] | 1.000 |  |" in late
    )
    assert "| 1.00 [" in third
    assert third.split("|")[5:7] == [" 1.000 ", " 1.000 "]
    assert " ".join(power.split()).endswith("chance of 100%, and one of 0.50 with 100%.")
    # 46 runs: (36 x 4 + 10 x 5) / (36 x 8 + 10 x 5).
    assert "| 0.57 [" in primary


def test_missing_seeds_of_an_arm_are_in_a_line_of_their_own() -> None:
    assert missing_table(["a-b-1", "a-b-2", "c-5"]).splitlines()[2:] == [
        "| a-b | 1, 2 |",
        "| c | 5 |",
    ]


def test_page_without_rows_names_the_command_that_makes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        command.main(["--rows", str(tmp_path / "none"), "--output", str(tmp_path)])
    assert "has no rows: python -m benchmarks.paper run makes them" in capsys.readouterr().err
    assert not (tmp_path / "paper.md").exists()


@pytest.mark.parametrize("words", [["run", "--jobs", "0"], ["paint"]])
def test_command_line_that_makes_no_sense_is_rejected(words: list[str]) -> None:
    with pytest.raises(SystemExit) as error:
        command.main(words)
    assert error.value.code == 2


@pytest.mark.slow
def test_rows_of_a_finished_run_are_kept_once_with_its_time(tmp_path: Path) -> None:
    comparison = comparisons(tmp_path / "runs", (100,))[0]
    job: Job = next(job for job in comparison.jobs if job.method == "per")
    settings = tiny("per", [Stage(world, 1) for world in "ABCD"])
    settings.evaluation.every, settings.evaluation.episodes = 10, 1
    train(job.path, settings)
    rows, planned = tmp_path / "rows", comparisons(tmp_path / "runs")
    assert keep(planned, rows) == []
    tested = job.results(comparison.evaluation)
    tested.mkdir()
    write_table(
        pd.DataFrame(
            {
                "episode": range(200),
                "world": "test",
                "success": [True] * 150 + [False] * 50,
                "collision": [False] * 150 + [True] * 50,
                "spl": 0.51234,
                "time_s": 12.34,
            }
        ),
        tested / files.EPISODES,
    )
    said = {
        "words": ["test"],
        "episodes": 200,
        "seed": 0,
        "physics": job.physics(comparison.evaluation),
    }
    said["sha256"] = files.digest(job.path / files.POLICY)
    (tested / files.SETTINGS).write_text(json.dumps(said))
    assert keep(planned, rows) == ["ddpg-per-100"]
    kept = read_rows(rows)
    assert kept.runs == {"ddpg-per-100"}
    assert kept.tests["success"].mean() == 0.75
    assert kept.tests["spl"].unique().tolist() == [0.512]
    assert len(kept.curves)
    before = {path.name: path.read_bytes() for path in rows.iterdir()}
    assert set(before) == {"tests.csv.gz", "curves.csv.gz", "episodes.csv.gz"}
    assert keep(planned, rows) == []
    # As after a kill: the tests, which are written last, say which runs are kept.
    (rows / "tests.csv.gz").unlink()
    assert keep(planned, rows) == ["ddpg-per-100"]
    assert {path.name: path.read_bytes() for path in rows.iterdir()} == before
    assert [len(run) for run in read_rows(rows).episodes("ddpg-per").values()] == [4]
    keep_time(job, rows)
    keep_time(job, rows)
    assert read_rows(rows).times["minutes"].between(0.0, 5.0).tolist() == [True]
