"""Reading arrays and lists from a saved state, with errors that name the entry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def read_array(state: Mapping[str, Any], name: str, like: NDArray[Any]) -> NDArray[Any]:
    """Copy a finite array from a state; its shape and dtype are those of another."""
    values = np.array(state.get(name), dtype=like.dtype if name in state else object)
    if values.shape != like.shape:
        raise ValueError(f"{name} of the state must have shape {like.shape}, got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} of the state must be finite numbers")
    return values


def read_list(state: Mapping[str, Any], name: str, robots: int) -> Sequence[Any]:
    """Read a list with an entry for each robot from a state."""
    values = state.get(name)
    if not isinstance(values, list | tuple) or len(values) != robots:
        found = len(values) if isinstance(values, list | tuple) else repr(values)
        raise ValueError(f"{name} of the state must have {robots} entries, got {found}")
    return values
