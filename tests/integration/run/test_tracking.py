"""What is logged, as wandb keeps it and as TorchRL's loggers write it."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import wandb
import yaml

import evaluate
from tests.integration.tiny_runs import go_on, tiny, train
from training import files
from training.records import EpisodeRecord, EvaluationRecord
from training.run.loggers import WandbLog
from training.run.loop import TrainingRun
from training.run.tracking import Tracker, show_policy
from training.settings.command_line import composed
from training.settings.train import (
    Stage,
    TrackingSettings,
    TrainSettings,
)

ROOT = Path(__file__).parents[3]
OFFLINE = TrackingSettings(mode="offline")


class Kept:
    """Entries as wandb keeps them: those of one step are one row, of each key the last value."""

    step = 0

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, Any]] = {}
        self.axes: dict[str, str] = {}
        self.summaries: dict[str, str] = {}
        self.finished = 0
        self.artifacts: list[Any] = []

    def log(self, entries: dict[str, Any], step: int | None = None, commit: bool = True) -> None:
        step = max(self.rows, default=-1) + 1 if step is None else step
        self.rows.setdefault(step, {}).update(entries)

    def define_metric(self, name: str, *, step_metric: str, summary: str = "") -> None:
        self.axes[name] = step_metric
        self.summaries[name] = summary

    def log_artifact(self, artifact: Any) -> None:
        self.artifacts.append(artifact)

    def finish(self) -> None:
        self.finished += 1


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> Kept:
    run = Kept()
    monkeypatch.setattr(wandb, "init", lambda **_: run)
    return run


def episode(number: int, *, actions: int) -> EpisodeRecord:
    ended = {"success": True, "collision": False, "timeout": False}
    lengths = {"path_length": 1.5, "shortest_path": 1.0}
    return EpisodeRecord(number, "A", 10, actions, 5.0, 0.5, 1.0, **ended, **lengths)


def test_episodes_that_end_at_one_action_are_all_in_the_log(tmp_path: Path, kept: Kept) -> None:
    run: Any = SimpleNamespace(driven=None)
    tracker = Tracker(TrainSettings(tracking=OFFLINE), tmp_path, run_id=None)
    for number, actions in enumerate((160, 160, 160, 176)):
        tracker.on_episode(run, episode(number, actions=actions))
    found = EvaluationRecord(176, 4, "validation", 0.5, 0.5, 0.0, 0.4, 0.3, 1.0, 2.0)
    tracker.on_evaluation(run, found)
    rows = list(kept.rows.values())
    ended = [row for row in rows if "train/episode" in row]
    assert [row["train/episode"] for row in ended] == [0, 1, 2, 3]
    assert [row["train/path_length"] for row in ended] == [1.5] * 4
    # A second after the run began.
    assert [row["time/steps_per_second"] for row in ended] == [160.0, 160.0, 160.0, 176.0]
    # All are plotted over the actions of the run.
    assert [row[kept.axes["*"]] for row in rows] == [160, 160, 160, 176, 176]
    assert (rows[-1]["evaluation/spl"], rows[-1]["evaluation/sct"]) == (0.4, 0.3)
    assert kept.axes["evaluation/success"] == kept.axes["*"]
    assert kept.summaries["evaluation/success"] == "max"


def test_a_run_keeps_its_id_and_one_of_a_sweep_has_the_sweep_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_RUN_ID", "1a2b3c4d")
    ids = [Tracker(TrainSettings(), tmp_path, run_id=given).run_id for given in ("own", None)]
    assert ids == ["own", "1a2b3c4d"]


class Killed(BaseException):
    """Ends a run as SIGKILL does, without a save."""


def killed_and_resumed(
    folder: Path, settings: TrainSettings, *, saved: int, killed: int
) -> TrainingRun:
    """Save after so many actions, end after more, go on from the checkpoint."""

    def look(run: TrainingRun) -> None:
        if run.actions == saved:
            run.save()
        if run.actions == killed:
            run.close()
            raise Killed

    with pytest.raises(Killed):
        train(folder, settings, look)
    return go_on(folder, settings)


def csv_rows(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """The rows of each name, but for those that the clock decides."""
    scalars = folder / files.CSV / "scalars"
    found = {}
    for path in scalars.rglob("*.csv"):
        rows = (line.split(",") for line in path.read_text().splitlines())
        name = path.relative_to(scalars).with_suffix("").as_posix()
        if not name.startswith("time/"):
            found[name] = [(int(step), float(value)) for step, value in rows]
    return found


def board_rows(folder: Path) -> dict[str, list[tuple[int, float]]]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    reader = EventAccumulator(str(folder / files.TENSORBOARD), {"scalars": 0})
    reader.Reload()
    return {
        name: [(each.step, each.value) for each in reader.Scalars(name)]
        for name in reader.Tags()["scalars"]
        if not name.startswith("time/")
    }


@pytest.fixture(scope="module")
def in_both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run that was killed and went on, and the same one without that."""
    settings = tiny(episodes=[Stage("A", 4)])
    settings.environment.max_steps = 25
    settings.tracking = TrackingSettings(csv=True, tensorboard=True, log_every=5)
    folder = tmp_path_factory.mktemp("logs")
    killed_and_resumed(folder / "killed", settings, saved=20, killed=32)
    settings.tracking.tensorboard = False
    train(folder / "whole", settings)
    return folder / "killed", folder / "whole"


