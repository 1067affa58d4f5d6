"""The folder of what is compiled and loaded again: the user's own and no one else's."""

from __future__ import annotations

import os
from pathlib import Path

_WRITTEN_BY_OTHERS = 0o022
"""Bits of a mode by which group and others can write."""


def own_cache_folder(*inside: str) -> Path | None:
    """Return a folder inside the user's of caches; None unless that is closed to all others.

    A relative ``XDG_CACHE_HOME`` does not count, as its standard says.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    try:
        cache = Path(given) if os.path.isabs(given) else Path.home() / ".cache"
        if not cache.is_absolute():
            return None
        folder = cache / "torchrl_mpfa"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        mine = folder.stat().st_uid == os.geteuid()
        # Into an open one of the user's, another may have put a file already.
        if not mine or not (is_own(folder) or all(is_own(path) for path in folder.rglob("*"))):
            return None
        folder.chmod(0o700)
        folder = folder.joinpath(*inside)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder
    except (OSError, RuntimeError, KeyError):  # No disk, no room, or no home.
        return None


def is_own(path: Path) -> bool:
    """Return True if a file or folder is there, the user's, and closed to the writes of others."""
    try:
        about = path.stat()
    except OSError:
        return False
    return about.st_uid == os.geteuid() and not about.st_mode & _WRITTEN_BY_OTHERS
