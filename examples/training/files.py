"""The folder of a run: what lies in it, and who may write there."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from filelock import FileLock, Timeout

from training.extra import end_with

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
_LONGEST = 255
"""Bytes of a name that Linux's file systems take."""
_LONGEST_PATH = 3584
"""Bytes of a path. Linux takes 4096, and a run writes in its folder."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that has no room for a file."""
AGAIN = "then give the same command again"
# The checkpoint first: once it is gone, nothing can resume the old run.
_SAVED = (CHECKPOINT, POLICY, EPISODES, EVALUATIONS, UPDATES, CURVE, HISTOGRAMS)
_OF_A_RUN = (*_SAVED, SETTINGS, STATUS, CSV, TENSORBOARD)


class FolderInUse(RuntimeError):
    """Another process works in the folder."""


def digest(file: Path) -> str:
    """Return a file's SHA-256, to detect that it was replaced."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def digest_of(plugin: str | None) -> str | None:
    """Return the digest of a plugin, None without one."""
    return None if plugin is None else digest(Path(plugin))


def are_scores(path: Path) -> bool:
    """Return True unless a path is the folder of a comparison of ``compare.py``."""
    return path.is_file() or not (path / EPISODES).exists()


def short_name(name: str, most: int = 240) -> str:
    """Return a name of so many bytes at most: the end of a longer one is a digest of all of it.

    Examples:
        >>> short_name("method.batch_size=8,robots=1", 20)
        'method.batc-3d8e7658'
    """
    whole = name.encode()
    if len(whole) <= most:
        return name
    kept = whole[: most - 9].decode(errors="ignore")
    return f"{kept}-{hashlib.sha256(whole).hexdigest()[:8]}"


def check_name(path: Path) -> None:
    """Raise if a path has names that are too long for the file system, or is too long itself."""
    whole = path.absolute()
    for name in whole.parts:
        if (size := len(os.fsencode(name))) > _LONGEST:
            raise ValueError(
                f"{name[:20]}... has {size} bytes: a name may have {_LONGEST}, name a shorter one"
            )
    if (size := len(os.fsencode(whole))) > _LONGEST_PATH:
        raise ValueError(
            f"{str(path)[:20]}... has {size} bytes: a path may have {_LONGEST_PATH}, "
            "name a shorter one"
        )


def check_folder(folder: Path) -> None:
    """Raise if a folder cannot be made or written in."""
    check_name(folder)
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise ValueError(f"{folder} cannot be a folder, as {there} is a file: name another one")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written, as {there} is not yours: name another one")


def no_room(error: BaseException | None) -> OSError | None:
    """Return the error of a disk that has no room, of an error and its causes; None without one."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in FULL:
            return error
        error = error.__cause__
    return None


def full_disk(error: BaseException) -> str | None:
    """Return in one sentence that a disk has no room for a file; None for other errors."""
    full = no_room(error)
    if full is None:
        return None
    file = full.filename or "a file"
    return f"{file} cannot be written, {os.strerror(full.errno or 0)}: free some of its disk"


def run_script(main: Callable[[], object]) -> NoReturn:
    """Run a script; exit with its status, and with 1 after one line if a disk is full."""
    threading.excepthook = _report_thread
    try:
        try:
            status = main()
        finally:
            _flush()
    except Exception as error:
        if (cause := full_disk(error)) is None:
            raise
        with suppress(OSError):  # Where errors go may be on the disk that is full.
            print(f"{Path(sys.argv[0]).name}: {cause}, {AGAIN}", file=sys.stderr)
        raise SystemExit(1) from error
    status = status if isinstance(status, int) else 0
    end_with(status)
    sys.exit(status)


def _report_thread(ended: threading.ExceptHookArgs) -> None:
    """Report what ended a thread, but for a full disk that the thread keeps for its owner."""
    if no_room(getattr(ended.thread, "exception", None)) is None:
        threading.__excepthook__(ended)


def _flush() -> None:
    """Write what was printed; on a full disk raise ``OSError``, and let the end not try again."""
    try:
        sys.stdout.flush()
    except OSError as error:
        if no_room(error) is None:
            return
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        error.filename = "the output"
        raise


@contextmanager
def naming(folder: Path | str) -> Iterator[None]:
    """Name a folder in the error of a full disk that names no file, as those of logs do not."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL and error.filename is None:
            error.filename = str(folder)
        raise


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
            if half_written.is_dir():
                shutil.rmtree(half_written)
            half_written.unlink(missing_ok=True)
        with naming(folder):
            yield
    finally:
        held.release()


def wait_until_free(folder: Path, seconds: float) -> None:
    """Wait until no process holds a folder, or for so many seconds."""
    with suppress(Timeout), FileLock(folder / _LOCK, timeout=seconds):
        pass


def set_aside(folder: Path) -> None:
    """Move the files of an earlier run to ``previous/``, in place of those that lie there.

    A run that ended before it saved anything has logs alone, which are removed.
    """
    there = [name for name in _OF_A_RUN if (folder / name).exists()]
    # A run set aside what it found before it wrote its settings: the logs are its own.
    if SETTINGS in there and not {*_SAVED} & {*there} and _is_of_a_run(folder / SETTINGS):
        for name in (CSV, TENSORBOARD):
            shutil.rmtree(folder / name, ignore_errors=True)
        (folder / STATUS).unlink(missing_ok=True)
        return
    if not there:
        return
    previous = folder / PREVIOUS
    previous.mkdir(exist_ok=True)
    for name in _OF_A_RUN:
        if (previous / name).is_dir():
            shutil.rmtree(previous / name)
        (previous / name).unlink(missing_ok=True)
    for name in there:
        os.replace(folder / name, previous / name)


def _is_of_a_run(settings: Path) -> bool:
    """Return True if a file has the settings of a run."""
    return '"run_dir"' in settings.read_text(encoding="utf-8", errors="replace")
