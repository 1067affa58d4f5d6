"""Pages and figures of the study, from runs that are made up and from rows that are kept."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.study import pages as study_pages
from benchmarks.study import report
from benchmarks.study import run as study
from benchmarks.study.designs import paper_comparisons, tables
from benchmarks.study.figures import (
    plot_study,
)
from benchmarks.study.kept_rows import joined, keep, of_arms, read_all_kept, read_kept
from benchmarks.study.paper import NAMES, PHIS
from benchmarks.study.permutation import deal_p
from benchmarks.study.protocol import Table
from benchmarks.study.rows import (
    Rows,
    missing,
    read_runs,
    scores_of,
    worlds_of,
)
from benchmarks.study.tables import arm_lines, comparison_lines, study_tables
from training import files
from training.comparison.arms import Arm
from training.comparison.jobs import Comparison, Evaluation, Job
from training.records import write_table

TEST = Evaluation(("bars:test", "halls:test"), 4, "wheels")
PAIRS = (("s/td3/per", "s/td3/uniform"), ("s/td3/uniform/wide", "s/td3/uniform"))


def small_table(root: Path, *, seeds: int = 4) -> Table:
    """Three arms, one of them by a name of its own."""
    plain = Comparison(
        root / "s", ("uniform", "per"), ("robots=2",), range(seeds), ("td3",), evaluation=TEST
    )
    wide = Arm("wide", ("learner.width=128",))
    other = Comparison(root / "s", ("uniform",), (), range(seeds), ("td3",), (wide,), TEST)
    arms = tuple(dict.fromkeys(label for pair in PAIRS for label in pair))
    return Table(
        *("C", "Which?", (plain, other), PAIRS[:1], PAIRS[1:], {"all": arms}), kinds=TEST.words
    )


def write_run(job: Job, heights: Sequence[float], outcomes: Sequence[Sequence[bool]]) -> None:
    """A run as training and evaluation leave it behind, as far as the study reads it."""
    folder = job.results(TEST)
    folder.mkdir(parents=True)
    (job.path / files.STATUS).write_text(json.dumps({"finished": True}))
    (job.path / files.POLICY).write_bytes(b"policy")
    (job.path / files.EPISODES).write_text("success,world\n")
    curve = {"total_steps": 1000 * np.arange(1, len(heights) + 1), "success": heights}
    write_table(pd.DataFrame(curve), job.path / files.EVALUATIONS)
    rows = [
        {
            **{"episode": number, "success": good, "collision": not good and number == 0},
            **{"spl": 0.123456 * good, "time_s": 12.345, "world": f"{kind}-test-{number}"},
        }
        for kind, of_kind in zip(("bars", "halls"), outcomes, strict=True)
        for number, good in enumerate(of_kind)
    ]
    write_table(pd.DataFrame(rows), folder / files.EPISODES)
    asked = {"words": list(TEST.words), "episodes": TEST.episodes, "physics": TEST.physics}
    asked["sha256"] = files.digest(job.path / files.POLICY)
    (folder / files.SETTINGS).write_text(json.dumps(asked))


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Four runs of each arm; PER is better by as much in each seed."""
    root = tmp_path / "runs"
    for each in small_table(root).comparisons:
        for job in each.jobs:
            first = 0.1 * job.seed + 0.4 * (job.method == "per")
            outcomes = [[job.seed > 0] * 4, [True, True, job.method == "per", False]]
            write_run(job, [first, first + 0.2], outcomes)

    def one(folder: Path, *, most: int | None = None) -> dict[str, Table]:
        return {"C": small_table(folder)}

    monkeypatch.setattr(study, "tables", one)
    monkeypatch.setattr(study_pages, "tables", one)
    yield root


