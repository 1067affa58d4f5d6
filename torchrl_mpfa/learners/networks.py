"""The networks of a learner: called directly, several of one kind, averaged, and with quantiles."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mpfa.networks import DirectModule, StochasticActor

Tensors = Mapping[NestedKey, Tensor]
"""Tensors by key."""
QUANTILES = 16
"""Quantiles of a target that the network of UPER learns."""


class Called(nn.Module):
    """A module that must be called with a tensordict, as a function of tensors by key."""

    def __init__(self, network: TensorDictModule) -> None:
        super().__init__()
        self.network = network

    def outputs(self, inputs: Tensors) -> Tensors:
        """Compute the outputs without exploration; further inputs do no harm."""
        read = TensorDict({key: inputs[key] for key in self.network.in_keys})
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return self.network(read)


def as_function(network: TensorDictModule) -> nn.Module:
    """Return a network with ``outputs``, a function of tensors by key: wrapped unless it has it."""
    return network if isinstance(network, DirectModule | StochasticActor) else Called(network)


def check_networks(actor: Any, critic: Any) -> None:
    """Raise if these are no networks, share parameters, or actor and critic are swapped."""
    for name, network in (("actor", actor), ("critic", critic)):
        if not isinstance(network, nn.Module) or not hasattr(network, "in_keys"):
            raise TypeError(f"{name} must be a TensorDictModule, got {type(network).__name__}")
    if "action" in actor.in_keys and "action" in critic.out_keys:
        raise ValueError(
            "actor and critic are in the wrong order: actor reads 'action', which critic writes"
        )
    for name, keys, key in (
        ("actor must write", actor.out_keys, "action"),
        ("critic must read", critic.in_keys, "action"),
        ("critic must write", critic.out_keys, "state_action_value"),
    ):
        if key not in keys:
            raise ValueError(f"{name} {key!r}, got {list(keys)}")
    if read := [key for key in critic.in_keys if key in actor.out_keys and key != "action"]:
        raise ValueError(f"critic must read no output of actor but 'action', got {read}")
    if {*map(id, actor.parameters())} & {*map(id, critic.parameters())}:
        raise ValueError(
            "actor and critic must have parameters of their own, got shared ones: give each a copy"
        )


def several(critic: nn.Module, count: int) -> list[nn.Module]:
    """Return a critic, or several copies with new weights, each in the range of the critic's."""
    if count == 1:
        return [critic]
    critics = [deepcopy(critic) for _ in range(count)]
    with torch.no_grad():
        for parameters in zip(*(copied.parameters() for copied in critics), strict=True):
            first = parameters[0]
            # As TorchRL draws them, number by number.
            weights = first.new_empty(count, *first.shape)
            weights.uniform_(first.min().item(), first.max().item())
            for parameter, values in zip(parameters, weights, strict=True):
                parameter.copy_(values)
    return critics


# The network of UPER, which learns how noisy targets are.


def with_quantiles(critic: nn.Module) -> nn.Module:
    """Make a network of new weights and :data:`QUANTILES` outputs from a critic."""
    network = deepcopy(critic)
    linear = [(n, m) for n, m in network.named_modules() if isinstance(m, nn.Linear)]
    name, last = linear[-1] if linear else ("", None)
    if last is None or last.out_features != 1:
        raise ValueError(
            "signal 'information_gain' needs a critic whose last linear layer has one output, got "
            f"{'none' if last is None else last}"
        )
    like = {"device": last.weight.device, "dtype": last.weight.dtype}
    place, _, attribute = name.rpartition(".")
    wider = nn.Linear(last.in_features, QUANTILES, bias=last.bias is not None, **like)
    setattr(network.get_submodule(place), attribute, wider)
    for module in network.modules():
        if callable(reset := getattr(module, "reset_parameters", None)):
            reset()
    # All quantiles are equal at the start: a target is taken for certain until it was seen to vary.
    for parameter in wider.parameters():
        nn.init.zeros_(parameter)
    return network
