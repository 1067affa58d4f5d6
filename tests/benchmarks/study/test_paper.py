"""The paper's figures and tables, from runs of a smoke size and from rows that are made up."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import compare
from benchmarks.study import paper_report as report
from benchmarks.study.paper import (
    NAMES,
    PHIS,
    TABLE_2,
    TABLE_4,
    comparisons,
    evaluation_of,
    missing,
    read_runs,
)
from benchmarks.study.paper_figures import plot_claims, reward_of_blocks
from benchmarks.study.paper_tables import trained_table, unseen_table
from tests.integration.test_figures import colored, heights
from tests.integration.tiny_runs import tiny, train
from training import files
from training.comparison.jobs import Job
from training.records import write_table
from training.settings.train import GROUPS, Stage

FIGURES = ["claims", *(f"figure_{n}" for n in (3, 5, 8, 9, 10, 11, 13))]


def say_tested(job: Job, **other: object) -> None:
    """Say of the rows of a run that they are those of its policy, in the unseen world."""
    said: dict[str, object] = {"words": ["test"], "episodes": 200, "seed": 0, "physics": "wheels"}
    said["sha256"] = files.digest(job.path / files.POLICY)
    (job.path / "evaluation-test-wheels" / "settings.json").write_text(
        json.dumps({**said, **other})
    )


@pytest.fixture(scope="session")
def paper_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of every name in the paper, some of which were tested."""
    folder = tmp_path_factory.mktemp("paper")
    first, second = comparisons(folder, seeds=1)
    for name, (job,) in {**first.runs(), **second.runs()}.items():
        settings = tiny(
            name if name in NAMES else "mpfa_per", [Stage(world, 1) for world in "ABCD"]
        )
        settings.tracking.log_every = 5
        if name in ("mw", "hvper"):
            continue
        train(job.path, settings)
        if name != "klper":
            tested = {"world": "test", "episode": range(4), "timeout": False, "time_s": 20.0}
            rows = pd.DataFrame({**tested, "success": [True] * 3 + [False]})
            rows["collision"] = ~rows["success"]
            (job.path / "evaluation-test-wheels").mkdir()
            write_table(rows, job.path / "evaluation-test-wheels" / "episodes.csv")
            say_tested(job)
    return folder