def test_the_measures_of_a_run_are_those_of_its_rows(runs: Path) -> None:
    table = small_table(runs)
    scores = scores_of(read_runs(table, runs), table)
    assert list(scores) == ["s/td3/uniform", "s/td3/per", "s/td3/uniform/wide"]
    per = scores["s/td3/per"]
    # From zero to 0.7 and to 0.9: half of each step and the mean of both.
    assert per.loc[3, "area"] == pytest.approx((0.35 + 0.8) / 2)
    assert per["actions"].tolist() == [np.inf, np.inf, np.inf, 2000]
    # Of two kinds, one whole or not at all and the other three of four.
    assert per["success"].tolist() == pytest.approx([0.375, 0.875, 0.875, 0.875])


def test_kinds_of_worlds_count_the_same_and_a_run_that_lacks_one_has_no_success() -> None:
    table = small_table(Path("x"))
    curve = pd.DataFrame({"arm": "a", "seed": [0, 1], "total_steps": 10, "success": 1.0})
    worlds = ["bars-test-1", "halls-test-1", "halls-test-2", "halls-test-3", "bars-test-1"]
    good = [True, False, False, False, True]
    tests = pd.DataFrame({"arm": "a", "seed": [0, 0, 0, 0, 1], "world": worlds, "success": good})
    tests["episode"] = 0
    found = scores_of(Rows(curve, tests), table)["a"]["success"]
    assert found[0] == 0.5
    assert np.isnan(found[1])


def test_of_one_world_the_pairs_are_what_else_might_have_been_tested() -> None:
    seeds, pairs = np.divmod(np.arange(3 * 50), 50)
    good = np.random.default_rng(0).uniform(size=150) < 0.6
    tests = pd.DataFrame({"arm": "a", "seed": seeds, "episode": pairs, "success": good})
    table = tables(Path("x"))["A"]
    found = worlds_of(Rows(pd.DataFrame(), tests.assign(world="test")), table)["a"]
    assert found.to_numpy().tolist() == good.reshape(3, 50).tolist()
    # In as many worlds with several pairs, a world is one.
    worlds = tests.assign(world=[f"bars-test-{pair // 5}" for pair in pairs])
    bars = replace(table, kinds=("bars:test",))
    found = worlds_of(Rows(pd.DataFrame(), worlds), bars)["a"]
    assert found.to_numpy() == pytest.approx(good.reshape(3, 10, 5).mean(axis=2))


def test_what_is_kept_comes_back_and_is_the_same_bytes_each_time(
    runs: Path, tmp_path: Path
) -> None:
    rows = read_runs(small_table(runs), runs)
    paths = keep(rows, tmp_path / "a", "C")
    again = read_kept(tmp_path / "a", "C")
    for mine, theirs in ((again.curves, rows.curves), (again.tests, rows.tests)):
        in_order = theirs.sort_values(["arm", "seed"], kind="stable", ignore_index=True)
        pd.testing.assert_frame_equal(mine, in_order, check_dtype=False)
    assert len(rows.tests) == 3 * 4 * 8 and len(rows.curves) == 3 * 4 * 2
    assert not rows.tests["collision"].all() and rows.tests["collision"].any()
    for path, other in zip(paths, keep(again, tmp_path / "b", "C"), strict=True):
        assert path.read_bytes() == other.read_bytes()
    # No name and no date of the file.
    assert paths[0].read_bytes()[3:8] == bytes(5)
    assert not len(read_kept(tmp_path / "a", "D").curves)


def halves(rows: Rows, *, by: int) -> tuple[Rows, Rows]:
    """The rows of seeds below a number, and of the others."""
    below, above = (
        Rows(
            rows.curves[(rows.curves["seed"] < by) == less],
            rows.tests[(rows.tests["seed"] < by) == less],
        )
        for less in (True, False)
    )
    return below, above


def test_rows_are_added_to_those_that_are_kept_in_whatever_order_they_come(
    runs: Path, tmp_path: Path
) -> None:
    rows = read_runs(small_table(runs), runs)
    first, second = halves(rows, by=2)
    whole = keep(rows, tmp_path / "whole", "C")
    for name, parts in (("a", (first, second)), ("b", (second, first)), ("c", (rows, first))):
        for part in parts:
            paths = keep(part, tmp_path / name, "C")
        for path, other in zip(paths, whole, strict=True):
            assert path.read_bytes() == other.read_bytes()


