"""TorchRL's storages, with the signals of every slot in addition to the data."""

from torchrl_mpfa.storages.storage import SignalStorageMixin
from torchrl_mpfa.storages.table import SignalTable
from torchrl_mpfa.storages.tensor import SignalMemmapStorage, SignalTensorStorage

__all__ = ["SignalMemmapStorage", "SignalStorageMixin", "SignalTable", "SignalTensorStorage"]
