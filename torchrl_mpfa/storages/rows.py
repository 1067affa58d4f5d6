"""Rows of stored transitions, read and written by compiled loops where these are there."""

from __future__ import annotations

from array import array
from collections.abc import Container, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_mpfa.native import address, find_loops, is_plain, opaque

WIDTH = 4
"""Numbers of a column: addresses of what is stored and of the rows, bytes of a row, precision.

Precision is 4 or 8 where numbers must be finite, and 0 for all else."""
_NUMBERS = {torch.float: 4, torch.double: 8}


@opaque
def rows_at(
    stored: Any, slots: Tensor, filled: int, more: Mapping[str, Tensor] | None = None
) -> TensorDict | None:
    """Return rows of a tensordict, batch size ``[B]``; None where PyTorch has to read them.

    Further entries, each of them ``[B, ...]``, take the place of stored ones.
    """
    columns: list[int] = []
    if (rows := _empty_rows(stored, len(slots), columns, more or {})) is None:
        return None
    return None if _call("gather", columns, slots, filled) else rows


@opaque
def write_rows(stored: Any, slots: Tensor, data: TensorDict) -> bool:
    """Write rows of a tensordict; return False, and write nothing, where PyTorch has to."""
    columns: list[int] = []
    values: list[Tensor] = []  # Kept until they are written.
    if not match_rows(stored, data, len(slots), columns, values):
        return False
    return not _call("scatter", columns, slots, stored.batch_size[0])


def _call(loop: str, columns: list[int], slots: Tensor, end: int) -> int:
    """Call a compiled loop; return 1 if a slot is not below an end, and nothing was done."""
    table = array("q", columns)
    slots = slots.contiguous()
    rows = table.buffer_info()[0], len(columns) // WIDTH
    wrong: int = getattr(find_loops(), loop)(*rows, address(slots, torch.long), len(slots), end)
    return wrong


def _empty_rows(
    stored: TensorDict, count: int, columns: list[int], more: Mapping[str, Tensor]
) -> TensorDict | None:
    """Return a tensordict for so many rows, and list its columns."""
    rows: dict[str, Any] = {}
    for key, value in stored.items():
        if key in more:
            continue
        if type(value) is TensorDict:
            if (below := _empty_rows(value, count, columns, {})) is None:
                return None
            rows[key] = below
        elif isinstance(value, Tensor) and is_plain(value):
            rows[key] = row = value.new_empty((count, *value.shape[1:]))
            columns += (value.data_ptr(), row.data_ptr(), row.nbytes // count, 0)
        else:
            return None
    # As TorchRL does inside: the constructor would check what fits, for two thirds of the time.
    size = torch.Size((count, *stored.batch_size[1:]))
    return TensorDict._new_unsafe({**rows, **more}, batch_size=size, device=stored.device)


def match_rows(
    stored: TensorDict,
    data: TensorDict,
    count: int,
    columns: list[int],
    values: list[Tensor],
    absent: int = 0,
    allowed: Container[tuple[str, ...]] | None = None,
    path: tuple[str, ...] = (),
) -> bool:
    """List the columns of new rows, and the values that they point to.

    Return False if the rows are not of the form of the stored ones, of whose entries so many may be
    absent. With entries that are ``allowed`` not to be finite, those of a precision that C does not
    know are looked at here, and False is returned if another one is not finite.
    """
    if len(stored.keys()) != len(data.keys()) + absent:
        return False
    for key, value in data.items():
        into = stored.get(key, None)
        if type(into) is TensorDict and type(value) is TensorDict:
            below = (*path, key)
            if not match_rows(into, value, count, columns, values, 0, allowed, below):
                return False
        elif (
            isinstance(into, Tensor)
            and isinstance(value, Tensor)
            and into.dtype is value.dtype
            and value.shape == (count, *into.shape[1:])
            and is_plain(into)
            and value.layout is torch.strided
            and is_plain(value := value.contiguous())
            and not value.is_complex()
        ):
            values.append(value)
            number = _NUMBERS.get(value.dtype, 0)
            if allowed is not None and value.is_floating_point():
                if (*path, key) in allowed:
                    number = 0
                elif not number and not bool(value.float().isfinite().all()):
                    return False
            columns += (into.data_ptr(), value.data_ptr(), value.nbytes // count, number)
        else:
            return False
    return True
