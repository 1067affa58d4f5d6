"""Loops over numbers that Numba compiles; each is a plain function of arrays."""

from __future__ import annotations

import hashlib
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

numba: Any
try:
    import numba
except ImportError:  # A robot that runs a policy without a map needs none of it.
    numba = None

_Function = TypeVar("_Function", bound=Callable[..., Any])


def njit(function: _Function) -> _Function:
    """Compile a function of numbers and arrays, cached on disk where possible.

    One with a leading underscore is for other loops: Python cannot call it once it is compiled.
    """
    # Arithmetic is not reordered, and a division by zero gives infinity or NaN as in NumPy. Where
    # there is no Numba the loop stays as it is, with the same results.
    # The compiled function releases the interpreter's lock. Each wrapper of a function is compiled
    # as well, which takes a tenth of the time.
    if numba is None:
        return function
    decorate = partial(
        numba.njit,
        nogil=True,
        error_model="numpy",
        no_cfunc_wrapper=True,
        no_cpython_wrapper=function.__name__.startswith("_"),
    )
    folder, folder_of_others = _cache_folder(), numba.config.CACHE_DIR
    _listen()
    numba.config.CACHE_DIR = folder
    try:
        compiled: Any = decorate(function, cache=bool(folder))
        # Numba raises what goes wrong with a file in the midst of a call.
        compiled._cache._guard_against_spurious_io_errors = _guard
    except (RuntimeError, OSError):  # Its source is no file, or the folder has gone.
        compiled = decorate(function)
    finally:
        numba.config.CACHE_DIR = folder_of_others
    return compiled


@cache
def _listen() -> None:
    """Tell once that loops are compiled: a first start would be silent for half a minute."""
    from numba.core import event

    class Compiles(event.Listener):
        def on_start(self, event: Any) -> None:
            module = event.data["dispatcher"].py_func.__module__
            if module is not None and module.startswith(f"{__package__}."):
                _tell_of_compiling()

        def on_end(self, event: Any) -> None:
            """Nothing more to tell."""

    event.register("numba:compile", Compiles())


@cache
def _tell_of_compiling() -> None:
    kept = f", and kept in {folder}" if (folder := _cache_folder()) else ""
    with suppress(OSError, ValueError, AttributeError):  # It may be closed, or None.
        sys.stderr.write(f"compiling loops: up to half a minute at a first start{kept}\n")


@cache
def _cache_folder() -> str:
    """Return a folder for the compiled loops of these sources; empty if none is safe to use."""
    # Numba looks at the file of a loop alone: a loop that calls another file's, or that takes a
    # class which moved, would be an older version's or fail to load after an upgrade.
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    name = f"loops-{digest.hexdigest()[:16]}"
    if numba.config.CACHE_DIR:  # What the user has decided is not questioned.
        return _writable(Path(numba.config.CACHE_DIR, name)) or _warn("NUMBA_CACHE_DIR is not one")
    for place in (_beside(package), own_cache_folder()):
        folder = place and own_folder(place / name)
        # Numba's index is a pickle, which runs code: none of another user is loaded.
        if folder and _is_all_own(folder):
            return str(folder)
    return _warn("there is none that only you can write to")


def own_cache_folder() -> Path | None:
    """Return the user's folder of caches; None if there is none that only the user can write to."""
    cache_home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        # The standard ignores a relative path, as also "~" is that no shell has expanded.
        folder = Path(cache_home) if os.path.isabs(cache_home) else Path.home() / ".cache"
    except RuntimeError:  # The user has no home.
        return None
    return own_folder(folder / "torchrl_mpfa") if folder.is_absolute() else None


def own_folder(folder: Path) -> Path | None:
    """Return a folder, made if need be, that only its user can write to; None if it is not that."""
    try:
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        if hasattr(os, "geteuid"):  # Elsewhere folders have no such owner and mode.
            status = folder.stat()
            if status.st_uid != os.geteuid():
                return None
            if status.st_mode & 0o022:
                if not _is_all_own(folder):  # Closing it would not take out what others put in.
                    return None
                folder.chmod(status.st_mode & 0o755)
        return folder if os.access(folder, os.W_OK) else None
    except OSError:
        return None


def _is_all_own(folder: Path) -> bool:
    """Return True if all that is in a folder belongs to the user."""
    if not hasattr(os, "geteuid"):
        return True
    try:
        return all(path.lstat().st_uid == os.geteuid() for path in folder.rglob("*"))
    except OSError:
        return False


def _beside(package: Path) -> Path | None:
    """Return the folder of the package's compiled modules; None if it is another user's."""
    folder = package / "__pycache__"
    try:
        folder.mkdir(exist_ok=True)
        owner = folder.stat().st_uid
    except OSError:
        return None
    return folder if not hasattr(os, "geteuid") or owner == os.geteuid() else None


def _writable(folder: Path) -> str:
    """Return a folder, made if need be; empty if it cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return ""
    return str(folder) if os.access(folder, os.W_OK) else ""


def _warn(reason: str) -> str:
    """Warn once that nothing is kept, and return no folder."""
    warnings.warn(
        "compiled loops are not kept, so that each start takes about half a minute longer: set "
        f"NUMBA_CACHE_DIR to a folder that you can write to ({reason})",
        stacklevel=2,
    )
    return ""


@contextmanager
def _guard() -> Iterator[None]:
    """Go on without the cache where a file of it is damaged or cannot be written."""
    try:
        yield
    except Exception as error:
        _tell_of(repr(error))


@cache
def _tell_of(error: str) -> None:
    """Warn of an error in the cache, of each once."""
    _warn(error)
