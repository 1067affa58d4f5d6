"""Runs on a full disk: one line of what is full, whole files, and a next run as if never stopped.

A limit of the size of files stands for the disk: the system writes what fits, then nothing.
"""

from __future__ import annotations

import errno
import os
import resource
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from torchrl.record.loggers.csv import CSVExperiment

from tests.integration.tiny_runs import OVERRIDES
from training import files
from training.run.hooks import Hook
from training.run.loggers import forget_after
from training.run.loop import TrainingRun
from training.run.script import resume, start
from training.settings.command_line import composed, parse_overrides

CSV = ("tracking=[csv]", "tracking.log_every=4", "curriculum.stages=[{world: A, episodes: 3}]")


@contextmanager
def file_size(most: int) -> Iterator[None]:
    """Give files a size that they cannot exceed [bytes]."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class Fills(Hook):
    """Fill the disk once a run has begun."""

    def __init__(self, most: int) -> None:
        self.most = most

    def on_begin(self, run: TrainingRun) -> None:
        """Limit the size of all files."""
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.most, resource.RLIM_INFINITY))


@pytest.fixture
def printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[], list[str]]:
    """Give back the hook of threads; return the lines of errors but for the progress bar."""
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)

    def lines() -> list[str]:
        lines = capsys.readouterr().err.replace("\r", "\n").splitlines()
        return [line for line in lines if line.strip() and " of 3 episodes" not in line]

    return lines


def begun(folder: Path, *words: str, most: int | None = None) -> object:
    """Return the exit status of a run, whose disk is full from its beginning unless None."""
    (settings,) = composed([*OVERRIDES, *words])
    hooks = [] if most is None else [Fills(most)]
    with file_size(-1), pytest.raises(SystemExit) as ended:
        files.run_script(lambda: start(settings, folder, hooks))
    return ended.value.code


def logs(folder: Path) -> dict[str, bytes]:
    """Return the CSV logs but for wall-clock times, and names of what else there is."""
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*")}
    del found[".lock"]
    csv = {n: path.read_bytes() for n, path in found.items() if path.suffix == ".csv"}
    clocks = ("/time/", files.EPISODES)
    return dict.fromkeys(found, b"") | {
        name: rows for name, rows in csv.items() if not any(clock in name for clock in clocks)
    }


@pytest.mark.slow
def test_run_that_saved_nothing_leaves_whole_rows_and_begins_again_as_if_never_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Callable[[], list[str]]
) -> None:
    monkeypatch.setattr("training.run.hooks._REPORT_EVERY", 1e9)
    assert begun(tmp_path / "run", *CSV, most=30) == 1
    (line,) = printed()
    assert line.startswith(f"train.py: {tmp_path / 'run'}")
    assert "cannot be written, File too large: free some of its disk" in line
    rows = [path.read_bytes() for path in (tmp_path / "run" / files.CSV).rglob("*.csv")]
    assert rows and all(text.endswith(b"\n") for text in rows)
    assert begun(tmp_path / "run", *CSV) == 0
    assert begun(tmp_path / "whole", *CSV) == 0
    assert logs(tmp_path / "run") == logs(tmp_path / "whole")


@pytest.mark.slow
def test_run_whose_log_is_cut_in_an_iteration_resumes_with_the_whole_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def add(log: CSVExperiment, name: str, value: float, global_step: int) -> None:
        if name == "train/path_length" and global_step > 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        whole(log, name, value, global_step)

    every = "checkpoint_every=5"
    whole = CSVExperiment.add_scalar
    with monkeypatch.context() as patch:
        patch.setattr(CSVExperiment, "add_scalar", add)
        assert begun(tmp_path / "run", *CSV, every) == 1
    assert resume(tmp_path / "run", parse_overrides([])) == 0
    assert begun(tmp_path / "whole", *CSV, every) == 0
    assert logs(tmp_path / "run") == logs(tmp_path / "whole")


def test_thread_that_writes_a_log_reports_a_full_disk_in_the_one_line_of_the_run(
    tmp_path: Path, printed: Callable[[], list[str]]
) -> None:
    assert begun(tmp_path, "tracking=[tensorboard]", *CSV[1:], most=500) == 1
    (line,) = printed()
    assert line.startswith(f"train.py: {tmp_path}")


def test_run_whose_disk_is_full_says_so_in_one_line_and_how_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "checkpoint.pt")

    def train_on(run: TrainingRun) -> bool:
        run.save()
        run.records = [object()]  # type: ignore[list-item]
        full()
        return True

    monkeypatch.setattr(TrainingRun, "train", train_on)
    monkeypatch.setattr("training.run.script.as_table", full)
    assert begun(tmp_path, *CSV[2:]) == 1
    out, err = capsys.readouterr()
    words = "checkpoint.pt cannot be written, No space left on device: free some of its disk"
    assert err.splitlines()[-1] == f"train.py: {words}"
    assert f"continue with: train.py resume={tmp_path}" in out


def test_rows_are_cut_from_a_log_on_a_full_disk_and_a_log_without_rows_goes(tmp_path: Path) -> None:
    path = tmp_path / "success.csv"
    path.write_text("10,1.0\n20,0.0\n30,1.0\n4")
    with file_size(1):
        forget_after(20, path)
        assert path.read_text() == "10,1.0\n20,0.0\n"
        forget_after(5, path)
    assert not path.exists()
