"""Loops of prioritized replay in C, which a caller takes where they are there.

A wheel has them compiled. Elsewhere they are compiled at their first use, into the user's folder
of caches. Without a compiler, with ``TORCHRL_MPFA_NATIVE=0`` and on devices other than the CPU,
PyTorch does the same.
"""

from __future__ import annotations

import ctypes
import os
from ctypes import Structure, c_double, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

from torchrl_mpfa.native.build import SOURCE, compile_library, library_name


class Replay(Structure):
    """Nodes of the trees and signals of all slots, see ``replay.c``."""

    _fields_ = [
        *((name, c_void_p) for name in ("nodes", "table")),
        *((name, c_int64) for name in ("slots", "blocks", "columns")),
    ]


class Fusion(Structure):
    """Numbers of Eqs. (8) and (21)-(24), see ``replay.c``."""

    _fields_ = [
        ("weights", c_void_p),
        *((name, c_int64) for name in ("fused", "learned")),
        *((name, c_double) for name in ("eps", "alpha", "level")),
        ("bound", c_int64),
        *((name, c_double) for name in ("boost", "margin")),
        ("decay", c_void_p),
        ("highest", c_double),
        ("slot", c_int64),
    ]


_P, _I, _D = c_void_p, c_int64, c_double
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "set_leaves": (_I, [_P, _I, _I, _I, _I, _P, _P, _I]),
    "query": (_D, [_P, _I, _I, _I, _I, _I, _I]),
    "find": (None, [_P, _I, _I, _I, _I, _P, _I, _P]),
    "gather": (_I, [_P, _I, _P, _I, _I]),
    "scatter": (_I, [_P, _I, _P, _I, _I]),
    "sample": (_I, [_P, _I, _P, _I, _D, _P, _P, _P]),
    "write_new": (_I, [_P, _P, _I, _I, _I, _P, _P, _I, _D, _D, _D]),
    "stale": (_I, [_P, _I, _P, _I, _P]),
    "update": (_I, [_P, _P, _P, _I, _I, _P]),
}


@cache
def find_loops() -> Any:
    """Return the compiled loops; None where there are none."""
    if os.environ.get("TORCHRL_MPFA_NATIVE") == "0":
        return None
    compiled = _load(SOURCE.with_name(library_name()))
    if compiled is None and (folder := _own_folder()) is not None:
        path = folder / library_name()
        compiled = _load(path)
        if compiled is None and compile_library(path):
            compiled = _load(path)
    return compiled


def _own_folder() -> Path | None:
    """Return the user's folder of caches; None if there is none that only the user can write to."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_mpfa"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)  # What lies there is executed.
    except OSError:
        return None
    return folder


def loops() -> Any:
    """Return the compiled loops, which something that was made with them needs.

    Raises:
        RuntimeError: If there are none.
    """
    if (compiled := find_loops()) is None:
        raise RuntimeError(
            "a sampler that was made with compiled loops needs them, and here are none: load its "
            "state_dict() into a new one"
        )
    return compiled


def _load(path: Path) -> Any:
    """Return the loops of a file; None if there is none, or one of another kind of machine."""
    try:
        compiled = ctypes.CDLL(str(path))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(compiled, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError):
        return None
    return compiled
