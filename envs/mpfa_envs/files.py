"""Files that may be anything: reading them, and replacing only those of the same kind."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path


def read_file(path: Path, most: int) -> bytes:
    """Read a file, unless it is a pipe or a device, which may never end, or too large."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("it is not a regular file")
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(f"it has more than {most} bytes")
    return content


def check_replaceable(
    path: Path, load: Callable[[Path], object], what: str, *, overwrite: bool
) -> None:
    """Check that a path is free or holds a file of the same kind."""
    if overwrite or not os.path.lexists(path):
        return
    try:
        load(path)
    except (OSError, ValueError) as error:
        raise FileExistsError(
            f"path must be free or hold a {what} unless overwrite=True, got {path}: {error}"
        ) from error


def write_atomically(content: bytes, path: Path) -> None:
    """Write a file in one step: the old one or the new one, never half."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as new:
        try:
            new.write(content)
            new.flush()
            os.fsync(new.fileno())
            # Temporary files are readable by their owner alone; this one by all.
            os.chmod(new.name, 0o644)
            os.replace(new.name, path)
        except BaseException as error:
            os.unlink(new.name)
            if isinstance(error, OSError):
                error.filename = str(path)
            raise
