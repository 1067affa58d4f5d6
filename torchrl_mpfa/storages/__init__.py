"""TorchRL's storages, faster, and with room for the signals of a sampler beside the data."""

from typing import Any

from torchrl_mpfa.lazy import find
from torchrl_mpfa.storages.tensor import SignalMemmapStorage, SignalTensorStorage

__all__ = ["SignalMemmapStorage", "SignalTensorStorage"]


def __getattr__(name: str) -> Any:
    """Import a module when it is first used."""
    return find(__name__, name, {})
