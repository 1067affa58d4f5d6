"""Slots in TorchRL's forms, and the random shares by which they are found."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import is_tensor_collection
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.storages.entries import as_integers

_ORDERED = 2048
"""Rows up to which writing by index keeps their order."""


def in_dimensions_of(storage: Storage, slots: Tensor) -> Any:
    """Unravel flat slots into TorchRL's index: a tuple for several dimensions, else the slots."""
    if getattr(storage, "ndim", 1) == 1:
        return slots
    return torch.unravel_index(slots, storage.shape)


def as_slots(index: Any, storage: Any = None) -> Tensor:
    """Return flat slots ``[B]`` of slots, of places ``[B, D]``, or of a tuple of ``D`` places."""
    if isinstance(index, tuple):
        index = torch.stack([as_integers(places).reshape(-1) for places in index], -1)
    if isinstance(index, Tensor) and index.dtype is torch.long and index.ndim == 1:
        return index.resolve_neg()
    slots = as_integers(index)
    if slots.ndim <= 1 or len(slots) == 0 or getattr(storage, "ndim", 0) == 1:
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
    """Return the last position of each slot, by slot, shape ``[U]``, or None if order is kept.

    A slot that is written twice keeps its last value, which index writes of many rows do not
    ensure. On devices other than the CPU the result is the last position of the slot at each
    position, ``[B]``: the host does not wait for the number of slots.
    """
    if not slots.is_cpu:
        ordered, position = slots.sort(stable=True)
        return position[torch.searchsorted(ordered, slots, right=True) - 1]
    count = slots.numel()
    if count <= _ORDERED:
        return None
    # One number for slot and position, as sorting numbers costs half of what unique() does.
    width = count.bit_length()
    both = (slots.numpy() << width) + np.arange(count)
    both.sort()
    slot = both >> width
    last = np.append(slot[1:] != slot[:-1], True)
    return None if last.all() else torch.from_numpy(both[last] & ((1 << width) - 1))


class Steps:
    """Stored transitions by their flat slots, an entry at a time."""

    def __init__(self, storage: Any, slots: Tensor) -> None:
        self._slots, self._ndim = slots, storage.ndim
        stored = storage._storage
        self._stored = stored if is_tensor_collection(stored) else {}

    def get(self, key: Any, default: Any = None) -> Any:
        """Return an entry of the transitions, shape ``[B, ...]``."""
        entry = self._stored.get(key, None)
        if entry is None:
            return default
        return entry.flatten(0, self._ndim - 1)[self._slots.to(entry.device)]
