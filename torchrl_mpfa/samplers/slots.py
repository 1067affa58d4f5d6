"""Slots: in the forms that TorchRL has them in, and as its segment trees take them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.samplers.leaves import Leaves

_ORDERED = 2048
"""Rows up to which writing by index keeps their order."""


def in_dimensions_of(storage: Storage, slots: Tensor) -> Any:
    """Slots as TorchRL's sampler gives them: a tuple of places for several dimensions."""
    if getattr(storage, "ndim", 1) == 1:
        return slots
    return torch.unravel_index(slots, storage.shape)


def as_slots(index: Any, storage: Any = None) -> Tensor:
    """Slots ``[B]`` along the flattened storage, from slots or places ``[B, D]`` or a tuple."""
    if isinstance(index, tuple):
        index = torch.stack([torch.as_tensor(each).reshape(-1) for each in index], -1)
    if isinstance(index, Tensor) and index.dtype is torch.long and index.ndim == 1:
        return index
    slots = torch.as_tensor(index)
    if slots.numel() == 0:
        return slots.new_empty(0, dtype=torch.long)
    # A mask would be read as slots 0 and 1.
    if slots.dtype is torch.bool or slots.is_floating_point() or slots.is_complex():
        raise TypeError(f"index must hold integers, got {slots.dtype}")
    slots = slots.long()
    if slots.ndim <= 1:
        return slots.reshape(-1)
    # Not the filled part of it: a batch may be from before the storage was emptied.
    shape = getattr(storage, "_total_shape", None)
    if shape is None or len(shape) < 2 or len(shape) != slots.shape[-1]:
        raise RuntimeError(
            f"index must have one dimension, or one place for each dimension of a storage, got "
            f"shape {[*slots.shape]} for a storage of shape {None if shape is None else [*shape]}"
        )
    places = slots.reshape(-1, len(shape))
    # TorchRL's writers mark with -1 what was not stored.
    skipped = (places == -1).all(-1)
    wrong = ((places < 0) | (places >= places.new_tensor(shape))).any(-1) & ~skipped
    if bool(wrong.any()):
        raise IndexError(
            f"index must be within the storage's shape {[*shape]}, got {places[wrong][0].tolist()}"
        )
    slots = places[:, 0]
    for dimension in range(1, len(shape)):
        slots = slots * shape[dimension] + places[:, dimension]
    return torch.where(skipped, -1, slots)


def last_of_each(slots: Tensor) -> Tensor | None:
    """Last position of each slot, by slot, shape ``[U]``; None if all can be written as they are.

    A slot that is written twice keeps its last value; index writes of many rows leave it open. On
    another device than the CPU it is the last position of the slot at each position, ``[B]``: how
    many slots there are is not waited for.
    """
    if not slots.is_cpu:
        ordered, position = slots.sort(stable=True)
        return position[torch.searchsorted(ordered, slots, right=True) - 1]
    count = len(slots)
    if count <= _ORDERED:
        return None
    # One number for slot and position, as sorting numbers costs half of what unique() does.
    width = count.bit_length()
    both = (slots.numpy() << width) + np.arange(count)
    both.sort()
    slot = both >> width
    last = np.append(slot[1:] != slot[:-1], True)
    return None if last.all() else torch.from_numpy(both[last] & ((1 << width) - 1))


def leaves_of(tree: Any, slots: Tensor) -> Tensor:
    """Leaves of slots, shape ``[B]``."""
    if isinstance(tree, Leaves):
        return tree[slots]
    # Given a tensor, the binding first tries it as a number, and spends ten times as long on the
    # error as on the leaves. Of an array it reads the memory from the start, without strides.
    return torch.from_numpy(tree[slots.contiguous().numpy()])


def set_leaves(slots: Tensor, leaf: Tensor, *trees: Any) -> None:
    """Write leaves of slots, shape ``[B]``; of a slot that appears twice, the last one counts."""
    flat = isinstance(trees[0], Leaves)
    places = slots if flat else slots.contiguous().numpy()
    values = leaf if flat else leaf.contiguous().numpy()
    for tree in trees:
        tree[places] = values
