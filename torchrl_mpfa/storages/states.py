"""What a saved storage must be to be loaded, checked before anything is."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.storages.schema import as_path
from torchrl_mpfa.storages.table import SignalTable


def check_length(found: Any, max_size: int, signals: int | None) -> int:
    """Refuse a number of filled slots that cannot be.

    Args:
        found: The saved number.
        max_size: Capacity of the storage.
        signals: Number of filled slots in the saved signals; None if there are none.

    Returns:
        The number.

    Raises:
        ValueError: If it is not in the range, or not that of the signals.
    """
    if type(found) is not int or not 0 <= found <= max_size:
        raise ValueError(f"'_len' of the saved storage must be in [0, {max_size}], got {found!r}")
    if signals is not None and found != signals:
        raise ValueError(f"the saved storage has {found} rows, its signals {signals}")
    return found


def read_metadata(folder: Path, max_size: int, signals: int) -> tuple[int, bool]:
    """What TorchRL wrote about a storage to a folder.

    Args:
        folder: The folder.
        max_size: Capacity of the storage.
        signals: Number of filled slots in the saved signals.

    Returns:
        The number of filled slots, checked as above, and whether the data are no tensordict.
    """
    found = json.loads((folder / "storage_metadata.json").read_text(encoding="utf-8"))
    return check_length(found["len"], max_size, signals), bool(found["is_pytree"])


def check_data_state(
    data: Any,
    stored: Any,
    *,
    length: int,
    ndim: int,
    max_size: int,
    allow_nonfinite: Sequence[NestedKey] | None,
) -> None:
    """Refuse saved data of another form than those in a storage.

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
    if length and not saved:
        raise ValueError(f"the saved storage has {length} rows and no data")
    if mine and saved:
        for name in mine:
            if name not in saved:
                raise KeyError(f"entry {name!r} is missing in the saved storage")
    for name, value in saved.items():
        if mine and name not in mine:
            raise ValueError(f"entry {name!r} of the saved storage is not in this one")
        form = (mine[name].shape, mine[name].dtype) if mine else (value.shape, value.dtype)
        if (value.shape, value.dtype) != form:
            raise ValueError(
                f"entry {name!r} of the saved storage has shape {[*value.shape]} and dtype "
                f"{value.dtype}, that of this one {[*form[0]]} and {form[1]}"
            )
        if math.prod(value.shape[:ndim]) != max_size:
            raise ValueError(
                f"entry {name!r} of the saved storage has shape {[*value.shape]}, which is not "
                f"{max_size} slots"
            )
        if allow_nonfinite is not None and value.is_floating_point():
            allowed = {".".join(as_path(key)) for key in allow_nonfinite}
            filled = value.reshape(max_size, -1)[:length]
            if name not in allowed and not _all_finite(filled):
                raise ValueError(f"entry {name!r} of the saved storage must be finite")


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


def _all_finite(value: Tensor) -> bool:
    return math.isfinite(value.sum().item()) or bool(value.isfinite().all())


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
