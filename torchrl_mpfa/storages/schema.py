"""Keys, shapes and dtypes of stored transitions, which new transitions must have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Union

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

INDEX_KEY = "index"
"""Entry in which TorchRL's writers put the slot."""

Pairs = list[tuple[Tensor, Tensor]]
_Path = tuple[str, ...]
_Tree = dict[str, Union["_Entry", "_Tree"]]


@dataclass(frozen=True)
class _Entry:
    stored: Tensor
    row: torch.Size  # Shape of one transition's.
    dtype: torch.dtype
    finite: bool  # True if NaN and infinities are rejected.


class Schema:
    """Keys, shapes and dtypes of the transitions in a storage, ``ndim`` dimensions of slots."""

    def __init__(
        self, stored: TensorDictBase, ndim: int, allow_nonfinite: Sequence[NestedKey] = ()
    ) -> None:
        self._tree = _describe(stored, ndim, {as_path(key) for key in allow_nonfinite}, ())
        index = self._tree.get(INDEX_KEY)
        self.index = index.stored if isinstance(index, _Entry) else None
        self.only_tensors = _count(self._tree) == len(stored.keys(True, True))
        self._first = next(((k, e) for k, e in self._tree.items() if type(e) is _Entry), None)

    def describes(self, stored: TensorDictBase) -> bool:
        """True if the tensors of a storage are still those that were described."""
        return self._first is not None and stored.get(self._first[0]) is self._first[1].stored

    def check(self, data: TensorDictBase, lead: int, *, whole: bool) -> Pairs:
        """Return pairs of a stored entry and its new values, of ``lead`` dimensions of rows.

        Raises:
            KeyError: If ``whole`` and an entry is unknown or missing.
            ValueError: If shape or dtype differ, or, if ``whole``, a number is not finite.
        """
        pairs: Pairs = []
        _match(self._tree, data, lead, whole, (), pairs)
        return pairs


def check_finite_entries(
    data: TensorDictBase, lead: int, allow_nonfinite: Sequence[NestedKey] = ()
) -> None:
    """Reject a number in the transitions that is not finite, naming its entry and row."""
    allowed = {as_path(key) for key in allow_nonfinite}
    for key, value in data.items(include_nested=True, leaves_only=True):
        path = as_path(key)
        if isinstance(value, Tensor) and value.is_floating_point() and path not in allowed:
            _check_finite(value, lead, path)


def as_index(index: Any) -> Any:
    """Return the index in such an entry of an ensemble's batch; anything else as it is."""
    if is_tensor_collection(index) and (index := index.get(INDEX_KEY, None)) is None:
        raise TypeError(f"index must hold integers, got a tensordict without {INDEX_KEY!r}")
    return index


def as_integers(index: Any) -> Tensor:
    """Return an index of any form but a tuple as a tensor of integers."""
    if isinstance(index, Tensor) and index.dtype is torch.long:
        return index.resolve_neg()
    index = as_index(index)
    try:
        integers = torch.as_tensor(index, device=getattr(index, "device", "cpu"))
    except (RuntimeError, TypeError, ValueError):
        raise TypeError(f"index must hold integers, got {index!r}") from None
    if integers.ndim and len(integers) == 0:
        return integers.long()
    # A mask would be read as slots 0 and 1, and tensordicts in a list as nothing.
    if integers.dtype is torch.bool or integers.is_floating_point() or integers.is_complex():
        raise TypeError(f"index must hold integers, got {integers.dtype}")
    return integers.long().resolve_neg()


def as_path(key: NestedKey) -> _Path:
    """Return a key of a tensordict as a tuple."""
    return (key,) if isinstance(key, str) else tuple(key)


def _describe(stored: TensorDictBase, ndim: int, allowed: set[_Path], path: _Path) -> _Tree:
    tree: _Tree = {}
    for key, value in stored.items():
        if isinstance(value, TensorDictBase):
            tree[key] = _describe(value, ndim, allowed, (*path, key))
        elif isinstance(value, Tensor):
            finite = value.is_floating_point() and (*path, key) not in allowed
            tree[key] = _Entry(value, value.shape[ndim:], value.dtype, finite)
    return tree


def _count(tree: _Tree) -> int:
    return sum(1 if isinstance(entry, _Entry) else _count(entry) for entry in tree.values())


def _match(
    tree: _Tree, data: TensorDictBase, lead: int, whole: bool, path: _Path, pairs: Pairs
) -> None:
    matched = 0
    for key, value in data.items():
        expected = tree.get(key)
        if type(expected) is _Entry:
            _check_form(expected, value, lead, path, key)
            if whole and expected.finite:
                _check_finite(value, lead, (*path, key))
            pairs.append((expected.stored, value))
        elif isinstance(expected, dict):
            if not isinstance(value, TensorDictBase):
                raise ValueError(f"entry {_name(path, key)} must hold entries, got {_kind(value)}")
            _match(expected, value, lead, whole, (*path, key), pairs)
        elif whole and isinstance(value, Tensor | TensorDictBase) and key != INDEX_KEY:
            raise KeyError(
                f"entry {_name(path, key)} is not in the storage, whose first transitions did not "
                "have it: leave it out, or write it from the start"
            )
        matched += expected is not None
    if whole and matched != len(tree):
        for key in tree:
            if key != INDEX_KEY and data.get(key, None) is None:
                raise KeyError(f"entry {_name(path, key)} is missing in the transitions")


def _check_form(expected: _Entry, value: object, lead: int, path: _Path, key: str) -> None:
    if not isinstance(value, Tensor):
        raise ValueError(f"entry {_name(path, key)} must be a tensor, got {_kind(value)}")
    if value.dtype is not expected.dtype:
        raise ValueError(
            f"entry {_name(path, key)} must be {expected.dtype} as in the storage, got "
            f"{value.dtype}"
        )
    if value.shape[lead:] != expected.row:
        raise ValueError(
            f"entry {_name(path, key)} must have the shape {[*expected.row]} in each transition, "
            f"got {[*value.shape[lead:]]}"
        )


def _check_finite(value: Tensor, lead: int, path: _Path) -> None:
    if value.dtype.itemsize == 1:  # PyTorch cannot add up such numbers.
        value = value.float()
    # A sum is finite only if all of its terms are, and costs a third of asking each of them.
    if math.isfinite(value.sum().item()):
        return
    bad = (~value.isfinite()).nonzero()
    if len(bad) == 0:
        return
    place, row = bad[0].tolist(), bad[0][:lead].tolist()
    raise ValueError(
        f"entry {_name(path[:-1], path[-1])} must be finite, got {value[tuple(place)].item()} in "
        f"row {row[0] if len(row) == 1 else row}"
    )


def _kind(value: object) -> str:
    return type(value).__name__


def _name(path: _Path, key: str) -> str:
    return repr((*path, key) if path else key)