def test_a_run_that_was_made_anew_takes_the_place_of_what_was_kept_once_it_is_tested(
    runs: Path, tmp_path: Path
) -> None:
    rows = read_runs(small_table(runs), runs)
    keep(rows, tmp_path, "C")
    tests = rows.tests.assign(success=~rows.tests["success"])
    anew = Rows(rows.curves.assign(success=0.5), tests)
    one, _ = halves(anew, by=1)
    keep(Rows(one.curves, one.tests[:0]), tmp_path, "C")
    found = read_kept(tmp_path, "C")
    assert found.tests["success"].sum() == rows.tests["success"].sum()
    assert not (found.curves["success"] == 0.5).all()
    keep(one, tmp_path, "C")
    found = read_kept(tmp_path, "C")
    assert len(found.curves) == len(rows.curves) and len(found.tests) == len(rows.tests)
    assert (found.curves.query("seed == 0")["success"] == 0.5).all()
    assert not (found.curves.query("seed != 0")["success"] == 0.5).all()


def test_a_run_that_two_tables_keep_is_read_once(runs: Path, tmp_path: Path) -> None:
    rows = read_runs(small_table(runs), runs)
    first, second = halves(rows, by=2)
    keep(rows, tmp_path, "C")
    keep(first, tmp_path, "D")
    found = read_all_kept(tmp_path)
    assert len(found.curves) == len(rows.curves) and len(found.tests) == len(rows.tests)
    two = of_arms(joined(second, first), {"s/td3/per", "s/td3/uniform/wide"})
    assert set(two.curves["arm"]) == set(two.tests["arm"]) == {"s/td3/per", "s/td3/uniform/wide"}
    assert len(two.curves) == 2 * 4 * 2 and len(two.tests) == 2 * 4 * 8