def test_a_run_that_was_killed_and_went_on_has_no_row_of_its_csv_files_twice(
    in_both: tuple[Path, Path],
) -> None:
    killed, unbroken = (csv_rows(folder) for folder in in_both)
    assert killed == unbroken
    assert [value for _, value in killed["train/episode"]] == [0, 1, 2, 3]


def test_tensorboard_shows_the_same_rows_as_the_csv_files(in_both: tuple[Path, Path]) -> None:
    killed, _ = in_both
    shown, rows = board_rows(killed), csv_rows(killed)
    assert shown.keys() == rows.keys()
    for name, values in rows.items():
        assert [step for step, _ in shown[name]] == [step for step, _ in values], name
        assert [v for _, v in shown[name]] == pytest.approx([v for _, v in values]), name


def test_tensorboard_has_the_settings_as_a_text_and_as_hyperparameters(
    in_both: tuple[Path, Path],
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    reader = EventAccumulator(str(in_both[0] / files.TENSORBOARD))
    reader.Reload()
    text = reader.Tensors("settings/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "| method.name | mpfa_per |" in text and "hydra" not in text
    assert "_hparams_/session_start_info" in reader.summary_metadata


def test_wandb_has_no_row_of_a_run_that_was_killed_twice(tmp_path: Path, kept: Kept) -> None:
    settings = tiny(episodes=[Stage("A", 4)])
    settings.environment.max_steps = 25
    settings.tracking = replace(OFFLINE, log_every=5, pictures_every=None)
    run = killed_and_resumed(tmp_path / "killed", settings, saved=20, killed=32)
    killed, kept.rows = kept.rows, {}
    train(tmp_path / "whole", settings)
    axes = [[row["actions"] for row in rows.values()] for rows in (killed, kept.rows)]
    assert axes[0] == axes[1]
    # Steps of wandb count on where they were, in the place of beginning again.
    assert list(killed) == list(range(len(killed)))
    assert kept.finished == 3
    # No pictures were asked for, and the policy goes with them.
    assert not kept.artifacts
    assert run.tracker.upload is not None and run.tracker.upload.endswith(run.tracker.run_id)


def test_pictures_of_an_action_that_was_logged_are_logged_all_the_same(
    tmp_path: Path, kept: Kept
) -> None:
    WandbLog(tiny(), tmp_path, run_id="abc").log({"train/reward": 1.0}, 32)
    log, before = WandbLog(tiny(), tmp_path, run_id="abc"), len(kept.rows)
    for name in ("train/reward", "policy/success", "evaluate/D/success"):
        log.log({name: 1.0}, 32)
    added = [name for row in list(kept.rows.values())[before:] for name in row]
    assert [name for name in added if name != "actions"] == ["policy/success", "evaluate/D/success"]


def test_a_run_that_is_begun_anew_begins_new_logs(tmp_path: Path) -> None:
    for log in (files.CSV, files.TENSORBOARD):
        (tmp_path / log).mkdir()
        (tmp_path / log / "old").write_text("")
    files.set_aside(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [files.PREVIOUS]
    assert (tmp_path / files.PREVIOUS / files.TENSORBOARD / "old").exists()
    # Once more: what was set aside first makes room.
    (tmp_path / files.CSV).mkdir()
    files.set_aside(tmp_path)
    assert not list((tmp_path / files.PREVIOUS / files.CSV).iterdir())


def test_wandb_is_shown_what_the_policy_does_and_gets_it_with_its_card(
    tmp_path: Path, kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    took: list[tuple[float, float]] = []

    def show(run: TrainingRun) -> None:
        begun = time.perf_counter(), run.robots.elapsed()
        show_policy(run)
        took.append((time.perf_counter() - begun[0], run.robots.elapsed() - begun[1]))

    monkeypatch.setattr("training.run.tracking.show_policy", show)
    settings = tiny(episodes=[Stage("A", 1)])
    settings.tracking = replace(OFFLINE)
    settings.evaluation = replace(settings.evaluation, world="validation", episodes=2)
    train(tmp_path / "run +1", settings)
    (row,) = [row for row in kept.rows.values() if "policy/paths" in row]
    kinds = {name: type(row[f"policy/{name}"]).__name__ for name in ("paths", "values")}
    assert kinds == {"paths": "Image", "values": "Image"}
    paths, values = (np.asarray(row[f"policy/{name}"].image) for name in ("paths", "values"))
    assert paths.shape == values.shape and not np.array_equal(paths, values)
    # The clock of the run stands still meanwhile.
    ((took_in_all, took_of_run),) = took
    assert took_in_all > 0.01 > abs(took_of_run)
    assert type(row["policy/episode"]).__name__ == "Video"
    table = row["policy/episodes"]
    assert len(table.data) == 2 and "spl" in table.columns
    (artifact,) = kept.artifacts
    assert (artifact.name, artifact.type) == ("policy-run--1", "policy")
    assert artifact.metadata["method"] == "mpfa_per"
    assert artifact.metadata["episodes"] == 1
    assert list(artifact.manifest.entries) == [files.POLICY]


@pytest.mark.parametrize("every", [None, 0])
def test_an_evaluation_is_logged_with_its_paths_unless_no_pictures_are_asked_for(
    every: int | None, tmp_path: Path, kept: Kept
) -> None:
    settings = tiny(episodes=[Stage("A", 2)])
    settings.tracking = replace(OFFLINE, pictures_every=every)
    settings.evaluation = replace(settings.evaluation, world="A", every=10, episodes=2)
    train(tmp_path, settings)
    found = [row for row in kept.rows.values() if "evaluation/success" in row]
    assert found and all(("evaluation/paths" in row) == (every == 0) for row in found)


def test_what_evaluate_py_finds_is_in_the_wandb_run_of_the_training(
    tmp_path: Path, kept: Kept, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tiny(episodes=[Stage("A", 1)])
    settings.tracking = replace(OFFLINE, pictures_every=None)
    run = train(tmp_path, settings)
    before = len(kept.rows)
    how = [str(tmp_path), "--worlds", "A", "B", "--episodes", "2"]
    total = evaluate.main([*how, "--no-pictures"]).iloc[-1]
    *_, row = kept.rows.values()
    assert len(kept.rows) == before + 1 and row["actions"] == run.actions
    assert row["evaluate/A+B-kinematic/success"] == total["success"]
    assert [line[0] for line in row["evaluate/A+B-kinematic/worlds"].data] == ["A", "B", "total"]
    assert "evaluate/A+B-kinematic/paths" not in row
    assert f"in wandb, too: wandb sync {tmp_path}/wandb/offline-run-" in capsys.readouterr().out
    # What is found late, and of an earlier checkpoint, is no reason to log anything again.
    (count,) = (tmp_path / "wandb").glob("logged-*.txt")
    entries, actions = count.read_text().split()
    log = WandbLog(settings, tmp_path, run_id=run.tracker.run_id)
    log.log({"evaluate/A/success": 1.0}, run.actions - 1)
    assert count.read_text().split() == [str(int(entries) + 1), actions]
    # A run without wandb begins none.
    (tmp_path / "wandb").rename(tmp_path / "elsewhere")
    evaluate.main([*how, "--no-pictures"])
    assert len(kept.rows) == before + 2 and not (tmp_path / "wandb").exists()


@pytest.mark.parametrize("every", [None, 0, 20])
def test_pictures_are_shown_at_the_end_or_more_often_or_never(
    every: int | None, tmp_path: Path, kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[int] = []

    settings = tiny(episodes=[Stage("A", 2)])
    settings.environment.max_steps = 25
    settings.tracking = replace(OFFLINE, pictures_every=every)
    monkeypatch.setattr("training.run.tracking.show_policy", lambda run: shown.append(run.actions))
    train(tmp_path / "run", settings)
    (end,) = {row["actions"] for row in kept.rows.values() if row.get("train/episode") == 1}
    assert shown == [*(range(20, end, 20) if every else ()), end]


def test_a_run_of_wandb_s_sweep_is_what_its_file_says(monkeypatch: pytest.MonkeyPatch) -> None:
    from wandb.sdk.launch.sweeps.utils import create_sweep_command, create_sweep_command_args

    sweep = yaml.safe_load((ROOT / "examples/sweep.yaml").read_text())
    assert (ROOT / sweep["program"]).exists()
    chosen = {
        name: {"value": each["values"][-1] if "values" in each else each["min"]}
        for name, each in sweep["parameters"].items()
    }
    macros = create_sweep_command_args({"args": chosen})
    words: list[str] = []
    for part in create_sweep_command(sweep["command"]):
        # A macro is all of a word; other words are handed on as they are.
        macro = part[2:-1] if part.startswith("${") and part.endswith("}") else None
        words += [part] if macro is None else macros.get(macro, [macro])
    assert words[:3] == ["env", "interpreter", "program"]
    monkeypatch.setenv("WANDB_RUN_ID", "1a2b3c4d")
    (settings,) = composed(words[3:])
    assert (settings.method.name, settings.updates, settings.seed) == ("uniform", 8, 1002)
    assert (settings.learner.actor_lr, settings.learner.tau) == (1e-4, 0.01)
    assert settings.run_dir == "runs/sweep/1a2b3c4d"
    # The metric that is searched by is logged.
    assert sweep["metric"]["name"] == "evaluation/success" and settings.evaluation.every
