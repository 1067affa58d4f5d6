"""Evaluation: known answers for the estimates, and a controller whose success is known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import evaluate
from assembly import make_policy
from evaluation import (
    EpisodeResult,
    bootstrap,
    greedy,
    run_episode,
    run_episodes,
    summarize,
    wilson,
)
from mpfa_envs import NavigationEnv, evaluation_pairs
from records import load_policy, save_policy
from settings import TrainSettings


def steer(observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn towards the goal, as a learned policy on an empty map has to."""
    cosine, sine = observation[18:20]
    turn = math.atan2(sine, cosine)
    return np.clip([1.0 - 2.0 * turn, 1.0 + 2.0 * turn], -1, 1).astype(np.float32)


def circle(observation: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.array([-1.0, 1.0], dtype=np.float32)


def result(**changes: float) -> EpisodeResult:
    fields = {
        "episode": 0, "success": True, "collision": False, "timeout": False, "time_s": 10.0,
        "path_length": 4.0, "shortest_path": 3.0, "min_clearance": 0.5, "spl": 0.75,
    }  # fmt: skip
    return EpisodeResult(**{**fields, **changes})  # type: ignore[arg-type]


def test_wilson_gives_the_intervals_of_the_papers_table() -> None:
    interval = wilson(181, 200)
    assert (interval.value, interval.low, interval.high) == pytest.approx(
        (0.905, 0.8564, 0.9384), abs=2e-4
    )


def test_wilson_does_not_collapse_at_certainty() -> None:
    interval = wilson(100, 100)
    assert interval.high == 1.0
    assert 0.95 < interval.low < 0.97


def test_the_bootstrap_interval_covers_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        interval = bootstrap(list(rng.normal(3.0, 1.0, 40)), rng, draws=300)
        covered += interval.low <= 3.0 <= interval.high
    assert 175 <= covered <= 199


def test_outcomes_sum_to_one_and_times_count_successes_alone() -> None:
    failed = {"success": False, "spl": 0.0, "time_s": 50.0}
    summary = summarize(
        [result(), result(**failed, collision=True), result(**failed, timeout=True), result()]
    )
    assert summary["success"].value == 0.5
    assert sum(summary[k].value for k in ("success", "collision", "timeout")) == 1.0
    assert summary["time_s"].value == 10.0
    assert summary["spl"].value == pytest.approx(0.375)


def test_turning_to_the_goal_succeeds_on_the_empty_map_and_circling_never_does() -> None:
    env = NavigationEnv(world="A", physics="kinematic", collision_distance="contact", max_steps=300)
    tasks = evaluation_pairs("A", 10, seed=1)
    summary = summarize(run_episodes(env, steer, tasks, progress=False)[0])
    assert summary["success"].value == 1.0
    assert 0.8 < summary["spl"].value <= 1.0
    env = NavigationEnv(world="A", physics="kinematic", collision_distance="contact", max_steps=50)
    assert summarize(run_episodes(env, circle, tasks, progress=False)[0])["timeout"].value == 1.0


def test_a_trajectory_starts_at_the_start_and_ends_at_the_goal() -> None:
    env = NavigationEnv(world="A", physics="kinematic", render_mode="rgb_array")
    task = evaluation_pairs("A", 1, seed=2)[0]
    frames: list[NDArray[np.uint8]] = []
    episode, positions = run_episode(env, steer, task, 0, frames=frames)
    assert tuple(positions[0]) == pytest.approx(task.start[:2])
    assert math.dist(positions[-1], task.goal) <= 0.5
    assert len(frames) == len(positions)
    driven = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert episode.path_length == pytest.approx(driven, rel=0.01)


def test_the_script_writes_its_table_its_rows_and_its_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = TrainSettings()
    settings.learner.width = 16
    settings.environment.physics, settings.environment.max_steps = "kinematic", 20
    save_policy(make_policy(settings.learner, 24, 2), settings, [], tmp_path / "policy.pt")
    evaluate.main([str(tmp_path), "--world", "B", "--episodes", "3"])
    document = json.loads((tmp_path / "evaluation.json").read_text())
    assert {"success", "collision", "timeout", "spl", "time_s", "episodes"} <= set(document)
    assert document["success"] + document["collision"] + document["timeout"] == 1.0
    assert (tmp_path / "evaluation.csv").read_text().count("\n") == 4
    with Image.open(tmp_path / "trajectories.png") as picture:
        assert picture.size[0] == 640
    with Image.open(tmp_path / "episode.gif") as animation:
        assert getattr(animation, "n_frames", 1) > 1
    printed = capsys.readouterr().out
    assert "success" in printed
    assert "95 % interval" in printed


POLICIES = sorted((Path(__file__).parents[2] / "examples" / "policies").glob("*.pt"))


def test_there_is_a_policy_to_start_from() -> None:
    assert POLICIES


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.name)
def test_a_policy_of_the_project_drives_around_obstacles(path: Path) -> None:
    assert path.stat().st_size < 3_000_000
    policy, state = load_policy(path)
    assert state["trained"]["method"] == "mpfa_per"
    env = NavigationEnv(world="D", physics="kinematic", collision_distance="contact")
    results, _ = run_episodes(env, greedy(policy), evaluation_pairs("D", 10, 4711), progress=False)
    env.close()
    assert sum(found.success for found in results) >= 9


def test_results_go_to_the_run_that_a_policy_is_of(tmp_path: Path) -> None:
    assert evaluate.output_folder(tmp_path) == tmp_path
    assert evaluate.output_folder(tmp_path / "policy.pt") == tmp_path
    assert evaluate.output_folder(Path("some/td3.pt")) == Path("runs/evaluation-td3")
