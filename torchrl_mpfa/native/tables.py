"""Loops over a table of numbers in memory: rows ``[N, C]``, and of a batch its columns apart."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_mpfa.native import address, find_loops, is_plain, loops, opaque

_NUMBERS = (torch.float, torch.double)


def has_loops(table: Tensor) -> bool:
    """Return True if compiled loops read and write a table."""
    return table.is_cpu and find_loops() is not None


def fits(value: object, count: int, *dtypes: torch.dtype) -> bool:
    """Return True if this is a tensor of so many numbers, of one of these types, for C."""
    return (
        isinstance(value, Tensor)
        and value.dtype in dtypes
        and value.numel() == count
        and is_plain(value)
    )


@opaque
def describe(table: Tensor, numbers: Sequence[tuple[Tensor, int]], count: int) -> Tensor | None:
    """Return rows for new transitions, ``[B, C]``: NaN, a count of zero, and some numbers.

    Args:
        table: The table.
        numbers: Numbers ``[B]`` and their columns. Those after the first may not be negative.
        count: ``B``.

    Returns:
        None if numbers are of another type or length, or one is wrong.
    """
    sources = array("q")
    for value, column in numbers:
        if not fits(value, count, *_NUMBERS):
            return None
        sources.extend((value.data_ptr(), value.dtype.itemsize, column, len(sources) == 0))
    columns = torch.empty((table.shape[1], count), dtype=torch.double, device="cpu")
    place = sources.buffer_info()[0], len(numbers), *columns.shape, columns.data_ptr()
    return None if loops().describe(*place) else columns.T


@opaque
def join(
    table: Tensor,
    slots: Tensor,
    numbers: Sequence[Tensor | None],
    written_at: Tensor | None,
    end: int,
    checked: int,
) -> Tensor | None:
    """Return copies of rows with new numbers in the first columns, ``[B, C]``.

    Args:
        table: The table, whose last column has times of writing.
        slots: Rows below ``end``, shape ``[B]``.
        numbers: New numbers, each ``[B]`` in single precision.
        written_at: Times at which the rows must have been written, ``[B]``; None: at any.
        end: Slots that are filled.
        checked: First columns whose numbers must be finite and not negative.

    Returns:
        None if numbers are of another type or length, or a slot, time or number is wrong.
    """
    count = slots.numel()
    if not all(fits(value, count, torch.float) for value in numbers):
        return None
    if written_at is not None and not fits(written_at, count, torch.double):
        return None
    slots, places = slots.contiguous(), array("q", [v.data_ptr() for v in numbers if v is not None])
    rows = torch.empty((table.shape[1], count), dtype=torch.double, device="cpu")
    wrong = loops().join(
        *(table.data_ptr(), table.shape[1]),
        *(address(slots, torch.long), count, min(end, table.shape[0])),
        None if written_at is None else written_at.data_ptr(),
        *(places.buffer_info()[0], len(numbers), checked, rows.data_ptr()),
    )
    return None if wrong else rows.T


@opaque
def give(table: Tensor, slots: Tensor, rows: Tensor, count: int, *, time: int = -1) -> None:
    """Write the first columns of rows; the last of a slot counts.

    Args:
        table: The table.
        slots: Where they go, shape ``[B]``.
        rows: The rows, shape ``[B, C]``.
        count: Columns that are written.
        time: What the last column gets, rising by one from row to row; -1: it stays.
    """
    columns, slots = rows.T.contiguous(), slots.contiguous()
    batch = address(slots, torch.long), slots.numel(), table.shape[0]
    loops().give(table.data_ptr(), table.shape[1], count, *batch, columns.data_ptr(), time)


@opaque
def tally(table: Tensor, column: int, slots: Tensor) -> None:
    """Add one to a column for each slot, duplicates included."""
    slots = slots.contiguous()
    place = table.data_ptr(), table.shape[1], column
    loops().tally(*place, address(slots, torch.long), slots.numel())
