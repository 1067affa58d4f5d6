"""The folder of a run: what lies in it, and who may write there."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

CHECKPOINT = "checkpoint.pt"
POLICY = "policy.npz"
SETTINGS = "settings.json"
EPISODES = "episodes.csv"
EVALUATIONS = "evaluations.csv"
UPDATES = "updates.csv"
CURVE = "learning_curve.png"
HISTOGRAMS = "histograms.png"
STATUS = "status.json"
CSV = "csv"
TENSORBOARD = "tensorboard"
PREVIOUS = "previous"
"""Folder of the files of an earlier run in the same folder."""
_LOCK = ".lock"
_TABLES = (EPISODES, EVALUATIONS, UPDATES)
# The checkpoint first: once it is gone, nothing can resume the old run.
_OF_A_RUN = (CHECKPOINT, POLICY, SETTINGS, *_TABLES, CURVE, HISTOGRAMS, STATUS, CSV, TENSORBOARD)


class FolderInUse(RuntimeError):
    """Another process works in the folder."""


def digest(file: Path) -> str:
    """Return a file's SHA-256, to detect that it was replaced."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def digest_of(plugin: str | None) -> str | None:
    """Return the digest of a plugin, None without one."""
    return None if plugin is None else digest(Path(plugin))


def check_folder(folder: Path) -> None:
    """Raise if a folder cannot be made or written in."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise ValueError(f"{folder} cannot be a folder, as {there} is a file: name another one")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written, as {there} is not yours: name another one")


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold a folder, so that no other run or comparison writes in it.

    The system lets go of the lock when the process ends, however that ends. What a killed process
    had half written is removed.
    """
    check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    held = FileLock(folder / _LOCK, timeout=0)
    try:
        held.acquire()
    except Timeout:
        raise FolderInUse(f"another process is using {folder}: wait for it, or stop it") from None
    try:
        # Not in the folders of a comparison's runs, each of which has a lock of its own.
        for half_written in (*folder.glob(".*.tmp"), *(folder / CSV).rglob(".*.tmp")):
            half_written.unlink(missing_ok=True)
        yield
    finally:
        held.release()


def wait_until_free(folder: Path, seconds: float) -> None:
    """Wait until no process holds a folder, or for so many seconds."""
    with suppress(Timeout), FileLock(folder / _LOCK, timeout=seconds):
        pass


def set_aside(folder: Path) -> None:
    """Move the files of an earlier run to ``previous/``, in place of those that lie there."""
    if not any((folder / name).exists() for name in _OF_A_RUN):
        return
    previous = folder / PREVIOUS
    previous.mkdir(exist_ok=True)
    for name in _OF_A_RUN:
        if (previous / name).is_dir():
            shutil.rmtree(previous / name)
        (previous / name).unlink(missing_ok=True)
    for name in _OF_A_RUN:
        if (folder / name).exists():
            os.replace(folder / name, previous / name)
