"""Variables of wandb in the environment: obeyed, left to a single run, or named in a line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from training.comparison.execution import Work
from training.inherited import OF_ONE_RUN, forget_single_run, with_environment
from training.run.tracking import Tracker
from training.settings.train import TrackingSettings, TrainSettings

OFFLINE, ONLINE = TrackingSettings(mode="offline"), TrackingSettings(mode="online")


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the environment of the tests have no word on wandb."""
    for name in [name for name in os.environ if name.startswith("WANDB_")]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("name", "value"),
    [("WANDB_MODE", "disabled"), ("WANDB_DISABLED", "true"), ("WANDB_DISABLED", "1")],
)
def test_environment_that_switches_wandb_off_is_obeyed_with_a_line(
    name: str,
    value: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv(name, value)
    tracker = Tracker(TrainSettings(tracking=OFFLINE), tmp_path, run_id=None)
    assert (tracker.upload, list(tmp_path.iterdir())) == (None, [])
    assert capsys.readouterr().err == f"{name}={value}: wandb gets no log\n"


@pytest.mark.parametrize(
    ("wanted", "mode", "words"),
    [
        (ONLINE, "offline", "tracking.mode=online has: tracking=wandb is the other mode"),
        (ONLINE, "dryrun", "tracking.mode=online has: tracking=wandb is the other mode"),
        (OFFLINE, "online", "tracking.mode=offline has: tracking=online is the other mode"),
    ],
)
def test_another_mode_has_no_effect_and_a_line_names_the_setting(
    wanted: TrackingSettings,
    mode: str,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("WANDB_MODE", mode)
    assert with_environment(wanted) == wanted
    assert capsys.readouterr().err == f"WANDB_MODE={mode} has no effect, {words}\n"


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("WANDB_PROJECT", "tracking.project"),
        ("WANDB_RUN_GROUP", "tracking.group"),
        ("WANDB_NAME", "run_dir"),
        ("WANDB_DIR", "run_dir"),
    ],
)
def test_variable_that_a_setting_overrules_is_named_with_the_setting(
    name: str, setting: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(name, "mine")
    assert with_environment(OFFLINE) == OFFLINE
    assert capsys.readouterr().err == f"{name} has no effect, {setting} has\n"


def test_variables_of_a_single_run_are_forgotten_with_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in OF_ONE_RUN:
        monkeypatch.setenv(name, "mine")
    monkeypatch.setenv("WANDB_ENTITY", "team")
    forget_single_run()
    assert not set(OF_ONE_RUN) & os.environ.keys()
    assert os.environ["WANDB_ENTITY"] == "team"
    assert (
        capsys.readouterr().err == f"{', '.join(OF_ONE_RUN)}: of a single run, ignored by several\n"
    )
    forget_single_run()
    assert capsys.readouterr().err == ""


def test_work_of_several_runs_forgets_the_id_of_its_caller_before_it_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Watching(Work[str]):
        found: str | None = "not asked"

        def take(self) -> None:
            self.waiting.clear()
            self.found = os.environ.get("WANDB_RUN_ID")

        def end(self, item: str, status: int | None) -> None: ...

        def fail(self, item: str, why: str) -> None: ...

    class Idle:
        def ready(self) -> bool:
            return True

        def stop(self) -> None: ...

        def wait(self) -> None: ...

    monkeypatch.setenv("WANDB_RUN_ID", "callers")
    from tqdm import tqdm

    work = Watching(["a"], [Idle()], tqdm(disable=True))  # type: ignore[list-item]
    work.run()
    assert work.found is None
