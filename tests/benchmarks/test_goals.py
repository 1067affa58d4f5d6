"""Runs on goal tasks: which are made, what is kept, and what the planned table compares."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from benchmarks.goals import __main__ as command
from benchmarks.goals import arms as known
from benchmarks.goals import runs, tables
from training.comparison.scores import COLUMNS
from training.records import read_table, write_table

ROOT = Path(__file__).resolve().parents[2]
TASKS = list(known.STEPS)[:2]


def rows_of(task: str, arm: str, seed: int, height: float) -> pd.DataFrame:
    found = {"task": task, "method": arm, "seed": seed, "steps": [10, 20], "score": height}
    return pd.DataFrame(found)[list(COLUMNS)]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, int]]:
    """The runs that were asked for, in place of runs."""
    asked: list[tuple[str, str, int]] = []

    def run(
        task: str, arm: str, seed: int, settings: Any, *_: Any
    ) -> tuple[pd.DataFrame, pd.DataFrame | None]:
        assert settings == {"gamma": len(task)}
        asked.append((task, arm, seed))
        scores = rows_of(task, arm, seed, 0.5)
        said = scores.drop(columns="score").assign(**dict.fromkeys(tables.SAMPLED, 0.25))
        return scores, said if arm.startswith("MPFA") else None

    monkeypatch.setattr(runs, "run", run)
    monkeypatch.setattr(runs, "CHOSEN", {task: {"gamma": len(task)} for task in TASKS})
    return asked


def test_each_run_is_made_once_and_its_rows_are_kept(
    made: list[tuple[str, str, int]], tmp_path: Path
) -> None:
    kept = tmp_path / "goals.csv"
    every = {arm: [104, 105] for arm in known.ARMS} | {known.SB3: [104]}
    runs.make(TASKS, every, tmp_path, kept)
    arms = {arm for task, arm, seed in made if (task, seed) == (TASKS[0], 104)}
    assert arms == {*known.ARMS, known.SB3}
    assert {arm for task, arm, seed in made if seed == 105} == {*known.ARMS}
    assert len(made) == len(read_table(kept)) // 2 == 2 * (2 * len(known.ARMS) + 1)
    said = read_table(tables.sampled_of(kept))
    assert {*said["method"]} == {known.MPFA} and len(said) == 2 * 2 * 2
    runs.make(TASKS, {arm: [*seeds, 106] for arm, seeds in every.items()}, tmp_path, kept)
    assert {seed for *_, seed in made[22:]} == {106}


@pytest.mark.parametrize(
    ("what", "arms"),
    [
        ([], [*known.ARMS, known.SB3]),
        (["exploratory"], list(known.EXPLORATORY)),
        (["--arms", "HER", known.SB3], ["HER", known.SB3]),
    ],
)
def test_command_makes_the_runs_of_its_arms(
    made: list[tuple[str, str, int]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    what: list[str],
    arms: list[str],
) -> None:
    task = "PointMaze_UMaze-v3"
    output = str(tmp_path / "goals.csv")
    command.main([*what, "--tasks", task, "--seeds", "902", "--output", output])
    assert made == [(task, arm, 902) for arm in arms]
    said = capsys.readouterr().out
    assert ("The planned comparisons need more runs" in said) == ("exploratory" not in what)
    names = [line.split(" | ")[0][2:] for line in said.splitlines()]
    assert [name for name in names if name in known.EVERY] == arms


def test_command_makes_runs_of_the_seeds_of_the_design_where_none_are_named(
    made: list[tuple[str, str, int]], tmp_path: Path
) -> None:
    output = ["--output", str(tmp_path / "goals.csv")]
    command.main(["--tasks", "PointMaze_UMaze-v3", "--arms", "HER", known.SB3, *output])
    seeds = {arm: [seed for _, of, seed in made if of == arm] for arm in ("HER", known.SB3)}
    assert seeds == {"HER": [*range(100, 110)], known.SB3: [*range(100, 105)]}


def test_rows_of_a_run_take_the_place_of_rows_of_the_same_run(tmp_path: Path) -> None:
    kept = tmp_path / "kept.csv"
    for arm, height in (("HER", 0.1), ("uniform", 0.2), ("HER", 0.3)):
        runs.add(rows_of(TASKS[0], arm, 100, height), kept)
    found = read_table(kept)
    assert found["method"].tolist() == ["uniform"] * 2 + ["HER"] * 2
    assert found["score"].tolist() == [0.2, 0.2, 0.3, 0.3]


def test_candidates_of_the_search_are_ordered_by_their_mean_area(
    made: list[tuple[str, str, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(task: str, arm: str, seed: int, settings: Any, *_: Any) -> pd.DataFrame:
        assert arm == "HER" and seed in known.SEARCH_SEEDS
        # The largest area of one seed would choose another.
        heights = (0.9, 0.0) if settings["tau"] == 0.05 else (0.5, 0.5)
        height = settings["gamma"] * heights[seed - 900]
        return rows_of(task, arm, seed, height), None

    monkeypatch.setattr(runs, "run", run)
    said = runs.search(TASKS[:1], tmp_path, tmp_path / "search.csv").splitlines()
    assert len(said) == len(known.CANDIDATES)
    assert said[0].startswith(f"{TASKS[0]}: gamma=0.98 tau=0.005")
    assert "gamma=0.95 tau=0.05" in said[-1]


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Rows of eight seeds, in which PER is ahead by a fifth of a score."""
    heights = dict(zip(known.ARMS, (0.1, 0.6, 0.8, 0.7, 0.65), strict=True))
    rows = [
        rows_of(task, arm, seed, height * factor + 0.001 * seed)
        for task, factor in zip(known.PLANNED, (1.0, 0.5, 0.0), strict=True)
        for arm, height in heights.items()
        for seed in range(8)
    ]
    # What is beside them, and apart.
    rows += [rows_of(TASKS[0], known.SB3, 0, 1.0), rows_of("FetchPush-v4", "HER", 0, 1.0)]
    write_table(pd.concat(rows), tmp_path / "goals.csv")
    return tmp_path / "goals.csv"


