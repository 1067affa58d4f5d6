"""Slots of a storage: what names them, in one dimension or several, and the order of writes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

SERIAL = 2048
"""Rows up to which writing by index goes in their order."""


def as_slots(index: Any, storage: Any = None) -> Tensor:
    """Slots as numbers, whatever names them.

    Args:
        index: A number, numbers of shape ``[B]``, or places in a storage of ``D`` dimensions: a
            tensor of shape ``[B, D]``, or a tuple of ``D`` tensors of shape ``[B]``.
        storage: The storage, which places in several dimensions need.

    Returns:
        Slots counted along the flattened storage, shape ``[B]``, on the CPU.

    Raises:
        TypeError: If the index holds anything but integers: a mask would be read as slots 0 and 1.
        RuntimeError: If it has several dimensions and the storage has one, or is not given.

    Examples:
        >>> as_slots([3, 1])
        tensor([3, 1])
    """
    if isinstance(index, tuple):
        index = torch.stack([torch.as_tensor(each).reshape(-1) for each in index], -1)
    slots = torch.as_tensor(index, device="cpu")
    if slots.numel() == 0:
        return slots.new_empty(0, dtype=torch.long)
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
    return _flattened(slots.reshape(-1, len(shape)), shape)


def _flattened(places: Tensor, shape: torch.Size) -> Tensor:
    limits = torch.tensor(shape)
    outside = (places < 0) | (places >= limits)
    # TorchRL's writers mark with -1 what was not stored.
    skipped = (places == -1).all(-1)
    wrong = outside.any(-1) & ~skipped
    if bool(wrong.any()):
        raise IndexError(
            f"index must be within the storage's shape {[*shape]}, got {places[wrong][0].tolist()}"
        )
    slots = places[:, 0]
    for dimension in range(1, len(shape)):
        slots = slots * shape[dimension] + places[:, dimension]
    return torch.where(skipped, -1, slots)


def last_of_each(slots: Tensor) -> Tensor | None:
    """Where each slot appears last, shape ``[U]``; None if every slot appears once.

    Of a slot that is written twice in one call the last must win, which writing by index leaves
    open for large batches.
    """
    unique, inverse = slots.unique(return_inverse=True)
    if len(unique) == len(slots):
        return None
    places = torch.arange(len(slots))
    return torch.zeros_like(unique).scatter_reduce_(0, inverse, places, "amax")
