"""Several pictures as one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count


def tiled(
    pictures: Sequence[NDArray[np.uint8]], *, columns: int | None = None, gap: int = 8
) -> NDArray[np.uint8]:
    """Put pictures side by side, row by row.

    Args:
        pictures: Each of shape ``[height, width, 3]``; smaller ones are filled up with white.
        columns: Pictures in a row; None: as many as there are rows.
        gap: White between two of them [px].

    Returns:
        One picture.

    Raises:
        ValueError: If there is no picture, or an argument is out of its range.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs.render import tiled
        >>> tiled([np.zeros((40, 50, 3), np.uint8)] * 3).shape
        (88, 108, 3)
    """
    if not pictures:
        raise ValueError("pictures must not be empty")
    if columns is None:
        columns = math.ceil(math.sqrt(len(pictures)))
    check_count("gap", gap, least=0)
    columns = min(check_count("columns", columns), len(pictures))
    height, width = (max(each.shape[axis] for each in pictures) for axis in (0, 1))
    lines = math.ceil(len(pictures) / columns)
    shape = lines * (height + gap) - gap, columns * (width + gap) - gap, 3
    whole = np.full(shape, 255, dtype=np.uint8)
    for number, each in enumerate(pictures):
        top = number // columns * (height + gap)
        left = number % columns * (width + gap) + (width - each.shape[1]) // 2
        whole[top : top + each.shape[0], left : left + each.shape[1]] = each
    return whole
