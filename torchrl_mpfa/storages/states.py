"""Saved data of a storage: their check before they are loaded, and the signals read from them."""

from __future__ import annotations

import json
import math
from collections import OrderedDict
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
    """TorchRL's notes in a folder: number of filled slots, and whether the data are a pytree."""
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
    """Reject saved data that a storage, with the data ``stored`` so far, cannot take."""
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


def of_any_device(data: Any) -> Any:
    """Saved data without the name of their device, for which another device rejects them."""
    told = getattr(data, "_metadata", None)
    if told is None:
        return data
    copied = OrderedDict(data)
    copied._metadata = {name: {**each, "device": None} for name, each in told.items()}  # type: ignore[attr-defined]
    return copied


def signals_of_data(table: SignalTable, data: Any, length: int) -> dict[str, Any]:
    """The state of a table that had been filled when saved data were written."""
    rows = rows_of_data(table, data, length)
    # Times go on, so that a batch sampled before is known to be old.
    writes = table.writes + length
    rows[:, table.time_column] = torch.arange(table.writes, writes)
    return {**table.state_dict(), "size": length, "writes": writes, "rows": rows}


def rows_of_data(table: SignalTable, data: Any, length: int) -> Tensor:
    """Rows of a table, which is not changed, read from the filled slots of stored data."""
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
