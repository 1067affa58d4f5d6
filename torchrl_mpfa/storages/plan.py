"""What is known of all rows of a storage once its first row was written."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.native import address, find_loops, is_plain, loops, opaque
from torchrl_mpfa.storages.entries import INDEX_KEY, as_path, check_finite, named

_WIDTH = 5
"""Numbers of a column: addresses of what is stored and of the rows, bytes of a row, its precision,
and bytes from one stored row to the next.

Precision is 4 or 8 where numbers must be finite, and 0 for all else."""
_NUMBERS = {torch.float: 4, torch.double: 8}
_FEW = 16
"""Pages that a batch may wait for before pages are asked for."""
_LOOK = 16
"""Batches until it is seen again whether that is needed: asking for what is there takes time."""
_Path = tuple[str, ...]
_Tree = dict[str, "_Entry | _Branch"]


@dataclass(frozen=True)
class _Entry:
    stored: Tensor
    row: torch.Size  # Shape of one transition's.
    dtype: torch.dtype
    finite: bool  # True if NaN and infinities are rejected.
    place: int  # Of its column.


@dataclass(frozen=True)
class _Branch:
    stored: TensorDictBase
    count: int  # Of all its entries, of which the tree has those with numbers.
    tree: _Tree


class RowPlan:
    """Keys, shapes and dtypes of stored transitions, which new ones must have, and their memory.

    Args:
        stored: The tensordict of a storage, whose tensors are as long as the storage.
        ndim: Its dimensions of slots.
        allow_nonfinite: Entries that may hold NaN and infinities.

    Examples:
        >>> plan = RowPlan(TensorDict({"reward": torch.zeros(8, 1)}, [8]), 1)
        >>> plan.check(TensorDict({"reward": torch.zeros(2)}, [2]), 1)
        Traceback (most recent call last):
        ...
        ValueError: entry 'reward' must have the shape [1] in each transition, got []
    """

    def __init__(
        self, stored: TensorDictBase, ndim: int, allow_nonfinite: Sequence[NestedKey] = ()
    ) -> None:
        self._allowed = {as_path(key) for key in allow_nonfinite}
        self._columns: list[int] = []
        # True while rows are waited for one after the other, as of a file larger than memory.
        self._is_cold, self._reads = False, 0
        self._is_mapped = False
        # True if compiled loops read and write all entries.
        self._by_c = ndim == 1 and find_loops() is not None
        self._root = self._describe(stored, ndim, ())

    def _describe(self, stored: TensorDictBase, ndim: int, path: _Path) -> _Branch:
        tree: _Tree = {}
        self._by_c &= type(stored) is TensorDict
        for key, value in stored.items():
            if isinstance(value, TensorDictBase):
                tree[key] = self._describe(value, ndim, (*path, key))
                continue
            if not isinstance(value, Tensor):
                self._by_c = False
                continue
            self._is_mapped |= isinstance(value, MemoryMappedTensor)
            number = value.is_floating_point() and (*path, key) not in self._allowed
            place = len(self._columns)
            tree[key] = _Entry(value, value.shape[ndim:], value.dtype, number, place)
            if self._by_c and is_plain(value[:1]):
                bytes_each = value.nbytes // len(value)
                precision = _NUMBERS.get(value.dtype, 0) if number else 0
                stride = value.stride(0) * value.itemsize
                self._columns += (0, 0, bytes_each, precision, stride)
            else:
                self._by_c = False
        return _Branch(stored, len(stored.keys()), tree)

    def describes(self, stored: Any) -> bool:
        """Return True if the tensors of a storage are still those that were described."""
        return stored is self._root.stored and _is_kept(self._root)

    @opaque
    def read(
        self, slots: Tensor, filled: int, beside: Mapping[str, Tensor] | None = None
    ) -> TensorDict | None:
        """Return rows of slots, batch size ``[B]``; None where PyTorch has to read them.

        Entries beside them, each of them ``[B, ...]``, take the place of stored ones.
        """
        if not self._by_c:
            return None
        columns = array("q", self._columns)
        slots, count = slots.contiguous(), slots.numel()
        rows = _empty(self._root, count, columns, beside or {})
        table = columns.buffer_info()[0], len(columns) // _WIDTH
        batch = address(slots, torch.long), count, filled
        gather = self._gather_mapped if self._is_mapped else loops().gather
        return None if gather(*table, *batch) else rows

    def _gather_mapped(self, *batch: int) -> int:
        """Copy rows out of files, whose pages are asked for first if they have to be waited for."""
        self._reads += 1
        if self._is_cold and self._reads % _LOOK:
            loops().ask(*batch)
            return int(loops().gather(*batch))
        before = loops().waits()
        wrong: int = loops().gather(*batch)
        self._is_cold = loops().waits() - before > _FEW
        return wrong

    @opaque
    def match(self, data: TensorDictBase, slots: Tensor | None = None) -> NewRows | None:
        """Return new rows as loops take them; None if PyTorch has to, or finds fault with them.

        Args:
            data: Rows, batch size ``[B]``.
            slots: The entry in which TorchRL's writers put the slot; None: the rows have it.
        """
        if not self._by_c or type(data) is not TensorDict or data.ndim != 1:
            return None
        if not 0 < len(data) <= self._root.stored.batch_size[0]:
            return None
        columns = array("q", self._columns)
        values: list[Tensor] = []
        entries = data._tensordict if slots is None else {**data._tensordict, INDEX_KEY: slots}
        if not _match(self._root.tree, entries, len(data), columns, values):
            return None
        rows = NewRows(columns, values, len(data), slots)
        return None if rows.is_wrong() else rows

    def check(self, data: TensorDictBase, lead: int) -> None:
        """Reject transitions that are not as the stored ones, with ``lead`` dimensions of rows.

        Raises:
            KeyError: If an entry is unknown or missing.
            ValueError: If shape or dtype differ, or a number is not finite.
        """
        _check(self._root.tree, data, lead, ())


@dataclass(frozen=True)
class NewRows:
    """Rows that fit a storage, and where their numbers lie."""

    columns: array[int]
    values: list[Tensor]  # Kept until they are written.
    count: int
    slots: Any  # The entry in which TorchRL's writers put the slot, if it was given.

    def __len__(self) -> int:
        return self.count

    def is_wrong(self) -> bool:
        """Return True if a number is not finite that must be."""
        first = self.columns.buffer_info()[0]
        return bool(loops().not_finite(first, len(self.columns) // _WIDTH, self.count))

    @opaque
    def write(self, slots: Tensor, end: int) -> bool:
        """Write the rows in so many slots below an end; return False, and do nothing, if not."""
        if len(slots) != self.count:
            return False
        slots = slots.contiguous()
        place = address(slots, torch.long)
        first = self.columns.buffer_info()[0]
        return not loops().scatter(first, len(self.columns) // _WIDTH, place, self.count, end)


def _is_kept(branch: _Branch) -> bool:
    """Return True if a tensordict still has the tensors that were described."""
    if type(branch.stored) is not TensorDict:  # Of which C reads nothing.
        return True
    entries = branch.stored._tensordict
    for key, expected in branch.tree.items():
        if entries.get(key) is not expected.stored:
            return False
        if type(expected) is _Branch and not _is_kept(expected):
            return False
    return len(entries) == branch.count


def _empty(
    branch: _Branch, count: int, columns: array[int], beside: Mapping[str, Tensor]
) -> TensorDict:
    """Return room for so many rows, whose addresses are put into the columns."""
    rows: dict[str, Any] = {}
    stored = branch.stored
    for key, entry in branch.tree.items():
        if key in beside:
            if isinstance(entry, _Entry):
                columns[entry.place + 2] = 0  # So many bytes are copied.
        elif isinstance(entry, _Entry):
            rows[key] = row = torch.empty((count, *entry.row), dtype=entry.dtype, device="cpu")
            _join(columns, entry, row)
        else:
            rows[key] = _empty(entry, count, columns, {})
    # As TorchRL does inside: the constructor would check what fits, for two thirds of the time.
    size = torch.Size((count, *stored.batch_size[1:]))
    return TensorDict._new_unsafe({**rows, **beside}, batch_size=size, device=stored.device)


def _match(
    tree: _Tree, entries: Mapping[str, Any], count: int, columns: array[int], values: list[Tensor]
) -> bool:
    """Put addresses of new rows into the columns; return False if they are of another form."""
    if len(entries) != len(tree):
        return False
    for key, entry in tree.items():
        value = entries.get(key)
        if isinstance(entry, _Branch):
            below = value._tensordict if isinstance(value, TensorDict) else None
            if type(value) is not TensorDict or not _match(
                entry.tree, below or {}, count, columns, values
            ):
                return False
        elif not (
            isinstance(value, Tensor)
            and value.dtype is entry.dtype
            and value.shape == (count, *entry.row)
            and value.layout is torch.strided
            and (is_plain(value) or is_plain(value := value.contiguous()))
            and not value.is_complex()
        ):
            return False
        else:
            if entry.finite and value.dtype not in _NUMBERS and not _all_finite(value):
                return False
            values.append(value)
            _join(columns, entry, value)
    return True


def _join(columns: array[int], entry: _Entry, rows: Tensor) -> None:
    """Put the addresses of an entry and of its rows into the columns."""
    # That of the entry may be another one than before, as of what became shared.
    columns[entry.place], columns[entry.place + 1] = entry.stored.data_ptr(), rows.data_ptr()


def _all_finite(value: Tensor) -> bool:
    """Return True if all numbers are finite, also of types that PyTorch cannot add up."""
    return bool(value.float().isfinite().all())


def _check(tree: _Tree, data: TensorDictBase, lead: int, path: _Path) -> None:
    """Reject new rows that are not of the form of a tree."""
    matched = 0
    for key, value in data.items():
        expected = tree.get(key)
        name = named((*path, key))
        if isinstance(expected, _Entry):
            _check_form(expected, value, lead, name)
            if expected.finite:
                check_finite(value, lead, (*path, key))
        elif expected is not None:
            if not isinstance(value, TensorDictBase):
                raise ValueError(f"entry {name} must hold entries, got {type(value).__name__}")
            _check(expected.tree, value, lead, (*path, key))
        elif isinstance(value, Tensor | TensorDictBase) and key != INDEX_KEY:
            raise KeyError(
                f"entry {name} is not in the storage, whose first transitions did not have it: "
                "leave it out, or write it from the start"
            )
        matched += expected is not None
    if matched != len(tree):
        for key in tree:
            if key != INDEX_KEY and data.get(key, None) is None:
                raise KeyError(f"entry {named((*path, key))} is missing in the transitions")


def _check_form(expected: _Entry, value: object, lead: int, name: str) -> None:
    if not isinstance(value, Tensor):
        raise ValueError(f"entry {name} must be a tensor, got {type(value).__name__}")
    if value.dtype is not expected.dtype:
        raise ValueError(
            f"entry {name} must be {expected.dtype} as in the storage, got {value.dtype}"
        )
    if value.shape[lead:] != expected.row:
        raise ValueError(
            f"entry {name} must have the shape {[*expected.row]} in each transition, got "
            f"{[*value.shape[lead:]]}"
        )
