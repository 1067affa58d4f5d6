"""The mathematics of losses, and the signals of TorchRL's own."""

from typing import Any

from torchrl_mpfa.lazy import find
from torchrl_mpfa.losses.functional import bootstrap_target
from torchrl_mpfa.losses.torchrl import write_signals

__all__ = ["bootstrap_target", "write_signals"]


def __getattr__(name: str) -> Any:
    """Say of a name that went what replaces it."""
    return find(__name__, name, {})