def test_planned_differences_are_of_the_means_over_the_tasks(kept: Path) -> None:
    planned, *others = tables.tables(kept).split("\n\n")
    table = planned.splitlines()[2:]
    # Three quarters of a score is the area of two equal ones that begin at zero.
    expected = (("PER with hindsight − HER", 0.2), ("MPFA-PER with hindsight − PER", -0.1))
    for line, (name, gap) in zip(table, expected, strict=False):
        assert line.startswith(f"| {name}")
        assert float(line.split("|")[3]) == pytest.approx(0.75 * 0.5 * gap, abs=0.002)
    assert len(table) == 4
    assert others[::2] == [f"## {task}" for task in known.STEPS]
    assert others[1].splitlines()[-1].startswith(f"| {known.SB3} | 0.750 |")


def test_exploratory_arms_are_compared_with_her_on_the_same_seeds(
    kept: Path, tmp_path: Path
) -> None:
    # Of the last arm a run of another seed is there, and in another task none.
    first, *_, last = known.EXPLORATORY
    rows = [rows_of(TASKS[0], first, seed, 0.7 + 0.001 * seed) for seed in (2, 3)]
    rows += [rows_of(TASKS[1], first, seed, 0.4 + 0.001 * seed) for seed in (2, 3)]
    rows += [rows_of(TASKS[1], last, seed, 0.2) for seed in (3, 40)]
    write_table(pd.concat(rows), tmp_path / "explored.csv")
    head, _, *lines = tables.explored_table(tmp_path / "explored.csv", kept).splitlines()
    heads = " | ".join(f"{task} (runs) | − HER" for task in TASKS)
    assert head == f"| arm | {heads} | − HER, mean of the tasks |"
    # HER has 0.6 and 0.3.
    two = "two runs: no interval"
    assert lines[0] == (
        f"| {first} | 0.527 (2) | +0.075 {two} | 0.302 (2) | +0.075 {two} | +0.075 {two} |"
    )
    assert lines[1] == f"| {last} |  |   | 0.150 (1) | -0.077 one run |   |"
    assert len(lines) == 2


