"""The folder of a run: what lies in it, and who may write there."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

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
_LONGEST = 255
"""Bytes of a name that Linux's file systems take."""
_LONGEST_PATH = 3584
"""Bytes of a path. Linux takes 4096, and a run writes in its folder."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that has no room for a file."""
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


def short_name(name: str, most: int = 240) -> str:
    """Return a name of so many bytes at most: the end of a longer one is a digest of all of it.

    Examples:
        >>> short_name("method.batch_size=8,robots=1", 20)
        'method.batc-adfb1bb8'
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


def full_disk(error: BaseException) -> str | None:
    """Return in one sentence that a disk has no room for a file; None for other errors."""
    if not (isinstance(error, OSError) and error.errno in FULL):
        return None
    file = error.filename or "a file"
    return f"{file} cannot be written, {os.strerror(error.errno or 0)}: free some of its disk"


def run_script(main: Callable[[], object]) -> NoReturn:
    """Run a script; exit with its status, and with 1 after one line if a disk is full."""
    try:
        status = main()
    except OSError as error:
        if (cause := full_disk(error)) is None:
            raise
        name = Path(sys.argv[0]).name
        print(f"{name}: {cause}, then give the same command again", file=sys.stderr)
        status = 1
    sys.exit(status if isinstance(status, int) else 0)


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
        for pattern in (".*.tmp", f".{POLICY}.*"):
            for half_written in folder.glob(pattern):
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
