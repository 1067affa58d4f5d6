"""Tables with rows by robot that grow."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_Scalar = TypeVar("_Scalar", bound=np.generic)


def grown(table: NDArray[_Scalar], *sides: int) -> NDArray[_Scalar]:
    """The table, or a larger copy where its axes after the first are shorter than these sides."""
    shape = table.shape
    wanted = (shape[0], *map(max, shape[1:], sides), *shape[len(sides) + 1 :])
    if wanted == shape:
        return table
    wider: NDArray[Any] = np.zeros(wanted, dtype=table.dtype)
    wider[tuple(map(slice, shape))] = table
    return wider
