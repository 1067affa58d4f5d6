"""Saved data of a storage: the check before they are loaded, and the signals read from them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.saved import Entry, check_entries, count, wrong
from torchrl_mpfa.storages.schema import as_path
from torchrl_mpfa.storages.table import SignalTable


def read_metadata(folder: Path) -> tuple[int, bool]:
    """TorchRL's notes in a folder: the number of filled slots, and whether data are a pytree."""
    found = json.loads((folder / "storage_metadata.json").read_text(encoding="utf-8"))
    return found["len"], bool(found["is_pytree"])


def check_length(found: Any, max_size: int, signals: int | None) -> int:
    """The saved number of filled slots, which must be that of the signals where there are any."""
    check_entries("storage", {"_len": found}, [count("_len", high=max_size)])
    if signals is not None and found != signals:
        raise ValueError(f"the saved storage has {found} rows, its signals {signals}")
    return int(found)


def check_data_state(
    data: Any,
    stored: Any,
    *,
    length: int,
    ndim: int,
    max_size: int,
    allow_nonfinite: Sequence[NestedKey] | None,
) -> None:
    """Reject saved data that a storage cannot take.

    Args:
        data: The saved data, as a tensor, a tensordict or its state.
        stored: The data of the storage; None if there are none yet.
        length: Number of filled slots that are saved.
        ndim: How many dimensions of the storage count slots.
        max_size: Capacity of the storage.
        allow_nonfinite: Entries that may hold NaN and infinities; None if all may.

    Raises:
        KeyError: If an entry is missing.
        ValueError: If an entry is unknown, of another shape or dtype, or not finite.
    """
    saved, mine = _leaves(data), _leaves(stored)
    if not saved:
        if length:
            raise ValueError(f"the saved storage has {length} rows and no data")
        return
    for name, value in saved.items():
        if mine and name not in mine:
            raise ValueError(f"{name!r} of the saved storage is not in this one")
        if not mine and math.prod(value.shape[:ndim]) != max_size:
            words = f"of {max_size} slots"
            raise wrong("storage", name, words, f"shape {[*value.shape]}")
    may = set(saved if allow_nonfinite is None else (".".join(as_path(k)) for k in allow_nonfinite))

    def finite(value: Tensor) -> bool | Tensor:
        filled = value.reshape(max_size, -1)[:length]
        return math.isfinite(filled.sum().item()) or filled.isfinite()

    entries = []
    for name, like in (mine or saved).items():
        entry = Entry(name, wanted="finite", dtype=like.dtype, shape=tuple(like.shape))
        free = name in may or not like.is_floating_point()
        entries.append(entry if free else replace(entry, holds=finite))
    check_entries("storage", saved, entries)


def signals_of_data(table: SignalTable, data: Any, length: int) -> dict[str, Any]:
    """The signals that saved data would have got at their write, as a state of a table.

    Args:
        table: The table of the storage; it is not changed.
        data: The saved data, as a tensor, a tensordict or its state, checked for their form.
        length: Number of filled slots that are saved.

    Returns:
        What :meth:`SignalTable.load_state_dict` takes. Times go on from those of the table, so
        that a batch sampled before is known to be old.

    Raises:
        ValueError: If a reward or a signal is not one finite number per transition.
    """
    rows = rows_of_data(table, data, length)
    writes = table.writes + length
    rows[:, table.time_column] = torch.arange(table.writes, writes)
    return {**table.state_dict(), "size": length, "writes": writes, "rows": rows}


def rows_of_data(table: SignalTable, data: Any, length: int) -> Tensor:
    """Rows of a table as they would be read from stored data at their write.

    Args:
        table: The table; it is not changed.
        data: As in :func:`signals_of_data`.
        length: Number of filled slots.

    Returns:
        The rows of the filled slots.

    Raises:
        ValueError: If a reward or a signal is not one finite number per transition.
    """
    leaves = _leaves(data)
    entries = {
        key: leaves[name].reshape(table.capacity, -1)[:length]
        for key in table.read_keys
        if (name := ".".join(as_path(key))) in leaves
    }
    return table.read(entries, length) if length else table.blank(0)


def _leaves(data: Any) -> dict[str, Tensor]:
    """Tensors by name, nested names joined by dots as in a tensordict's state."""
    if isinstance(data, Tensor):
        return {"": data}
    if is_tensor_collection(data):
        found = data.items(include_nested=True, leaves_only=True)
        return {".".join(as_path(key)): v for key, v in found if isinstance(v, Tensor)}
    if isinstance(data, Mapping):
        return {str(key): value for key, value in data.items() if isinstance(value, Tensor)}
    return {}
