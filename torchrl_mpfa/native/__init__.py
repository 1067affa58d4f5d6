"""Loops of prioritized replay in C, which a caller takes where they are there.

A wheel has them compiled. Elsewhere they are compiled at their first use, into the user's folder
of caches. Without a compiler, with ``TORCHRL_MPFA_NATIVE=0`` and on devices other than the CPU,
PyTorch does the same.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
from ctypes import Structure, c_double, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

from torchrl_mpfa.native.build import SOURCE, compile_library

_BUILT = SOURCE.with_name("replay.so")


class Replay(Structure):
    """Nodes of the trees and signals of all slots, see ``replay.c``."""

    _fields_ = [
        *((name, c_void_p) for name in ("nodes", "table")),
        *((name, c_int64) for name in ("slots", "width", "columns")),
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
    "set_leaves": (None, [_P, _I, _I, _I, _P, _P, _I]),
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
def library() -> Any:
    """Return the compiled loops; None where there are none."""
    if os.environ.get("TORCHRL_MPFA_NATIVE") == "0":
        return None
    path = _BUILT if _BUILT.exists() else _cached()
    if not path.exists() and not compile_library(path):
        return None
    try:
        loops = ctypes.CDLL(str(path))
    except OSError:
        return None
    for name, (result, arguments) in _FUNCTIONS.items():
        function = getattr(loops, name)
        function.restype, function.argtypes = result, arguments
    return loops


def _cached() -> Path:
    """Return the file for this source in the user's folder of caches."""
    folder = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    return Path(folder) / "torchrl_mpfa" / f"replay-{digest}.so"