def test_the_pages_of_the_runs_and_of_what_is_kept_of_them_are_the_same(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "kept"
    assert study.main(["--folder", str(runs), "--keep", str(kept)]) == 0
    assert "C-tests.csv.gz, 0.00 MB" in capsys.readouterr().out
    for folder, output in ((runs, tmp_path / "one"), (kept, tmp_path / "two")):
        assert report.main([str(folder), "--output", str(output)]) == 0
    one, two = ((tmp_path / name / "C.md").read_text("utf-8") for name in ("one", "two"))
    assert one == two
    assert "## Missing" not in one
    figures = {path.name for path in (tmp_path / "one").glob("*.png")}
    assert figures == {"C_curves.png", "C_profiles.png", "C_arms.png"}
    for name in figures:
        with Image.open(tmp_path / "one" / name) as a, Image.open(tmp_path / "two" / name) as b:
            # Kept rows are rounded, by which the edge of a line may be a shade lighter.
            assert np.abs(np.asarray(a, int) - np.asarray(b, int)).max() <= 2
            assert len(a.convert("RGB").getcolors(1 << 24)) > 20


def test_the_page_says_what_the_rows_say(runs: Path) -> None:
    table = small_table(runs)
    text = study_tables(table, read_runs(table, runs), absent="")
    # 0.3 of area more in each of four seeds, which are too few to compare them seed by seed.
    ours, theirs = ([0.35 + 0.075 * n + 0.3 * more for n in range(4)] for more in (1, 0))
    p = float(deal_p(np.array(ours), np.array(theirs)))
    assert f"| {p:.3f} | {p:.3f} |" in next(x for x in text.splitlines() if "| 4, 4 | +0.300" in x)
    assert "| uniform/wide − uniform | 4, 4 | +0.000 |" in text
    assert "| per | 75.0% | 75.0% |" in text
    assert "| uniform | 75.0% | 50.0% |" in text
    # Primary first.
    area, success = (text.index(f"Planned comparisons: {w}") for w in ("primary", "success of"))
    assert area < success
    # Areas of 0.35, 0.425, 0.5 and 0.575.
    assert "| per | 4 | 0.46" in text
    assert "never | 3 of 4 |" in text


def test_a_comparison_without_runs_counts_in_the_correction() -> None:
    scores = {
        name: pd.DataFrame({"area": values})
        for name, values in (("a", np.arange(6.0)), ("b", np.arange(6.0) - 1), ("d", np.zeros(3)))
    }
    lines = comparison_lines(scores, [("a", "b"), ("a", "c")], "area", {}).splitlines()
    # Six seeds: two of 64 ways, and of two comparisons, for which they are too few.
    assert lines[2].startswith("| a − b | 6 | +1.000 | [+1.000, +1.000] | none |")
    assert "| 0.031 | 0.062 |" in lines[2]
    assert lines[3].split("|")[1:4] == [" a − c ", " 6, 0 ", "  "]
    assert {line.count("|") for line in lines} == {lines[0].count("|")}
    fewer = comparison_lines(scores, [("a", "b"), ("a", "c")], "area", {}, absent=False)
    assert fewer.splitlines() == lines[:3]
    # Arms with few seeds in common are compared by the means of their runs.
    (line,) = comparison_lines(scores, [("a", "d")], "area", {}).splitlines()[2:]
    assert "| 6, 3 | +2.500 |" in line
    assert comparison_lines(scores, [("x", "c")], "area", {}) == ""


def test_arms_are_compared_by_the_seeds_that_they_have_in_common() -> None:
    rng = np.random.default_rng(0)
    hard = pd.Series(rng.uniform(0, 0.6, 20), index=range(100, 120))
    scores = {
        "all": pd.DataFrame({"area": hard}),
        "ten": pd.DataFrame({"area": hard[hard.sort_values().index[:10]] + 0.1}),
    }
    # Ten of the worst seeds, which are above the same seeds and below the mean of all.
    assert scores["ten"]["area"].mean() < hard.mean()
    (line,) = comparison_lines(scores, [("ten", "all")], "area", {}).splitlines()[2:]
    assert line.startswith("| ten − all | 10 | +0.100 | [+0.100, +0.100] |")
    assert "| 0.002 | 0.002 |" in line


def test_no_share_is_said_to_be_below_nothing_or_above_everything() -> None:
    runs = pd.DataFrame({"area": [0.1, 0.9, 0.95], "success": [0.5, 1.0, 1.0], "actions": 100.0})
    columns = pd.MultiIndex.from_tuples([("bars-test-1", 0), ("bars-test-2", 0)])
    worlds = pd.DataFrame([[1.0, 0.0], [1.0, 1.0], [1.0, 1.0]], columns=columns)
    worlds.columns.names = ["world", "pair"]
    line = arm_lines({"a": runs}, ["a"], "area", {"a": worlds}).splitlines()[-1]
    assert "0.650 [0.000, 1.000]" in line
    assert line.count("100.0%]") == 2


def test_an_arm_with_one_run_or_two_is_not_compared() -> None:
    index = pd.Index(range(8), name="seed")
    scores = {
        "a": pd.DataFrame({"area": np.linspace(0, 1, 8)}, index),
        "b": pd.DataFrame({"area": [0.4, 0.6]}, index[:2]),
    }
    assert comparison_lines(scores, [("a", "b")], "area", {}) == ""
    lines = comparison_lines({**scores, "c": scores["a"]}, [("a", "b"), ("a", "c")], "area", {})
    assert lines.splitlines()[2].split("|")[1:4] == [" a − b ", " 8, 2 ", "  "]


def test_runs_that_are_missing_are_named_with_their_command(runs: Path, tmp_path: Path) -> None:
    table = small_table(runs)
    assert missing(table, read_runs(table, runs), runs) == ""
    more = small_table(runs, seeds=7)
    said = missing(more, read_runs(more, runs), runs)
    assert "Missing: s/td3/uniform 4 to 6; s/td3/per 4 to 6." in said
    assert "--methods uniform per --seeds 4 5 6 --worlds" in said
    assert "--methods uniform --seeds 4 5 6 --worlds" in said
    # Trained, and not tested in all its worlds.
    rows = read_runs(table, runs)
    fewer = rows.tests.query("arm != 's/td3/per' or seed != 2 or not world.str.startswith('halls')")
    assert missing(table, Rows(rows.curves, fewer), runs).startswith("Missing: s/td3/per 2.")


def test_a_folder_without_rows_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report.main([str(tmp_path)]) == 1
    assert "no rows of the study" in capsys.readouterr().err
    assert study.main(["--folder", str(tmp_path), "--keep", str(tmp_path / "k")]) == 0
    assert "nothing is written" in capsys.readouterr().out


def test_the_figures_of_the_paper_are_made_of_table_a() -> None:
    found: dict[str, list[Job]] = {}
    for each in paper_comparisons(tables(Path("x"))["A"]):
        assert "robots=16" in each.settings and "updates=16" in each.settings
        for name, jobs in each.runs().items():
            assert name not in found
            found[name] = jobs
    assert set(found) == {*NAMES, *(f"phi{phi}" for phi in PHIS)}
    assert len(found["mpfa_per"]) == 10 and len(found["klper"]) == 10


def test_arms_of_one_run_have_no_line_beside_those_of_several(runs: Path, tmp_path: Path) -> None:
    table = small_table(runs)
    rows, pictures = read_runs(table, runs), []
    of_per = rows.curves["arm"] == "s/td3/per"
    one = rows.curves[~of_per | (rows.curves["seed"] == 0)]
    for name, curves in (("one", one), ("none", rows.curves[~of_per])):
        (tmp_path / name).mkdir()
        for path in plot_study(table, Rows(curves, rows.tests), tmp_path / name):
            pictures.append(path.read_bytes())
    assert pictures[:3] == pictures[3:]


def test_an_arm_of_three_runs_has_thin_lines_and_no_picture_of_its_spread(
    runs: Path, tmp_path: Path
) -> None:
    table = small_table(runs)
    rows = read_runs(table, runs)
    few = Rows(rows.curves[rows.curves["seed"] < 3], rows.tests[rows.tests["seed"] < 3])
    assert [path.name for path in plot_study(table, few, tmp_path)] == ["C_curves.png"]


def test_a_panel_without_runs_is_left_out(runs: Path, tmp_path: Path) -> None:
    table = small_table(runs)
    rows, sizes = read_runs(table, runs), []
    for name, panels in (("one", {}), ("two", {"others": ("s/td3/lap", "s/td3/pal")})):
        (tmp_path / name).mkdir()
        whole = replace(table, panels={**table.panels, **panels})
        with Image.open(plot_study(whole, rows, tmp_path / name)[0]) as picture:
            sizes.append(picture.size)
    assert sizes[0] == sizes[1]


def test_the_real_tables_are_made_of_rows_of_every_arm(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    table = tables(Path("x"))["D"]
    arms = list(dict.fromkeys(label for panel in table.panels.values() for label in panel))
    runs = [(arm, seed) for arm in arms for seed in range(100, 106)]
    curves = pd.DataFrame(runs, columns=["arm", "seed"])
    curves["total_steps"], curves["success"] = 24_000, rng.uniform(size=len(curves))
    tests = curves.drop(columns="total_steps").merge(
        pd.DataFrame({"world": [word.replace(":", "-") + "-1" for word in table.kinds]}),
        how="cross",
    )
    tests["success"], tests["episode"] = rng.uniform(size=len(tests)) < 0.5, 0
    text = study_tables(table, Rows(curves, tests), absent="")
    assert text.count("| per/v8 − uniform/v8 |") == 3
    assert f"corrected for {len(table.planned)}" in text
