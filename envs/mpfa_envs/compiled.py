"""Loops over numbers that Numba compiles; each is a plain function of arrays."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
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
    compiled: Any
    try:
        compiled = decorate(function, cache=True)
    except RuntimeError:
        # No folder can be written to, as in a read-only installation without a home.
        compiled = decorate(function)
    return compiled
