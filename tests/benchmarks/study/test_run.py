"""The study: its tables as data, its commands, and that it goes on where it was stopped."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

import compare
from benchmarks.study import run as study
from benchmarks.study.designs import tables
from benchmarks.study.kept_rows import read_kept
from benchmarks.study.protocol import FIRST_SEED, VOLUMES, Table, label_of
from benchmarks.study.remaining import counts, hours_left, parts_left
from tests.integration.comparison.test_compare import InThisProcess
from tests.integration.tiny_runs import OVERRIDES
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods.assembly import unused_settings
from torchrl_mpfa.methods.catalogue import check_ranges
from training import figures, files
from training.comparison import execution
from training.comparison.arms import Arm, with_defaults
from training.comparison.jobs import Comparison, Evaluation
from training.settings.command_line import composed
from training.settings.train import TrainSettings, register
from training.worlds import parse_worlds

ROOT = Path("runs/study")


def every_comparison() -> list[Comparison]:
    return [each for table in tables(ROOT).values() for each in table.comparisons]


def test_the_tables_have_the_runs_that_were_planned() -> None:
    arms = {
        name: {label_of(job, ROOT) for each in table.comparisons for job in each.jobs}
        for name, table in tables(ROOT).items()
    }
    assert list(arms) == ["C", "D", "A", "B", "L", "I", "J", "H", "K"]
    assert {name: len(labels) for name, labels in arms.items()} == {
        **{
            "C": 25 + 8 + 1,
            "D": 3 + 6 + 6 + 4,
            "A": 13 + 3 + 1 + 3,
            "B": 2 * 8,
            "L": 6,
            "I": 5,
            "J": 3 + 1,
            "H": 12,
            "K": 2,
        }
    }
    # Volume 32 of D are arms of C.
    assert {"sparse/td3/lap", "sparse/td3/geometric"} <= arms["C"] & arms["D"]
    assert not arms["B"] & arms["D"]


def test_every_comparison_is_of_arms_that_are_run() -> None:
    for table in tables(ROOT).values():
        labels = {label_of(job, ROOT) for each in table.comparisons for job in each.jobs}
        pairs = [*table.planned, *table.explored]
        assert len(set(pairs)) == len(pairs) > 0
        for pair in pairs:
            assert set(pair) <= labels, (table.name, pair)
            assert pair[0] != pair[1]
            assert (pair[1], pair[0]) not in pairs
        shown = {label for panel in table.panels.values() for label in panel}
        assert shown <= labels
        assert {label for pair in table.planned for label in pair} <= shown


def test_the_primary_comparisons_of_sparse_rewards_are_the_six_that_were_planned() -> None:
    table = tables(ROOT)["C"]
    short = [tuple(label.removeprefix("sparse/td3/") for label in pair) for pair in table.planned]
    assert short == [
        ("per", "uniform"),
        ("mpfa_per", "uniform"),
        ("mpfa_per", "per"),
        ("mpfa_plus", "per"),
        ("mpfa_plus", "mpfa_per"),
        ("mpf_per", "per"),
    ]
    # Each of 23 other methods against two, less the four that are planned, and one control; DDPG's;
    # LAP by its median against three.
    assert len(table.explored) == 2 * 23 - 4 + 1 + 9 + 3


def test_the_order_of_the_paper_is_compared_neighbor_by_neighbor() -> None:
    short = [
        "-".join(label.removeprefix("paper/ddpg/") for label in pair)
        for pair in tables(ROOT)["A"].planned
    ]
    assert short[:6] == [
        *("mpfa_per-mpf_per", "mpf_per-raise", "raise-decay", "decay-td_reward"),
        *("td_reward-td_loss", "td_loss-per"),
    ]
    # Equal success: the faster one is the better one.
    assert short[6:] == [
        *("mpfa_per-klper", "klper-ddpg_radam", "ddpg_radam-mw", "mw-hvper"),
        "hvper-averaged_ddpg",
    ]


def test_the_method_of_every_arm_is_accepted() -> None:
    found = set()
    for each in every_comparison():
        for job in each.jobs:
            words = [w for w in job.overrides(each.settings) if w.startswith("method")]
            found.add(tuple(words))
    for words in found:
        given = OmegaConf.to_object(OmegaConf.from_dotlist(list(words[1:]))) if words[1:] else {}
        method = replace(METHODS[words[0].removeprefix("method=")], **given.get("method", {}))
        check_ranges(method)
        assert not list(unused_settings(method)), words
    assert len(found) > len(METHODS)


def test_no_two_studies_want_other_settings_of_one_run() -> None:
    wanted: dict[Path, list[str]] = {}
    for each in every_comparison():
        for job in each.jobs:
            asked = job.overrides(each.settings)
            assert wanted.setdefault(job.path, asked) == asked, job.path


def test_the_seeds_of_the_tables_were_used_for_no_choice() -> None:
    seeds = {seed for each in every_comparison() for seed in each.seeds}
    assert min(seeds) == FIRST_SEED and max(seeds) < 1000


def test_fewer_seeds_are_the_first_ones_of_every_arm() -> None:
    for name, table in tables(ROOT, most=2).items():
        assert {tuple(each.seeds) for each in table.comparisons} == {(100, 101)}, name
    with pytest.raises(ValueError, match="most must be at least 1, got 0"):
        tables(ROOT, most=0)


def test_the_commands_are_understood_as_they_were_meant(monkeypatch: pytest.MonkeyPatch) -> None:
    for words in {each.evaluation.words for each in every_comparison()}:
        parse_worlds(words)
    # That takes a second, and is done.
    monkeypatch.setattr(compare, "parse_worlds", list)
    for each in every_comparison():
        options = compare.parse(shlex.split(each.command)[2:])
        assert tuple(options.arms) == each.arms
        assert tuple(options.overrides) == each.settings
        assert tuple(options.worlds) == each.evaluation.words
        assert options.physics == each.evaluation.physics
        read = Comparison(
            options.folder,
            tuple(options.methods),
            tuple(options.overrides),
            options.seeds,
            tuple(options.learners),
            tuple(options.arms),
        )
        assert read.jobs == each.jobs


def settings_of(table: Table, label: str) -> TrainSettings:
    register()
    for each in table.comparisons:
        for job in each.jobs:
            if label_of(job, ROOT) == label:
                (found,) = composed(job.overrides(each.settings))
                return found
    raise AssertionError(label)


@pytest.mark.parametrize("volume", [8, 32, 128, 256])
def test_a_replay_volume_is_what_it_says(volume: int) -> None:
    suffix = "" if volume == 32 else f"/v{volume}"
    found = settings_of(tables(ROOT)["D"], f"sparse/td3/per{suffix}")
    assert found.updates * found.method.batch_size / found.robots == volume
    assert found.environment.progress == "none"
    assert VOLUMES[volume]


def test_the_settings_of_each_task_are_those_of_the_design() -> None:
    found = tables(ROOT)
    sparse, dense = (
        settings_of(table, label)
        for table, label in ((found["C"], "sparse/td3/per"), (found["B"], "dense/td3/per"))
    )
    assert (sparse.robots, sparse.updates, sparse.learner.tau, sparse.learner.gamma) == (
        *(16, 2),
        *(0.01, 0.97),
    )
    assert sparse.environment.max_goal_distance == 6.0
    assert sparse.environment.detour_chance == 0.0
    assert (dense.environment.progress, dense.environment.max_goal_distance) == (
        *("shortest_path", 20.0),
    )
    assert (dense.updates, dense.learner.tau, dense.learner.gamma) == (2, 0.005, 0.99)
    lengths = [each.curriculum.stages[0].actions for each in (sparse, dense)]
    assert lengths == [24_000, 40_000]
    # In all else they are alike.
    dense.environment, dense.curriculum = sparse.environment, sparse.curriculum
    dense.learner.tau, dense.learner.gamma = sparse.learner.tau, sparse.learner.gamma
    assert (dense.tracking.group, sparse.tracking.group) == ("dense/td3-per", "sparse/td3-per")
    dense.run_dir, dense.tracking = sparse.run_dir, sparse.tracking
    assert dense == sparse
    assert sparse.evaluation.world == "mixed:validation"
    paper = settings_of(found["A"], "paper/plain/per/letter")
    assert (paper.robots, paper.updates) == (16, 16)
    assert paper.learner.lr_end_factor == 1.0
    assert not paper.environment.mirror and not paper.exploration.varied
    assert with_defaults([]) == ["tracking=off", "evaluation.every=5000"]


@pytest.mark.slow
def test_every_arm_of_every_table_can_be_trained() -> None:
    register()
    for each in every_comparison():
        for job in each.jobs:
            if job.seed == FIRST_SEED:
                job.asked(each.settings)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two tables that share an arm, of runs that take no second."""
    settings = (*OVERRIDES, "curriculum.stages=[{world: A, episodes: 2}]")
    settings += ("evaluation.every=10", "evaluation.episodes=1", "evaluation.world=A")

    def two(root: Path, *, most: int | None = None) -> dict[str, Table]:
        worlds = Evaluation(("B",), 2)
        seeds = range(100, 102)[:most]
        of = {
            "C": Comparison(root / "s", ("per", "uniform"), settings, seeds, evaluation=worlds),
            "D": Comparison(root / "s", ("per",), settings, seeds, evaluation=worlds),
        }
        return {name: Table(name, "Why?", (each,), (), (), {}) for name, each in of.items()}

    monkeypatch.setattr(study, "tables", two)
    monkeypatch.setattr(execution, "LocalWorker", InThisProcess)
    monkeypatch.setattr(execution, "_PAUSE", 0.0)
    monkeypatch.setattr(figures, "plot_learning_curve", lambda *_: None)
    return tmp_path