def test_unplanned_differences_are_by_seed_in_each_task(kept: Path, tmp_path: Path) -> None:
    parts = list(known.EXPLORATORY)
    rows = [
        rows_of(task, part, seed, 0.6 * factor + 0.001 * seed)
        for task, factor in zip(known.PLANNED, (1.0, 0.5, 0.0), strict=True)
        for part in (parts[1], parts[4])
        for seed in range(8)
    ]
    write_table(pd.concat(rows), tmp_path / "explored.csv")
    head, _, *lines = tables.unplanned_table(kept, tmp_path / "explored.csv").splitlines()
    assert head == f"| unplanned | {' | '.join(known.PLANNED)} | mean |"
    # PER has 0.8, MPFA-PER 0.7, half batches 0.65 and HER 0.6; the tasks have all, half and none.
    for line, gap in zip(lines, (0.2, -0.1, 0.1, 0.05, 0.1), strict=True):
        cells = [cell.split()[0] for cell in line.split(" | ")[1:]]
        for cell, factor in zip(cells, (1.0, 0.5, 0.0, 0.5), strict=True):
            assert float(cell) == pytest.approx(0.75 * gap * factor, abs=6e-4)
    # Of the arms beside the design the parts of MPFA-PER are here.
    assert lines[-1].startswith(f"| {known.MPFA} − {parts[1]} |")


def test_the_peer_is_compared_on_the_seeds_that_both_have(kept: Path, tmp_path: Path) -> None:
    beside = [
        rows_of(TASKS[1], arm, seed, height + more * (seed - 903))
        for arm, height, more in ((known.SB3, 0.6, 0.02), ("HER", 0.4, 0.0))
        for seed in (902, 903, 904)
    ]
    # To the last no run of HER belongs.
    beside.append(rows_of(TASKS[1], known.SB3, 905, 1.0))
    write_table(pd.concat(beside), tmp_path / "beside.csv")
    _, _, first, second = tables.peer_table(kept, tmp_path / "beside.csv").splitlines()
    assert first == f"| {TASKS[0]} | 1 | +0.300 | one run |"
    assert second == f"| {TASKS[1]} | 3 | +0.150 | [+0.113, +0.187] |"


def test_page_has_the_tables_of_the_kept_rows() -> None:
    page = (ROOT / "docs/results/goals.md").read_text(encoding="utf-8")
    parts = tables.tables(), tables.unplanned_table(), tables.peer_table()
    parts += (tables.explored_table(),)
    for part in "\n\n".join(parts).split("\n\n"):
        assert part in page or part == "## What was sampled"


@pytest.mark.parametrize(("task", "seeds"), [("PointMaze_UMaze-v3", [3]), (TASKS[0], range(8))])
def test_planned_differences_wait_for_all_runs(kept: Path, task: str, seeds: list[int]) -> None:
    rows = read_table(kept)
    gone = (rows["task"] == task) & (rows["method"] == "HER") & rows["seed"].isin(list(seeds))
    write_table(rows[~gone], kept)
    said = tables.tables(kept).split("\n\n")[0]
    assert said == f"The planned comparisons need more runs: HER on {task}."


def test_settings_are_those_of_the_search_on_seeds_of_its_own() -> None:
    assert not {*known.SEARCH_SEEDS} & {*known.SEEDS}
    found = tables.areas(read_table(tables.SEARCHED)).groupby(["task", "method"])["area"].mean()
    for task in known.PLANNED:
        best = dict(word.split("=") for word in found[task].idxmax().split())
        assert {name: float(value) for name, value in best.items()} == known.CHOSEN[task]


