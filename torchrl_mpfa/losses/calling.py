"""Networks that hold the tensors of a loss, called as functions of tensors where that is possible.

TorchRL swaps parameters in and out of one module at every call, and passes tensordicts. With
networks of a hundred units both take longer than the network itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.func import functional_call
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mpfa.networks import DirectModule

Tensors = Mapping[NestedKey, Tensor]
"""Tensors by key."""


@dataclass
class Networks:
    """The networks of a loss."""

    actor: Any
    critic: Any
    """The critic, or the :class:`StackedNetworks` of several."""
    frozen_critics: list[TensorDictModule]
    """Each critic, for gradients to flow through: it gets none itself."""
    target_actor: Any
    target_critics: list[TensorDictModule]


def bind(network: TensorDictModule, params: TensorDictBase) -> TensorDictModule:
    """Copy a network that holds these parameters, the same tensors and not copies of them."""
    copied = deepcopy(network)
    params.to_module(copied)
    return copied


def bind_frozen(network: TensorDictModule, params: TensorDictBase) -> list[TensorDictModule]:
    """As :func:`bind`, of each of the parameters if they are stacked; they get no gradient."""
    params = params.detach()
    each = params.unbind(0) if params.batch_size else [params]
    return [bind(network, own).requires_grad_(False) for own in each]


def read_inputs(
    network: TensorDictModule, source: TensorDictBase, chosen: Tensors | None = None
) -> dict[NestedKey, Tensor]:
    """Inputs of a network: those that were chosen, and the rest of ``source``, detached."""
    chosen = chosen or {}
    return {key: chosen[key] if key in chosen else source[key].detach() for key in network.in_keys}


def call(
    network: TensorDictModule, source: TensorDictBase, chosen: Tensors | None = None
) -> dict[NestedKey, Tensor]:
    """Outputs of a network for the inputs of :func:`read_inputs`."""
    inputs = read_inputs(network, source, chosen)
    if isinstance(network, DirectModule):
        return network.outputs(inputs)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found = network(TensorDict(inputs))
    return {key: value for key in network.out_keys if (value := found.get(key)) is not None}


class StackedNetworks:
    """Networks of one structure whose parameters are stacked, ``[C, ...]``, called in turn.

    With two small networks ``torch.vmap`` costs twice as much.
    """

    def __init__(self, network: TensorDictModule, params: TensorDictBase) -> None:
        self.network = deepcopy(network)
        names = _by_name(params)
        if isinstance(network, DirectModule):  # Its own module is called, which knows no prefix.
            names = {name.removeprefix("module."): value for name, value in names.items()}
        self._params = names

    def call(self, source: TensorDictBase, chosen: Sequence[Tensors]) -> list[Tensors]:
        """Outputs of each network for what was chosen for it, see :func:`call`."""
        split = {name: value.unbind(0) for name, value in self._params.items()}
        found: list[Tensors] = []
        for place, instead in enumerate(chosen):
            weights = {name: value[place] for name, value in split.items()}
            inputs = read_inputs(self.network, source, instead)
            if isinstance(self.network, DirectModule):
                out = functional_call(self.network.module, weights, tuple(inputs.values()))
                found.append(self.network.by_key(out))
                continue
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                out = functional_call(self.network, weights, (TensorDict(inputs),))
            found.append(dict(out.items(True, True)))
        return found


def _by_name(params: TensorDictBase) -> dict[str, Tensor]:
    flat = params.flatten_keys(".").items()
    return {name: value for name, value in flat if isinstance(value, Tensor)}


def check_networks(actor: Any, critic: Any, *, critic_name: str) -> None:
    """Reject what are no networks, and networks in the wrong order."""
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
