"""The evaluation script: one row a world, and results that stay apart."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from PIL import Image

import evaluate
from mpfa_envs import GENERATORS, load_policy, save_policy
from mpfa_envs import evaluate as evaluate_policy
from mpfa_envs.evaluation.results import EpisodeResult
from mpfa_envs.robots.model import ROBOTS
from tests.integration.run.test_full_disk import file_size
from training import files
from training.comparison.jobs import Evaluation, Job
from training.evaluating import on_robot, summary_row
from training.records import read_table
from training.run.assembly import make_learner
from training.run.evaluations import exported_policy
from training.settings.train import GROUPS, TrainSettings
from training.worlds import parse_worlds, worlds_label

SHIPPED = "td3-paper"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    settings = TrainSettings()
    settings.learner.width = 16
    settings.environment.physics, settings.environment.max_steps = "kinematic", 20
    learner = make_learner(settings.learner, GROUPS["method"]["per"], 24, 2)
    save_policy(exported_policy(learner.policy, settings), tmp_path / "policy.npz")
    return tmp_path


def test_the_script_writes_tables_and_pictures(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate.main([str(run), "--worlds", "B", "--episodes", "3"])
    folder = run / "evaluation-B-kinematic"
    summary = read_table(folder / "summary.csv")
    assert list(summary["world"]) == ["B"]
    row = summary.iloc[0]
    assert row["success"] + row["collision"] + row["timeout"] == 1.0
    assert row["success_low"] <= row["success"] <= row["success_high"]
    episodes = read_table(folder / "episodes.csv")
    assert list(episodes["world"]) == ["B"] * 3
    results = evaluate_policy(load_policy(run), "B", episodes=3)
    assert list(episodes["path_length"]) == pytest.approx([r.path_length for r in results])
    with Image.open(folder / "trajectories.png") as picture:
        assert picture.size[0] == 640
    with Image.open(folder / "episode.gif") as animation:
        assert getattr(animation, "n_frames", 1) > 1
    said = json.loads((folder / "settings.json").read_text())
    assert said["card"]["learner"] == "ddpg"
    assert f"written: {folder}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "name", "pictures"),
    [
        (["astar"], "astar", ["trajectories.png", "episode.gif"]),
        (["dwa", "--memory", "map", "--no-pictures"], "dwa-map", []),
    ],
    ids=["astar", "dwa"],
)
def test_a_planner_has_the_tables_and_pictures_of_a_policy(
    words: list[str],
    name: str,
    pictures: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    # The tasks of this seed are short, and a picture takes longer than a step.
    worlds = ["--worlds", "A", "B", "--episodes", "2", "--seed", "145"]
    summary = evaluate.main(["--policy", *words, *worlds])
    folder = Path("runs") / f"evaluation-{name}" / "evaluation-A+B-kinematic-seed145"
    assert list(summary["world"]) == ["A", "B", "total"]
    assert list(summary["success"]) == [1.0, 1.0, 1.0]
    found = json.loads((folder / "evaluation.json").read_text())
    assert found["worlds"]["B"]["success"] == 1.0
    assert found["path_length"] > 1.0
    # Only a planner on the known map takes longer before its first decision than for each.
    assert (found["plan_s"] > found["decision_s"] > 0.0) == (name == "astar")
    assert len(read_table(folder / "episodes.csv")) == 4
    settings = json.loads((folder / "settings.json").read_text())
    assert settings["policy"] == words[0]
    assert settings["memory"] == ("map" if "--memory" in words else "none")
    assert {path.name for path in folder.iterdir()} >= {*pictures, "summary.csv"}
    shown = capsys.readouterr().out
    assert f"\n{name}, physics: kinematic\n" in shown and "plan_ms" in shown


def test_several_worlds_have_a_row_each_and_a_total(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate.main([str(run), "--worlds", "A", "--episodes", "1", "--no-pictures"])
    before = (run / "evaluation-A-kinematic" / "episodes.csv").read_bytes()
    worlds = ["--worlds", "A", "rooms:5-6"]
    summary = evaluate.main([str(run), *worlds, "--episodes", "2", "--no-pictures"])
    assert list(summary["world"]) == ["A", "rooms-5", "rooms-6", "total"]
    assert list(summary["episodes"]) == [2, 2, 2, 6]
    assert summary["spl"].iloc[-1] == pytest.approx(summary["spl"].iloc[:-1].mean())
    # Results of other worlds stay what they were.
    assert (run / "evaluation-A-kinematic" / "episodes.csv").read_bytes() == before
    assert len(read_table(run / "evaluation-A+rooms-5-6-kinematic" / "episodes.csv")) == 6
    assert "rooms-6" in capsys.readouterr().out


def test_a_policy_drives_another_robot_and_its_results_stay_apart(run: Path) -> None:
    how = [str(run), "--worlds", "B", "--episodes", "3", "--no-pictures"]
    slow = replace(ROBOTS["turtlebot2"], name="cart", max_wheel_speed=0.3)
    cart = run / "cart.yaml"
    cart.write_text(json.dumps({k: v for k, v in asdict(slow).items() if v is not None}))
    evaluate.main(how)
    evaluate.main([*how, "--robot", str(cart)])
    alone, moved = (
        read_table(run / f"evaluation-B-kinematic{robot}" / "episodes.csv")["time_s"]
        for robot in ("", "-cart")
    )
    # Both collide, the slower one later.
    assert (moved > 1.3 * alone).all()
    said = json.loads((run / "evaluation-B-kinematic-cart" / "settings.json").read_text())
    assert said["robot"]["max_wheel_speed"] == 0.3


def test_a_policy_moved_to_another_robot_keeps_its_distance_from_the_rim() -> None:
    policy, wide = load_policy("td3-rooms"), replace(ROBOTS["kobuki"], name="wide", radius=0.3)
    moved = on_robot(policy, wide)
    assert moved.env_arguments["robot"]["name"] == "wide"
    assert moved.env_arguments["closeness_distance"] == pytest.approx(0.3)
    assert policy.env_arguments["robot"]["name"] == "kobuki"
    assert on_robot(policy, None) is policy


def test_a_robot_that_senses_another_number_of_values_is_rejected(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        evaluate.main(["td3-rooms", "--robot", "turtlebot2"])
    assert (
        "--robot must sense 45 values as 'kobuki' does, got 27 of 'turtlebot2'"
        in capsys.readouterr().err
    )


def test_another_seed_and_noise_leave_the_rows_of_a_study_where_they_are(run: Path) -> None:
    asked = Evaluation(("A",), 1, "kinematic")
    job = Job("ddpg", "per", 0, run.parent)
    run.rename(job.path)
    (job.path / files.EPISODES).write_text("success,world\n")
    (job.path / files.STATUS).write_text('{"finished": true}')
    how = [str(job.path), "--worlds", "A", "--episodes", "1", "--no-pictures"]
    study = ["--output", str(job.results(asked))]
    others = (
        ["--seed", "3"], ["--noise", "slip=0.1"], ["--latency", "0.1"], ["--robot", "turtlebot2"],
        ["--goal-radius", "0.5"],
    )  # fmt: skip
    evaluate.main(how)
    assert job.is_evaluated(asked)
    for other in others:
        evaluate.main([*how, *other])
        assert job.is_evaluated(asked)
    names = {path.name.removeprefix("evaluation-A-") for path in job.path.glob("evaluation-*")}
    changed = {"seed3", "slip0.1", "latency0.1", "turtlebot2", "goal_radius-0.5"}
    assert names == {"kinematic", *(f"kinematic-{each}" for each in changed)}
    for other in others:
        evaluate.main([*how, *other, *study])
        assert not job.is_evaluated(asked)


@pytest.mark.parametrize("words", [["run"], ["--policy", "dwa"]], ids=" ".join)
def test_an_evaluation_names_its_physics_and_another_physics_leaves_its_results(
    words: list[str], run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(run)
    source = [str(run)] if words == ["run"] else words
    found = {}
    for physics in ("kinematic", "wheels"):  # As trained, which is also a planner's, and asked for.
        how = [] if physics == "kinematic" else ["--physics", physics]
        evaluate.main([*source, "--worlds", "A", "--episodes", "1", "--no-pictures", *how])
        shown = capsys.readouterr().out
        found[physics] = folder = Path(shown.split("written: ")[1].strip())
        assert f", physics: {physics}\n" in shown
        for name in ("settings.json", "evaluation.json"):
            assert json.loads((folder / name).read_text())["physics"] == physics
        for name in ("summary.csv", "episodes.csv"):
            assert list(read_table(folder / name)["physics"]) == [physics]
    assert [folder.name for folder in found.values()] == [
        "evaluation-A-kinematic",
        "evaluation-A-wheels",
    ]


def test_generators_have_a_row_each_and_a_picture_of_nine_worlds(run: Path) -> None:
    words = ["bars:validation", "mazes:validation", "D"]
    summary = evaluate.main([str(run), "--worlds", *words, "--episodes", "8"])
    assert list(summary["world"]) == ["bars-validation", "mazes-validation", "D", "total"]
    folder = run / f"evaluation-{worlds_label(words)}-kinematic"
    found = json.loads((folder / "evaluation.json").read_text())
    assert sorted(found["generators"]) == ["bars:validation", "mazes:validation"]
    assert sorted(found["worlds"]) == ["D"]
    assert found["episodes"] == 24
    for row in (found, found["generators"]["mazes:validation"], found["worlds"]["D"]):
        assert row["success"] + row["collision"] + row["timeout"] == pytest.approx(1.0)
        assert {"spl", "time_s"} <= set(row)
    with Image.open(folder / "trajectories.png") as picture:
        # Five worlds of each generator and D: the first nine, three in a row.
        assert 3 * 360 <= picture.size[0] < 4 * 360


def test_the_table_tells_of_walkers_where_there_are_any(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    how = ["--episodes", "1", "--no-pictures", "--output", str(run / "crowd")]
    summary = evaluate.main([str(run), "--worlds", "crowd:validation", "A", *how])
    assert summary["intrusion_time"].notna().tolist() == [True, False, True]
    header = next(line for line in capsys.readouterr().out.splitlines() if "min_clearance" in line)
    assert header.split()[-3:] == ["walker_distance", "intrusion_time", "time_to_collision"]


def test_the_table_has_the_score_of_barn_where_its_task_is_driven(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    how = ["--episodes", "1", "--no-pictures", "--output", str(run / "barn")]
    summary = evaluate.main([str(run), "--worlds", "barn", "A", *how])
    assert summary["barn_score"].notna().tolist() == [True, False, True]
    header = next(line for line in capsys.readouterr().out.splitlines() if "barn_score" in line)
    assert header.split().index("barn_score") == header.split().index("sct") + 1
    document = json.loads((run / "barn" / "evaluation.json").read_text())
    assert document["worlds"]["barn"]["barn_score"] == document["barn_score"]
    assert "barn_score" not in document["worlds"]["A"]


@pytest.mark.parametrize(
    ("name", "words", "expected"),
    [
        ("td3-rooms", [], True),
        ("td3-rooms", ["--no-filter"], False),
        (SHIPPED, [], False),
        (SHIPPED, ["--filter"], True),
    ],
)
def test_a_policy_that_never_drove_without_the_filter_has_it_by_default(
    name: str, words: list[str], expected: bool
) -> None:
    options = evaluate.parse([name, *words])
    assert options.filter is expected
    assert evaluate.output_folder(options).name.endswith("-filter") == expected


def test_a_time_that_there_is_not_is_null_in_the_document() -> None:
    lost = EpisodeResult(0, False, False, True, 9.0, 1.0, 2.0, 0.1, 0.0, 0.0)
    row = {"world": "A", "physics": "wheels", **summary_row([lost, lost])}
    document = evaluate.as_document([row])
    assert document["time_s"] is None
    assert document["worlds"]["A"]["timeout"] == 1.0


@pytest.mark.slow
def test_pictures_without_room_leave_those_before_and_name_their_folder(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    folder = run / "results"
    words = [str(run), "--worlds", "A", "--episodes", "1", "--output", str(folder)]
    evaluate.main(words)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with file_size(8000), pytest.raises(SystemExit) as ended:
        files.run_script(lambda: evaluate.main(words))
    assert ended.value.code == 1
    assert f"{folder} cannot be written, File too large" in capsys.readouterr().err.splitlines()[-1]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_plan_and_a_goal_radius_shorten_and_lengthen_the_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["--worlds", "mazes:validation", "--episodes", "12", "--no-pictures"]
    times, name = {}, "td3-rooms"
    for words in ([], ["--plan", "known"], ["--goal-radius", "0.2"]):
        summary = evaluate.main([name, *arguments, *words])
        assert summary["success"].iloc[0] == 1.0
        times["".join(words)] = summary["time_s"].iloc[0]
    assert times["--planknown"] < times[""] < times["--goal-radius0.2"]
    folders = (tmp_path / "runs" / "evaluation-td3-rooms").iterdir()
    middles = {each.name.removeprefix("evaluation-mazes-validation-kinematic") for each in folders}
    assert middles == {"-filter", "-filter-plan-known", "-filter-goal_radius-0.2"}
    with pytest.raises(SystemExit):
        evaluate.parse(["--policy", "astar", "--plan", "known"])
    assert "plan must be 'unknown' without a map" in capsys.readouterr().err


def test_worlds_and_their_label_agree() -> None:
    assert parse_worlds(["test", "rooms:100-101"]) == ["test", "rooms-100", "rooms-101"]
    assert parse_worlds(["rooms:100-100"]) == ["rooms-100"]
    tests = [f"{name}:test" for name in GENERATORS if name not in ("mixed", "crowd")]
    assert parse_worlds(["all", "barn"]) == [*tests, "barn"]
    words = (["test"], ["test", "A"], ["a/w.yaml"], ["b/w.yaml"])
    assert len({worlds_label(each) for each in words}) == 4
    many = [f"rooms-{number}" for number in range(51)]
    assert worlds_label(many) != worlds_label(many[:50])
    assert len(worlds_label(many)) < 80
