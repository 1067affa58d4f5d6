"""The place of ``ReplayHistory`` in 0.4: an import from here says where it is."""

from typing import Any

from torchrl_mpfa.lazy import find


def __getattr__(name: str) -> Any:
    """Say of a name that went what replaces it."""
    return find(__name__, name, {})
