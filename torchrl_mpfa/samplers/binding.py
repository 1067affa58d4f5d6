"""What ties a sampler to a storage: the signals of its slots."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl.data import Storage

from torchrl_mpfa.signals import Signal
from torchrl_mpfa.storages.table import SignalTable


def signal_table_of(storage: Storage, signals: Sequence[Signal], capacity: int) -> SignalTable:
    """The signals of a storage, which must fit the signals and the capacity of a sampler."""
    table = getattr(storage, "signal_table", None)
    if not isinstance(table, SignalTable):
        raise TypeError(
            f"storage must keep signals (SignalTensorStorage, SignalMemmapStorage), got "
            f"{type(storage).__name__}"
        )
    if table.capacity != capacity:
        raise ValueError(
            f"max_capacity of the sampler is {capacity}, max_size of the storage {table.capacity}"
        )
    absent = [signal.name for signal in signals if signal.name not in table.column]
    if absent:
        raise ValueError(f"signals {absent} of the sampler are not in the storage: {table.names}")
    return table
