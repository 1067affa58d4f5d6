"""Files that are whole or absent, whose damage is noticed, and that execute nothing."""

from __future__ import annotations

import glob
import os
import pickle
import secrets
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import torch

_NO_COMMENT = bytes(2)
"""The last bytes of an archive without a comment: the length of that comment."""
_MARK = b"crc32:"


def save_atomically(state: Any, path: str | Path) -> None:
    """Write tensors and plain values to a file in one step.

    The file is written beside its place and renamed, so that a crash at any moment leaves the
    old file or the new one, never half of one. What a killed save left beside it is removed. Of
    several saves at once, by threads or processes, the last one counts.

    Args:
        state: What ``torch.load(weights_only=True)`` can read again.
        path: The file.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "state.pt"
        >>> save_atomically({"step": 3}, path)
        >>> load_safely(path)
        {'step': 3}
    """
    with _replacing(Path(path)) as file:
        torch.save(state, file)
        _seal(file)


def write_text_atomically(text: str, path: str | Path) -> None:
    """Write a text file in one step, as :func:`save_atomically` does.

    Args:
        text: The whole text.
        path: The file, in UTF-8.
    """
    with _replacing(Path(path)) as file:
        file.write(text.encode())


def load_safely(
    path: str | Path, *, map_location: str | torch.device = "cpu", mmap: bool = False
) -> Any:
    """Read a file of tensors and plain values without executing anything in it.

    Args:
        path: The file.
        map_location: Device of the tensors.
        mmap: Whether tensors stay in the file until they are read.

    Returns:
        What was saved.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged, cut short, or not from :func:`save_atomically`.
        pickle.UnpicklingError: If the file holds anything but tensors and plain values.
    """
    _check_seal(Path(path))
    try:
        return torch.load(path, map_location=map_location, weights_only=True, mmap=mmap)
    except pickle.UnpicklingError as error:
        raise pickle.UnpicklingError(
            f"{path} holds more than tensors and plain values: {error}"
        ) from None
    except Exception as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _seal(file: IO[bytes]) -> None:
    """Put a checksum of the whole archive in its comment, which a reader of archives skips.

    The archive's own checksums do not cover its table of contents.
    """
    end = file.seek(0, os.SEEK_END) - len(_NO_COMMENT)
    checksum = _hex(file, end)
    file.seek(end)
    if file.read() != _NO_COMMENT:
        raise RuntimeError("torch.save wrote an archive with a comment, which has no room for one")
    file.seek(end)
    file.write(len(_MARK + checksum).to_bytes(2, "little") + _MARK + checksum)


def _check_seal(path: Path) -> None:
    """Reject a file whose content is not what was saved."""
    with path.open("rb") as file:
        length = len(_NO_COMMENT) + len(_MARK) + 8
        end = file.seek(0, os.SEEK_END) - length
        file.seek(max(end, 0))
        sealed = file.read()[len(_NO_COMMENT) :]
        if not sealed.startswith(_MARK):
            raise ValueError(f"{path} is cut short, or was not written by save_atomically")
        if sealed != _MARK + _hex(file, end):
            raise ValueError(f"{path} is damaged: its checksum is wrong")


def _hex(file: IO[bytes], end: int) -> bytes:
    return f"{checksum_of(file, end):08x}".encode()


def checksum_of(file: IO[bytes], end: int) -> int:
    """CRC-32 of the first ``end`` bytes of a file."""
    file.seek(0)
    found = 0
    while end > 0 and (chunk := file.read(min(end, 1 << 20))):
        found = zlib.crc32(chunk, found)
        end -= len(chunk)
    return found


@contextmanager
def _replacing(path: Path) -> Iterator[IO[bytes]]:
    """A new file to write, which takes the place of ``path`` once it is whole."""
    _remove_leftovers(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(8)}.tmp")
    try:
        # A new file with the permissions that any gets, which mkstemp's would not have; never one,
        # nor a link, that is there already.
        with temporary.open("x+b") as file:
            yield file
            file.flush()
            # Without this, a power cut after the rename could leave an empty file.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _remove_leftovers(path: Path) -> None:
    """Remove the temporary files of saves whose process is gone."""
    for found in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        process = found.name.removesuffix(".tmp").rpartition(".")[2].partition("-")[0]
        if process.isdigit() and not _lives(int(process)):
            found.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # It lives and is another user's.
        return True
    return True
