"""The runs of sparse rewards: their settings, their rows, and the tables of these."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch

from benchmarks import sparse
from mpfa_envs import Policy
from training.settings.checks import check_settings
from training.settings.command_line import composed
from training.settings.train import register


@pytest.mark.parametrize("arm", sparse.ARMS)
def test_every_arm_has_settings_that_a_run_takes(arm: str) -> None:
    regime, name = sparse.ARMS[arm]
    method, goals = sparse.METHODS[name]
    words = (*sparse.SETTINGS, *sparse.REGIMES[regime], f"method={method}")
    register()
    [settings] = composed([*words, f"method.hindsight={goals}"])
    check_settings(settings)
    assert settings.curriculum.stages[0].actions == sparse.ACTIONS
    assert settings.environment.progress == "none"


def test_the_file_of_settings_is_the_best_arm() -> None:
    regime, name = "simple", "PER with hindsight"
    method, goals = sparse.METHODS[name]
    words = [*sparse.SETTINGS, *sparse.REGIMES[regime], f"method={method}"]
    register()
    [measured] = composed([*words, f"method.hindsight={goals}"])
    [file] = composed([f"settings={sparse.KEPT.parents[2] / 'examples/sparse.yaml'}"])
    # How a run is judged and logged is no part of what it learns.
    assert replace(file, evaluation=measured.evaluation, tracking=measured.tracking) == measured


def write_run(
    folder: Path, seed: int, success: list[float], reached: dict[str, list[bool]]
) -> None:
    """Files of a run as compare.py leaves them, without the policy's numbers."""
    run = folder / f"ddpg-per-{seed}"
    run.mkdir(parents=True)
    steps = [8000 * (number + 1) for number in range(len(success))]
    pd.DataFrame({"total_steps": steps, "success": success}).to_csv(run / "evaluations.csv")
    (run / "policy.npz").touch()
    rows = [
        (seed, world, ended, 4.0 + 4.0 * (number > 0))
        for world, ends in reached.items()
        for number, ended in enumerate(ends)
    ]
    table = pd.DataFrame(rows, columns=["seed", "world", "success", "shortest_path"])
    kept = folder / "episodes.csv"
    table.to_csv(kept, mode="a", header=not kept.exists(), index=False)


def test_rows_of_runs_are_curves_and_what_the_last_policies_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = "before: PER with hindsight"
    folder, kept = sparse.folder_of(arm, tmp_path), tmp_path / "kept.csv"
    for seed, last in ((1, 0.5), (2, 0.7), (3, 0.9)):
        reached = {
            "rooms-test-0": [True, True],
            "bars-test-0": [last > 0.6] * 6,
            "mazes-test-0": [False, True],
        }
        write_run(folder, seed, [0.3, 0.9, last], reached)
    monkeypatch.setattr(sparse, "make", lambda *_: 0)
    monkeypatch.setattr(sparse, "load_policy", lambda run: run.parent.name)
    monkeypatch.setattr(sparse, "changed_share", lambda name: float(name[-1]) / 10)
    assert sparse.main(["--folder", str(tmp_path), "--output", str(kept)]) == 0
    table = capsys.readouterr().out.splitlines()
    cells = [cell.strip() for cell in table[2].split("|")]
    # Areas (0.15 + 0.6 + (0.9 + last) / 2) / 3, and of kinds of worlds each counts the same.
    assert cells[1:5] == ["before", "PER with hindsight", "3, 3, 1", "0.52"]
    assert cells[6] == "83.3%" and cells[8:13] == ["50%", "83%", "72%", "50%", "20%"]
    rows = pd.read_csv(kept)
    assert list(rows["score"][rows["task"] == "before, test"]) == [0.5, 1.0, 1.0]
    assert sparse.main(["--kept", "--output", str(kept)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown == [*table, "", *sparse.search_table().splitlines()]


@pytest.mark.parametrize(("ahead", "least", "most"), [(0.0, 0.0, 0.0), (9.0, 0.2, 0.9)])
def test_the_share_of_changed_actions_is_none_of_a_robot_that_stands(
    monkeypatch: pytest.MonkeyPatch, ahead: float, least: float, most: float
) -> None:
    task = {"robot": "kobuki", "physics": "kinematic", "closeness_distance": 0.18}
    layer = torch.nn.Linear(42, 2)
    torch.nn.init.zeros_(layer.weight)
    torch.nn.init.constant_(layer.bias, ahead)
    policy = Policy.from_layers([layer, torch.nn.Tanh()], card={}, env_arguments=task)
    monkeypatch.setattr(sparse, "_JUDGED", 20)
    assert least <= sparse.changed_share(policy) <= most


def test_the_tables_of_the_page_are_those_of_the_kept_rows() -> None:
    page = sparse.KEPT.with_suffix(".md").read_text(encoding="utf-8")
    for table in sparse.tables():
        assert table in page
    searched = page[page.index("## What was tried") :].splitlines()
    rows = [line for line in searched if line.startswith("| `method")]
    assert len(rows) > 10 and set(rows) <= set(sparse.search_table().splitlines())
