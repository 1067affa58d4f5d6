"""Methods that the paper compares with, and newer ones: one file each that needs code of its own.

What is a choice of other parts has no file: it is a few lines of configuration.
"""

from typing import Any

from torchrl_mpfa.methods.assembly import Replay, loss_options, make_replay
from torchrl_mpfa.methods.catalogue import ALIASES, METHODS, Method
from torchrl_mpfa.methods.remote import (
    MethodReplayBuffer,
    RaySignalReplayBuffer,
    can_be_remote,
    make_ray_replay,
)
from torchrl_mpfa.renamed import OF_METHODS, find

__all__ = [
    "ALIASES",
    "METHODS",
    "Method",
    "MethodReplayBuffer",
    "RaySignalReplayBuffer",
    "Replay",
    "can_be_remote",
    "loss_options",
    "make_ray_replay",
    "make_replay",
]


def __getattr__(name: str) -> Any:
    """Old names, which warn."""
    return find(__name__, name, OF_METHODS)
