"""Loops over numbers that Numba compiles; each is a plain function of arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def njit(function: _Function) -> _Function:
    """Compile a function of numbers and arrays, and keep the code on disk where that can be.

    Args:
        function: A plain loop.

    Returns:
        The compiled function; it releases the interpreter's lock.
    """
    compiled: _Function
    try:
        compiled = numba.njit(function, cache=True, nogil=True)
    except RuntimeError:
        # No folder can be written to, as in a read-only installation without a home.
        compiled = numba.njit(function, nogil=True)
    return compiled
