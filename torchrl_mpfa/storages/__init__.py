"""TorchRL's storages, faster, and with room for the signals of a sampler beside the data."""

from torchrl_mpfa.storages.tensor import SignalMemmapStorage, SignalTensorStorage

__all__ = ["SignalMemmapStorage", "SignalTensorStorage"]
