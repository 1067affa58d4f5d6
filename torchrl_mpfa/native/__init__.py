"""Loops over trees and rows in C, which a caller takes where they are there.

A wheel has them compiled. Elsewhere they are compiled at their first use, into the user's folder
of caches. Without a compiler, with ``TORCHRL_MPFA_NATIVE=0`` and on devices other than the CPU,
PyTorch does the same.
"""

from __future__ import annotations

import ctypes
import os
import warnings
from collections.abc import Callable
from ctypes import c_double, c_int64, c_void_p
from functools import cache, wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from torchrl_mpfa.caches import is_own, own_cache_folder
from torchrl_mpfa.native.build import SOURCE, compile_library, library_name

_Function = TypeVar("_Function", bound=Callable[..., Any])


_P, _I, _D = c_void_p, c_int64, c_double
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "put": (_I, [_P, _P, _P, _I, _P, _P, _P, _I]),
    "query": (_D, [_P, _P, _P, _I, _I, _I]),
    "find": (None, [_P, _P, _I, _I, _P, _I, _P, _P]),
    "waits": (_I, []),
    "ask": (None, [_P, _I, _P, _I, _I]),
    "gather": (_I, [_P, _I, _P, _I, _I]),
    "not_finite": (_I, [_P, _I, _I]),
    "scatter": (_I, [_P, _I, _P, _I, _I]),
    "join": (_I, [_P, _I, _P, _I, _I, _P, _P, _I, _I, _P]),
    "give": (_I, [_P, _I, _I, _P, _I, _I, _P, _I]),
    "describe": (_I, [_P, _I, _I, _I, _P]),
    "tally": (None, [_P, _I, _I, _P, _I]),
}


def opaque(function: _Function) -> _Function:
    """Keep ``torch.compile`` out of a function that calls C.

    What is traced gives up a tensor after its last use, and C would read freed memory.
    """
    disabled = torch.compiler.disable(function)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        # What is disabled takes longer to enter than some of these loops.
        return (disabled if torch.compiler.is_compiling() else function)(*args, **kwargs)

    return cast(_Function, call)


def is_plain(values: Tensor) -> bool:
    """Return True if the memory of a tensor is its numbers, side by side, on the CPU."""
    return (
        values.is_cpu
        and values.layout is torch.strided
        and values.is_contiguous()
        and not (values.is_neg() or values.is_conj())
    )


def address(values: Tensor, dtype: torch.dtype) -> int:
    """Return the address of numbers of a type; they must live until C returns.

    Raises:
        TypeError: If the tensor is not plain, or of another type.
    """
    if values.dtype is not dtype or not is_plain(values):
        raise TypeError(
            f"values must be a plain tensor of {dtype} on the CPU, got {values.dtype} on "
            f"{values.device}"
        )
    return values.data_ptr()


@cache
def find_loops() -> Any:
    """Return the compiled loops; None, with a warning that says why, where there are none."""
    if os.environ.get("TORCHRL_MPFA_NATIVE") == "0":
        return None
    try:
        if (compiled := _load(SOURCE.with_name(library_name()))) is not None:
            return compiled
        compiled, reason = _of_user()
    except Exception as error:  # PyTorch is there, whatever a machine lacks.
        compiled, reason = None, f"{type(error).__name__}: {error}"
    if compiled is None:
        warnings.warn(
            f"no compiled loops of replay, which then takes several times as long: {reason}. With "
            "TORCHRL_MPFA_NATIVE=0 in the environment PyTorch does it without this warning",
            stacklevel=2,
        )
    return compiled


def _of_user() -> tuple[Any, str]:
    """Return the loops in the user's folder of caches, compiled once; or None, and why."""
    if (folder := own_cache_folder()) is None:
        return None, "there is no folder of caches that is yours and that only you can write to"
    path = folder / library_name()
    failed = path.with_suffix(".failed")
    if is_own(path) and (compiled := _load(path)) is not None:
        return compiled, ""
    if failed.exists():
        return None, f"{path} could not be loaded: remove {failed} to compile it again"
    if (reason := compile_library(path)) is not None:
        return None, reason
    if (compiled := _load(path)) is None:
        # Else every start would compile again.
        failed.touch()
        return None, f"{path} cannot be loaded, as on a disk without the right to execute"
    return compiled, ""


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


def _load(path: os.PathLike[str]) -> Any:
    """Return the loops of a file; None if there is none, or one of another kind of machine."""
    try:
        compiled = ctypes.CDLL(str(path))
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(compiled, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError):
        return None
    return compiled
