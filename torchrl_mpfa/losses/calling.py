"""Calling networks from a loss: as functions of tensors where that is possible.

TorchRL swaps parameters in and out of one module at every call, and passes tensordicts. With
networks of a hundred units both take longer than the network itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.func import functional_call
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mpfa.losses.averaging import AveragedNetwork
from torchrl_mpfa.networks import DirectModule

Tensors = Mapping[NestedKey, Tensor]
"""Tensors by key."""


def bind(network: TensorDictModule, params: TensorDictBase) -> TensorDictModule:
    """Copy a network that holds these parameters, the same tensors and not copies of them."""
    copied = deepcopy(network)
    params.to_module(copied)
    return copied


def read_inputs(
    network: TensorDictModule, source: TensorDictBase, instead: Tensors | None = None
) -> dict[NestedKey, Tensor]:
    """Collect what a network reads.

    Args:
        network: The network.
        source: Where its inputs are taken from, detached.
        instead: Tensors that take the place of those of ``source``.

    Returns:
        Inputs by key.
    """
    instead = instead or {}
    return {
        key: instead[key] if key in instead else source[key].detach() for key in network.in_keys
    }


def call(network: TensorDictModule, inputs: dict[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
    """Compute what a network gives, directly if it is a ``DirectModule``.

    Args:
        network: The network.
        inputs: What it reads, by key.

    Returns:
        Outputs by key.
    """
    if isinstance(network, DirectModule):
        return network.outputs(inputs)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found = network(TensorDict(inputs))
    return {key: value for key in network.out_keys if (value := found.get(key)) is not None}


def bare(params: TensorDictBase) -> dict[str, Tensor]:
    """Parameters by the names that the module in a :class:`DirectModule` has for them."""
    flat = params.flatten_keys(".").items()
    return {
        name.removeprefix("module."): value for name, value in flat if isinstance(value, Tensor)
    }


class StackedNetworks:
    """Networks of one structure whose parameters are stacked, called one after the other.

    With two small networks ``torch.vmap`` costs twice as much.

    Args:
        network: Any of them.
        params: Their parameters, batch size ``[C]``.
    """

    def __init__(self, network: TensorDictModule, params: TensorDictBase) -> None:
        self.network = deepcopy(network)
        flat = params.flatten_keys(".").items()
        self._params = {name: value for name, value in flat if isinstance(value, Tensor)}
        self.bare = bare(params)

    def call(self, inputs: Sequence[dict[NestedKey, Tensor]]) -> list[dict[NestedKey, Tensor]]:
        """Compute what each network gives for inputs of its own, as :func:`call` does for one."""
        direct = isinstance(self.network, DirectModule)
        split = {
            name: value.unbind(0) for name, value in (self.bare if direct else self._params).items()
        }
        pairs = [
            ({name: value[i] for name, value in split.items()}, each)
            for i, each in enumerate(inputs)
        ]
        if isinstance(self.network, DirectModule):
            keys, module = self.network.in_keys, self.network.module
            found = [
                functional_call(module, weights, tuple(each[key] for key in keys))
                for weights, each in pairs
            ]
            return [self.network.by_key(out) for out in found]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            outs = [
                functional_call(self.network, weights, (TensorDict(each),))
                for weights, each in pairs
            ]
        return [dict(out.items(True, True)) for out in outs]


@dataclass(frozen=True)
class Parts:
    """What a loss is made of, as functions of tensors."""

    actor: DirectModule
    """Policy that holds the current parameters."""
    critic: DirectModule
    """Any of the critics, for its structure."""
    critic_parameters: dict[str, Tensor]
    """Parameters of all critics, ``[C, ...]`` where they are stacked."""
    target_actor: DirectModule
    """Policy that holds the target parameters."""
    target_critics: Sequence[DirectModule]
    """``C`` critics that hold the target parameters."""
    target_parameters: tuple[dict[str, Tensor], dict[str, Tensor]]
    """Parameters of target actor and target critics, by the same names; those of an actor that has
    no target of its own are the current ones."""
    stacked: bool
    """Whether parameters of critics are stacked, be it of one."""
    action_bounds: tuple[Any, Any] | None = None
    """Least and greatest action of a smoothed target; None: targets are not smoothed."""
    target_noise: Callable[[Tensor], Tensor] | None = None
    """Noise of a smoothed target, for actions of the same shape."""

    def split(self, parameters: dict[str, Tensor]) -> list[dict[str, Tensor]]:
        """Parameters of each critic."""
        if not self.stacked:
            return [parameters]
        count = len(self.target_critics)
        return [{name: value[i] for name, value in parameters.items()} for i in range(count)]

    def of_targets(self, parameters: dict[str, Tensor]) -> list[dict[str, Tensor]]:
        """Parameters of each target critic, by the names that its module has for them."""
        return [
            {f"{_prefix(critic)}{name}": value for name, value in own.items()}
            for critic, own in zip(self.target_critics, self.split(parameters), strict=True)
        ]


def _prefix(critic: DirectModule) -> str:
    return "network." if isinstance(critic.module, AveragedNetwork) else ""