@pytest.mark.slow
def test_all_figures_and_tables_are_made_of_what_there_is(
    paper_runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--output", str(tmp_path)]
    assert report.main([str(paper_runs), "--seeds", "1", *out]) == 0
    assert sorted(path.stem for path in tmp_path.glob("*.png")) == sorted(FIGURES)
    for path in tmp_path.glob("*.png"):
        with Image.open(path) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 20
    text = (tmp_path / "paper.md").read_text(encoding="utf-8")
    assert "| MPFA-PER | 19 | 50.0 | 90.5% | 75.0% | 27.3 | 20.0 | 1 |" in text
    assert "| HVPER | 27 |  | 86.5% |  | 34.2 |  | 0 |" in text
    wanted = "3 runs are missing in .*: ddpg-klper-0, ddpg-hvper-0, ddpg-mw-0."
    assert pd.Series([text]).str.contains(wanted).all()
    assert text.strip() in capsys.readouterr().out


def test_the_commands_that_are_named_make_the_runs_that_are_looked_for(tmp_path: Path) -> None:
    for study in comparisons(tmp_path, seeds=2):
        words = shlex.split(study.command)
        assert words[:2] == ["python", "examples/compare.py"]
        options = compare.parse(words[2:])
        made = {
            Job(learner, method, seed, options.folder, arm).path
            for learner in options.learners
            for method in options.methods
            for seed in options.seeds
            for arm in options.arms
        }
        assert made == {job.path for jobs in study.runs().values() for job in jobs}
        assert len(missing(study)) == len(made)
    assert set(NAMES) <= set(GROUPS["method"])


def test_a_run_that_is_not_at_its_end_is_missing_and_in_no_table(tmp_path: Path) -> None:
    first, _ = wanted = comparisons(tmp_path, seeds=1)
    (job,) = first.runs()["per"]
    (job.path / "evaluation-test-wheels").mkdir(parents=True)
    for name in ("updates.csv", "episodes.csv", "evaluation-test-wheels/episodes.csv"):
        write_table(pd.DataFrame({"total_steps": [1]}), job.path / name)
    (job.path / "policy.npz").write_bytes(b"policy")
    say_tested(job)
    for finished in (False, True):
        (job.path / "status.json").write_text(json.dumps({"finished": finished}))
        assert (job.name in missing(first)) != finished
        assert ("per" in read_runs(wanted, lambda job: job.path / "episodes.csv")) == finished
    tested = job.path / "evaluation-test-wheels"
    assert evaluation_of(job) == tested / "episodes.csv"
    # Of other worlds, or by other rules.
    tested.rename(job.path / "evaluation-test+A-wheels")
    assert evaluation_of(job) is None
    (job.path / "evaluation-test+A-wheels").rename(tested)
    for said in ({"episodes": 20}, {"seed": 1}, {"sha256": "of another policy"}):
        say_tested(job, **said)
        assert evaluation_of(job) is None
        assert job.name in missing(first)


def test_a_folder_without_runs_gets_the_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report.main([str(tmp_path)]) == 1
    said = capsys.readouterr().out
    for study in comparisons(tmp_path):
        assert study.command in said
    assert not list(tmp_path.iterdir())


def test_the_paper_says_what_its_text_says_of_its_tables() -> None:
    ours, theirs = TABLE_2["mpfa_per"], TABLE_2["per"]
    assert 1 - ours.collisions / theirs.collisions == pytest.approx(0.3448, abs=1e-4)
    assert 1 - ours.time / theirs.time == pytest.approx(0.1415, abs=1e-4)
    fewer = {"klper": 0.2083, "ddpg_radam": 0.24, "hvper": 0.2963, "averaged_ddpg": 0.3214}
    for name, share in fewer.items():
        assert 1 - ours.collisions / TABLE_4[name].collisions == pytest.approx(share, abs=1e-4)
    assert ours == TABLE_4["mpfa_per"]


def test_tables_have_the_mean_over_runs() -> None:
    first = pd.DataFrame({"success": [True, False], "collision": [False, True], "time_s": [9, 5]})
    second = pd.DataFrame({"success": [True, True], "collision": False, "time_s": [4, 8]})
    line = unseen_table({"per": {"0": first, "1": second}}, {"per": TABLE_2["per"]}).splitlines()[
        -1
    ]
    # One of two, and none: a quarter of 200; 9 s, and the mean of 4 and 8.
    assert line == "| PER | 29 | 50.0 | 85.5% | 75.0% | 31.8 | 7.5 | 2 |"
    runs = {
        str(minutes): pd.DataFrame({"seconds": [3.0, 60.0 * minutes], "total_steps": [5, steps]})
        for minutes, steps in ((2, 1000), (3, 2001))
    }
    assert "| KLPER | 1,284 | 2.5 | 219,318 | 1,500 | 2 |" in trained_table({"klper": runs})


def test_a_block_has_the_rewards_of_its_steps_and_the_last_one_is_whole() -> None:
    steps = np.arange(4, 49, 4)
    rows = pd.DataFrame({"total_steps": steps, "reward": 1.0 * steps})
    found = reward_of_blocks(rows, steps=20)
    assert found.to_dict() == {20: 4 + 8 + 12 + 16 + 20, 40: 24 + 28 + 32 + 36 + 40}


def test_the_claims_have_a_line_for_each_method_where_its_values_are(tmp_path: Path) -> None:
    steps = np.arange(0, 1000, 10)
    flat = {"total_steps": steps, "positive_buffer": 0.5, "positive_batch": 0.5}
    runs = {
        name: {"0": pd.DataFrame({**flat, "td_error_age": slope * steps})}
        for name, slope in (("per", 1.0), ("mpfa_per", 0.2))
    }
    plot_claims(runs, ("per", "mpfa_per"), tmp_path / "claims.png")
    panel = slice(0, 520)
    blue, black = (0, 114, 178), (0, 0, 0)
    high, low = (colored(tmp_path / "claims.png", color)[:, panel] for color in (blue, black))
    assert heights(high, quarter=3) > heights(low, quarter=3) + 0.3


def test_the_phis_of_the_figure_are_the_arms() -> None:
    assert [f"phi{phi}" for phi in PHIS] == [arm.name for arm in comparisons(Path("x"))[1].arms]
