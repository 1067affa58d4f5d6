"""What the losses refuse before TorchRL's constructors change anything."""

from __future__ import annotations

from typing import Any


def check_networks(actor: Any, critic: Any, *, critic_name: str) -> None:
    """Refuse what are no networks, and those in the wrong order."""
    first = critic[0] if isinstance(critic, list) and critic else critic
    for name, network in (("actor_network", actor), (critic_name, first)):
        if not hasattr(network, "in_keys") or not hasattr(network, "out_keys"):
            raise TypeError(f"{name} must be a TensorDictModule, got {type(network).__name__}")
    swapped = sorted(map(str, set(first.out_keys) & set(actor.in_keys)))
    if swapped:
        raise ValueError(
            f"actor_network and {critic_name} are in the wrong order: actor_network reads "
            f"{swapped[0]!r}, which {critic_name} writes"
        )
    if not set(actor.out_keys) & set(first.in_keys):
        raise ValueError(
            f"{critic_name} must read what actor_network writes, {list(actor.out_keys)}, but "
            f"reads {list(first.in_keys)}"
        )
