"""TorchRL's storages, with the signals of every slot beside the data."""

from torchrl_mpfa.storages.base import SignalStorageMixin
from torchrl_mpfa.storages.memmap import SignalMemmapStorage
from torchrl_mpfa.storages.table import SignalTable
from torchrl_mpfa.storages.tensor import SignalTensorStorage

__all__ = ["SignalMemmapStorage", "SignalStorageMixin", "SignalTable", "SignalTensorStorage"]