def test_a_study_makes_what_is_missing_and_trains_no_arm_twice(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ["--folder", str(small)]
    assert study.main([*folder, "D", "--seeds", "1"]) == 0
    assert "D: 1 of 1 runs" in capsys.readouterr().out
    policy = small / "s" / "ddpg-per-100" / files.POLICY
    before = policy.stat().st_mtime_ns
    assert study.main(folder) == 0
    said = capsys.readouterr().out
    assert "C, D: 1 of 4 runs, about" in said
    assert said.rstrip().endswith("C, D: 4 of 4 runs")
    # D had nothing left to do once C was done.
    assert said.count("compare.py --folder") == 1
    assert policy.stat().st_mtime_ns == before
    assert not list(small.rglob(files.CHECKPOINT))
    study.main([*folder, "--list", "D"])
    listed = capsys.readouterr().out
    assert "Why?  2 of 2 runs" in listed
    assert "--methods per --seeds 100 101 --worlds B --episodes 2" in listed


def test_runs_that_are_kept_are_not_made_again(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = small / "kept"
    study.main(["--folder", str(small / "one"), "D", "--seeds", "1"])
    study.main(["--folder", str(small / "one"), "--keep", str(kept), "D"])
    assert {path.name for path in kept.iterdir()} == {"D-curves.csv.gz", "D-tests.csv.gz"}
    # On another machine, whose runs are in another folder.
    there = ["--folder", str(small / "two"), "--kept", str(kept)]
    study.main([*there, "--list"])
    listed = capsys.readouterr().out
    assert "--methods uniform --seeds 100 101 " in listed and "--methods per --seeds 101 " in listed
    assert "Why?  0 of 3 runs" in listed and "Why?  0 of 1 runs" in listed
    assert study.main(there) == 0
    made = {path.parent.name for path in (small / "two").rglob(files.POLICY)}
    assert made == {"ddpg-per-101", "ddpg-uniform-100", "ddpg-uniform-101"}
    study.main(["--folder", str(small / "two"), "--keep", str(kept)])
    capsys.readouterr()
    # C has what D kept of the arm that they share.
    study.main([*there, "--list"])
    assert capsys.readouterr().out.count("Why?  0 of 0 runs") == 2
    rows = read_kept(kept, "C")
    assert set(rows.curves[["arm", "seed"]].itertuples(index=False, name=None)) == {
        (f"s/ddpg/{method}", seed) for method in ("per", "uniform") for seed in (100, 101)
    }


def test_the_parts_of_a_study_that_are_left_have_the_missing_runs_and_no_others() -> None:
    arms = (Arm("", ()), Arm("wide", ("learner.width=128",)))
    whole = Comparison(ROOT, ("per", "uniform", "lap"), (), range(4), ("td3", "ddpg"), arms)
    rng = np.random.default_rng(0)
    missing = [job for job in whole.jobs if rng.random() < 0.6]
    parts = parts_left(whole, missing)
    made = [job for part in parts for job in part.jobs]
    assert sorted(made, key=str) == sorted(missing, key=str)
    assert parts_left(whole, whole.jobs) == [
        replace(whole, learners=(learner,), seeds=(0, 1, 2, 3)) for learner in ("td3", "ddpg")
    ]
    assert parts_left(whole, []) == []


def test_a_study_stops_where_a_signal_stopped_its_runs(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def stopped(wanted: Comparison, *, most: int) -> int:
        asked.append(most)
        return 130

    monkeypatch.setattr(study, "make_runs", stopped)
    assert study.main(["--folder", str(small), "--jobs", "3"]) == 130
    assert asked == [3]


def test_a_failed_run_does_not_keep_the_other_tables_from_theirs(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    statuses = iter([1, 0])
    monkeypatch.setattr(study, "make_runs", lambda *_, **__: next(statuses))
    assert study.main(["--folder", str(small)]) == 1
    assert next(statuses, None) is None


def test_what_is_left_is_told_by_the_time_that_runs_took(small: Path) -> None:
    wanted = [each for table in study.tables(small).values() for each in table.comparisons]
    assert hours_left(wanted, jobs=2) is None
    study.main(["--folder", str(small), "D", "--seeds", "1"])
    assert counts(wanted) == (1, 4)
    run = small / "s" / "ddpg-per-100"
    rows = "total_steps,seconds,trained_for\n20,10,100\n40,20,1000\n"
    (run / files.EVALUATIONS).write_text(rows)
    # 1,030 s and the evaluation's, of which there are three more.
    assert hours_left(wanted, jobs=2) == pytest.approx(3 * 1030 / 2 / 3600, rel=0.1)
    assert hours_left(wanted, jobs=1) == pytest.approx(3 * 1030 / 3600, rel=0.1)
    # To be tested somewhere else takes no training.
    elsewhere = replace(wanted[1], seeds=range(100, 101), evaluation=Evaluation(("A",), 2))
    assert counts([elsewhere]) == (0, 1)
    assert counts([*wanted, elsewhere]) == (0, 4)
    more = hours_left([*wanted, elsewhere], jobs=1)
    assert more is not None and 3 * 1030 < 3600 * more < 3 * 1030 + 300