# What an arm says of the replay, goals in hindsight, updates of a step and the size of a batch.
SAYS: dict[str, tuple[str, int | None, int, int]] = {
    "uniform": ("uniform", None, 1, 256),
    "HER": ("her", None, 1, 256),
    "PER with hindsight": ("per", 4, 1, 256),
    "MPFA-PER with hindsight": ("mpfa_per", 4, 1, 256),
    "half batches with hindsight": ("uniform_halves", 4, 1, 256),
    "MPFA-PER, neither raised nor decayed": ("mpf_per", 4, 1, 256),
    "reward and TD error": ("td_reward", 4, 1, 256),
    "TD error and action gradient": ("td_loss", 4, 1, 256),
    "PER, raised": ("raise", 4, 1, 256),
    "HER, two updates a step": ("her", None, 2, 256),
    "HER, two updates of half a batch": ("her", None, 2, 128),
    "HER, eight goals an episode": ("her", 8, 1, 256),
    "HER, goals for each transition": ("her", None, 1, 256),
}


@pytest.mark.parametrize("arm", [*known.ARMS, *known.EXPLORATORY])
def test_run_is_that_of_the_page_with_the_settings_of_its_arm(
    arm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def main(words: list[str]) -> Path:
        options, _ = runs.page.parse(words)
        asked.append(options)
        scores = rows_of("", "", 0, 0.5)
        write_table(scores, tmp_path / runs.page.SCORES)
        write_table(scores.assign(effective_sample_size=9.0), tmp_path / runs.page.STATISTICS)
        return tmp_path

    monkeypatch.setattr(runs.page, "main", main)
    # The tasks themselves are of an extra.
    monkeypatch.setattr(runs.page, "Task", lambda *_, **__: SimpleNamespace(has_goal=True))
    settings = {"gamma": 0.95, "tau": 0.02, "noise": 0.15}
    scores, said = runs.run("FetchReach-v4", arm, 3, settings, tmp_path)
    [options] = asked
    made = options.replay, options.hindsight, options.updates, options.batch_size
    assert made == SAYS[arm]
    assert options.goals_for == ("transition" if "transition" in arm else "episode")
    assert (options.task, options.seed, options.folder) == ("FetchReach-v4", 3, tmp_path / arm)
    assert (options.gamma, options.tau, options.noise) == (0.95, 0.02, 0.15)
    assert (options.steps, options.every, options.start) == (5_000, 250, 1_000)
    assert options.width == 64
    assert {*scores["method"]} == {arm} and {*scores["seed"]} == {3}
    assert (said is not None) == (arm in (known.PER, known.MPFA))


def test_arms_that_weigh_by_what_is_positive_know_it_where_each_step_costs() -> None:
    told = {
        arm
        for arm in {**known.ARMS, **known.EXPLORATORY}
        if "--positive-above=-0.5" in known.words_of_arm(arm, "FetchReach-v4")
    }
    assert told == {known.MPFA, *known.PARTS}
    for arm in told:
        words = ["--replay", *known.EVERY[arm].split()]
        assert known.words_of_arm(arm, "PointMaze_UMaze-v3") == words


def test_what_was_sampled_is_a_mean_over_evaluations_after_updates_and_runs(kept: Path) -> None:
    said = pd.concat(
        rows_of(TASKS[0], "", seed, 0.5)
        .drop(columns="score")
        # Before the first update nothing was sampled, but the buffer has rows.
        .assign(**{key: [None, 0.2 + 0.2 * seed] for key in tables.SAMPLED})
        .assign(positive_fraction_buffer=[0.0, 0.2 + 0.2 * seed])
        for seed in range(2)
    )
    for arm in known.ARMS:
        if (rows := runs.sampled(said, arm)) is not None:
            runs.add(rows.assign(method=arm), tables.sampled_of(kept))
    per, mpfa = tables.tables(kept).split("\n\n")[-1].splitlines()[2:]
    assert per == f"| {TASKS[0]} | {known.PER} |" + "  |" * 5 + " 0.300 |"
    assert mpfa == f"| {TASKS[0]} | {known.MPFA} |" + " 0.300 |" * 6
