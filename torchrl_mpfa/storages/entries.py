"""Keys and indices of stored transitions, and the check that numbers are finite."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

INDEX_KEY = "index"
"""Entry in which TorchRL's writers put the slot."""


def check_finite_entries(
    data: TensorDictBase, lead: int, allow_nonfinite: Sequence[NestedKey] = ()
) -> None:
    """Reject a number in the transitions that is not finite, naming its entry and row."""
    allowed = {as_path(key) for key in allow_nonfinite}
    for key, value in data.items(include_nested=True, leaves_only=True):
        path = as_path(key)
        if isinstance(value, Tensor) and value.is_floating_point() and path not in allowed:
            check_finite(value, lead, path)


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


def as_path(key: NestedKey) -> tuple[str, ...]:
    """Return a key of a tensordict as a tuple."""
    return (key,) if isinstance(key, str) else tuple(key)


def check_finite(value: Tensor, lead: int, path: tuple[str, ...]) -> None:
    """Reject a number of an entry that is not finite, naming its row."""
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
        f"entry {named(path)} must be finite, got {value[tuple(place)].item()} in "
        f"row {row[0] if len(row) == 1 else row}"
    )


def named(path: tuple[str, ...]) -> str:
    """Return the name of an entry as its user writes it."""
    return repr(path if len(path) > 1 else path[0])
