"""Loops over numbers that Numba compiles; each is a plain function of arrays."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
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
    numba.config.CACHE_DIR = folder
    try:
        compiled: Any = decorate(function, cache=bool(folder))
    except RuntimeError:  # Its source is no file.
        compiled = decorate(function)
    finally:
        numba.config.CACHE_DIR = folder_of_others
    return compiled


@cache
def _cache_folder() -> str:
    """Return a folder for the compiled loops of these sources; empty if none can be written to."""
    # Numba looks at the file of a loop alone: a loop that calls another file's, or that takes a
    # class which moved, would be an older version's or fail to load after an upgrade.
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    user_folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    places = [package / "__pycache__", Path(user_folder, "torchrl_mpfa")]
    for place in [Path(numba.config.CACHE_DIR)] if numba.config.CACHE_DIR else places:
        folder = place / f"loops-{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return ""
