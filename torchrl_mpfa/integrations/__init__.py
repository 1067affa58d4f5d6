"""Parts for TorchRL's trainers and for Ray, each imported by its own module alone."""

from typing import Any

from torchrl_mpfa.lazy import find


def __getattr__(name: str) -> Any:
    """Import a module when it is first used, as the packages of some are extras."""
    return find(__name__, name, {})
