"""Saved states: files that are whole or absent, and checks of their entries.

Files hold tensors and plain values only, so that reading one executes nothing, and a checksum, so
that damage is noticed.
"""

from __future__ import annotations

import glob
import io
import math
import os
import pickle
import secrets
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

_STATE = "state.pt"
"""File of a dump."""
_NO_COMMENT = bytes(2)
"""The last bytes of an archive without a comment: the length of that comment."""
_MARK = b"crc32:"


def save_atomically(state: Any, path: str | Path) -> None:
    """Write tensors and plain values to a file in one step.

    The file is written next to its place and renamed, so that a crash at any moment leaves the
    old file or the new one, never half of one. Leftovers of a killed save are removed. Of several
    saves at once, by threads or processes, the last one counts.

    Args:
        state: Values that ``torch.load(weights_only=True)`` can read again.
        path: The file.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "state.pt"
        >>> save_atomically({"step": 3}, path)
        >>> load_safely(path)
        {'step': 3}
    """
    with _replacing(Path(path)) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:
            # PyTorch hides what the disk said behind a count of its own.
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
        _seal(file)


def write_text_atomically(text: str, path: str | Path) -> None:
    """Write a text file in one step, as :func:`save_atomically` does.

    Args:
        text: The whole text.
        path: The file, in UTF-8.
    """
    with _replacing(Path(path)) as file:
        file.write(text.encode())


def load_safely(path: str | Path, *, mmap: bool = False) -> Any:
    """Read a file of tensors and plain values without executing anything in it.

    Args:
        path: The file.
        mmap: True to leave tensors in the file until they are read.

    Returns:
        The saved values.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged, cut short, or not from :func:`save_atomically`.
        pickle.UnpicklingError: If the file holds anything but tensors and plain values.
    """
    _check_seal(Path(path))
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except pickle.UnpicklingError as error:
        raise pickle.UnpicklingError(
            f"{path} holds more than tensors and plain values: {error}"
        ) from None
    except Exception as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def allocate(path: str | Path, size: int = 0) -> None:
    """Reserve room on the disk for a file that is mapped to memory, or raise ``OSError``.

    A write to a mapped file for which the disk has no room would kill the process.
    """
    with open(path, "r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size or os.path.getsize(path) or 1)
        except OSError as error:
            error.filename = str(path)
            raise


def check_saved(part: str, state: Any, names: Iterable[str] = (), /, **exact: Any) -> None:
    """Reject a part's saved state that lacks one of the names, or has another value of ``exact``.

    Examples:
        >>> check_saved("sampler", {"_format": 1}, _format=2)
        Traceback (most recent call last):
        ...
        ValueError: '_format' of the saved sampler must be 2, got 1
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"the saved {part} must be a mapping, got {type(state).__name__}")
    for name in (*names, *exact):
        if name not in state:
            raise KeyError(f"{name!r} is missing in the saved {part}")
    for name, value in exact.items():
        if type(state[name]) is not type(value) or state[name] != value:
            raise ValueError(f"{name!r} of the saved {part} must be {value!r}, got {state[name]!r}")


def check_saved_numbers(part: str, state: Any) -> None:
    """Reject a saved state with a number that is not finite, in any entry.

    Examples:
        >>> check_saved_numbers("learner", {"loss": {"weight": torch.tensor([1.0, torch.inf])}})
        Traceback (most recent call last):
        ...
        ValueError: the saved learner must be finite, got inf in 'weight'
    """
    for name, value in state.items():
        entries = dict(enumerate(value)) if isinstance(value, list | tuple) else value
        if isinstance(entries, Mapping):
            check_saved_numbers(part, entries)
        elif isinstance(value, Tensor) and not bool(value.isfinite().all()):
            wrong = value[~value.isfinite()][0].item()
            raise ValueError(f"the saved {part} must be finite, got {wrong} in {name!r}")
        elif isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"the saved {part} must be finite, got {value} in {name!r}")


def dump(state: Any, path: str | Path) -> None:
    """Save a state in a folder, as :func:`save_atomically` does.

    Args:
        state: Tensors and plain values.
        path: The folder, which is made if its parent is there.

    Raises:
        pickle.UnpicklingError: If the state holds anything else; nothing is written.
    """
    plan = io.BytesIO()
    torch.save(tree_map_only(Tensor, lambda tensor: tensor.new_empty(0), state), plan)
    plan.seek(0)
    torch.load(plan, weights_only=True)
    Path(path).mkdir(exist_ok=True)
    save_atomically(state, Path(path) / _STATE)


def open_dump(path: str | Path) -> Any:
    """Read a state from a folder as :func:`load_safely` does, its tensors left in the file.

    Raises:
        FileNotFoundError: If there is no such folder, or no state in it.
    """
    file = Path(path) / _STATE
    if not file.is_file():
        raise FileNotFoundError(f"{path} must be a folder of dumps(...), got none with {_STATE}")
    return load_safely(file, mmap=True)


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
    """CRC-32 of the first ``end`` bytes of a file, as text."""
    file.seek(0)
    checksum = 0
    while end > 0 and (chunk := file.read(min(end, 1 << 20))):
        checksum = zlib.crc32(chunk, checksum)
        end -= len(chunk)
    return f"{checksum:08x}".encode()


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
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno:
            error.filename = str(path)
        raise


def _remove_leftovers(path: Path) -> None:
    """Remove the temporary files of saves whose process is gone."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        process = leftover.name.removesuffix(".tmp").rpartition(".")[2].partition("-")[0]
        if process.isdigit() and not _lives(int(process)):
            leftover.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # It lives and is another user's.
        return True
    return True
