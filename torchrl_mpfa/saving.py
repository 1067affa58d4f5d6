"""Files that are whole or absent, and that no loading can make execute anything."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch


def save_atomically(state: Any, path: str | Path) -> None:
    """Write tensors and plain values to a file in one step.

    The file is written beside its place and renamed, so that a crash at any moment leaves the
    old file or the new one, never half of one.

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
    path = Path(path)
    # Opened as any file is, so that it gets the permissions that any file gets.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            torch.save(state, file)
            file.flush()
            # Without this, a power cut after the rename could leave an empty file.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load_safely(path: str | Path, *, map_location: str | torch.device = "cpu") -> Any:
    """Read a file of tensors and plain values without executing anything in it.

    Args:
        path: The file.
        map_location: Device of the tensors.

    Returns:
        What was saved.

    Raises:
        FileNotFoundError: If there is no such file.
        pickle.UnpicklingError: If the file holds anything but tensors and plain values.
    """
    return torch.load(path, map_location=map_location, weights_only=True)
