"""The networks of a loss: bound to its parameters, stacked, averaged over time, with quantiles.

TorchRL swaps parameters in and out of one module at every call, and passes tensordicts. With
networks of a hundred units both take longer than the network itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mpfa.networks import DirectModule

Tensors = Mapping[NestedKey, Tensor]
"""Tensors by key."""
QUANTILES = 16
"""Quantiles of a target that the network of UPER learns."""


class Function(Protocol):
    """A network as a function of tensors by key, such as a :class:`DirectModule`."""

    def outputs(self, inputs: Tensors) -> dict[NestedKey, Tensor]:
        """Compute the outputs by key; further inputs do no harm."""
        ...


class TensorDictFunction:
    """A module that must be called with a tensordict, as a :class:`Function`."""

    def __init__(self, network: TensorDictModule) -> None:
        self.network = network

    def outputs(self, inputs: Tensors) -> dict[NestedKey, Tensor]:
        """Compute the outputs without exploration."""
        read = TensorDict({key: inputs[key] for key in self.network.in_keys})
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            found = self.network(read)
        return {
            key: value for key in self.network.out_keys if (value := found.get(key)) is not None
        }


class StackedNetworks:
    """Networks of one structure with stacked parameters, ``[C, ...]``, called one by one.

    With two small networks ``torch.vmap`` costs twice as much.
    """

    def __init__(self, network: TensorDictModule, params: TensorDictBase) -> None:
        self._function = as_function(deepcopy(network))
        # The module inside is called with these parameters, and its names have no prefix.
        names = params.flatten_keys(".").items()
        found = {name: value for name, value in names if isinstance(value, Tensor)}
        if isinstance(self._function, DirectModule):
            found = {name.removeprefix("module."): value for name, value in found.items()}
        self._params = found

    def __iter__(self) -> Iterator[Function]:
        """Give each network, with its share of the parameters as they are now."""
        split = {name: value.unbind(0) for name, value in self._params.items()}
        for weights in zip(*split.values(), strict=True):
            yield _WithWeights(self._function, dict(zip(split, weights, strict=True)))


class _WithWeights:
    """A network that is called with weights other than its own."""

    def __init__(self, function: Any, weights: dict[str, Tensor]) -> None:
        self._function, self._weights = function, weights

    def outputs(self, inputs: Tensors) -> dict[NestedKey, Tensor]:
        """Compute the outputs by these weights."""
        function = self._function
        if isinstance(function, DirectModule):
            read = tuple(inputs[key] for key in function.in_keys)
            return function.by_key(functional_call(function.module, self._weights, read))
        network = function.network
        read = TensorDict({key: inputs[key] for key in network.in_keys})
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return dict(functional_call(network, self._weights, (read,)).items(True, True))


@dataclass
class Networks:
    """The networks of a loss."""

    actor: Function
    critics: Iterable[Function]
    """The critics with the parameters that their loss moves."""
    frozen_critics: list[Function]
    """Each critic, for gradients to flow through: it gets none itself."""
    target_actor: Function
    target_critics: list[Function]
    stored: list[NestedKey]
    """Entries of a transition that a critic reads, its action among them."""
    states: list[NestedKey]
    """Entries that actor and critics read where the actor chooses the action."""


class HoldsNetworks:
    """Mixin of losses that bind their networks once, and again when parameters may have moved."""

    _bound: Any = None

    def forget_networks(self) -> None:
        """Have the networks bound to the parameters again at their next use."""
        self._bound = None

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        self._bound = None
        return super()._apply(*args, **kwargs)  # type: ignore[misc]

    def train(self, mode: bool = True) -> Any:
        """Set training mode, of the bound networks too."""
        self._bound = None
        return super().train(mode)  # type: ignore[misc]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bound": None, "_deferred": None}


def as_function(network: TensorDictModule) -> DirectModule | TensorDictFunction:
    """Return a network as a function, wrapped unless it is one."""
    return network if isinstance(network, DirectModule) else TensorDictFunction(network)


def bind(network: TensorDictModule, params: TensorDictBase) -> TensorDictModule:
    """Copy a network that holds these parameters: the same tensors, and not copies of them."""
    copied = deepcopy(network)
    params.to_module(copied)
    return copied


def bind_frozen(network: TensorDictModule, params: TensorDictBase) -> list[TensorDictModule]:
    """As :func:`bind`, for each of stacked parameters, without gradients."""
    params = params.detach()
    each = params.unbind(0) if params.batch_size else [params]
    return [bind(network, own).requires_grad_(False) for own in each]


def bind_networks(
    actor: tuple[TensorDictModule, TensorDictBase, TensorDictBase],
    critic: tuple[TensorDictModule, TensorDictBase],
    target_critics: list[TensorDictModule],
) -> Networks:
    """Bind the networks of a loss: its actor with both its parameters, and its critics."""
    network, params, target_params = actor
    reads, writes = network.in_keys, network.out_keys
    of_critic = critic[0].in_keys
    states = [key for key in (*reads, *of_critic) if key in reads or key not in writes]
    stacked = bool(critic[1].batch_size)
    return Networks(
        actor=as_function(bind(network, params)),
        critics=StackedNetworks(*critic) if stacked else [as_function(bind(*critic))],
        frozen_critics=[as_function(each) for each in bind_frozen(*critic)],
        target_actor=as_function(bind(network, target_params).requires_grad_(False)),
        target_critics=[as_function(each) for each in target_critics],
        stored=list(of_critic),
        states=list(dict.fromkeys(states)),
    )


def check_networks(actor: Any, critic: Any, *, critic_name: str) -> None:
    """Raise if these are no networks, or actor and critic are swapped."""
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
            f"{critic_name} must read an output of actor_network, {list(actor.out_keys)}, but "
            f"reads {list(first.in_keys)}"
        )


# The mean of several earlier critics, whose targets vary less than those of one. Averaged-DQN
# (Anschel et al. 2017, https://arxiv.org/abs/1611.01929) averages the last K target networks;
# Averaged-DDPG (Xu et al. 2022, Computers and Electrical Engineering 101, 108015) does so for DDPG.
# A reconstruction: of the latter a summary says that the mean of K earlier estimates is the
# target's value, and that it changes at the end of an episode. Here the target critic of Eq. (7) is
# the newest of the K, and the others are its states at the ends of the last episodes, so that K = 1
# is DDPG.


class PastCritics(nn.Module):
    """The parameters of a network at the last ``count`` calls of :meth:`push`."""

    share: Tensor
    taken: Tensor

    def __init__(self, network: nn.Module, count: int) -> None:
        super().__init__()
        self.count = count
        self._names = [name for name, _ in network.named_parameters()]
        for place, value in enumerate(network.parameters()):
            self.register_buffer(f"past_{place}", value.detach().repeat(count, *[1] * value.ndim))
        self.register_buffer("taken", torch.zeros((), dtype=torch.long))
        # Of the states, and last of the network itself: all that exist count the same.
        self.register_buffer("share", torch.zeros(count + 1))
        self.share[-1] = 1.0

    @torch.no_grad()
    def push(self, network: nn.Module) -> None:
        """Replace the oldest state by the network's present parameters."""
        slot = int(self.taken) % self.count
        for place, value in enumerate(network.parameters()):
            getattr(self, f"past_{place}")[slot] = value
        self.taken += 1
        known = min(int(self.taken), self.count)
        self.share.zero_()
        self.share[:known] = 1.0 / (known + 1)
        self.share[-1] = 1.0 / (known + 1)

    def states(self) -> list[dict[str, Tensor]]:
        """Return the parameters of each state by name."""
        stacks = [getattr(self, f"past_{place}") for place in range(len(self._names))]
        return [
            {name: stack[slot] for name, stack in zip(self._names, stacks, strict=True)}
            for slot in range(self.count)
        ]


class AveragedNetwork(nn.Module):
    r"""Mean of a network and its earlier states, :math:`\frac1K \sum_k Q(s, a; \theta_{(k)})`."""

    def __init__(self, network: nn.Module, past: PastCritics) -> None:
        super().__init__()
        self.network = network
        self.past = past

    def forward(self, *inputs: Tensor) -> Tensor:
        """Compute the mean over the states that exist."""
        each = [functional_call(self.network, state, inputs) for state in self.past.states()]
        found = torch.stack([*each, self.network(*inputs)])
        return torch.tensordot(self.past.share, found, dims=1)


def average(critics: list[Any], pasts: Iterable[Any]) -> list[Any]:
    """Average each target critic with its earlier states, if any are kept."""
    pasts = list(pasts)
    if not pasts:
        return critics
    return [
        DirectModule(AveragedNetwork(each.module, past), each.in_keys, each.out_keys)
        for each, past in zip(critics, pasts, strict=True)
    ]


# The network of UPER, which learns how noisy targets are.


def last_layer(critic: TensorDictModule) -> str:
    """Find the name of the layer of a critic that gives Q, the last linear layer."""
    linear = [(n, m) for n, m in critic.named_modules() if isinstance(m, nn.Linear)]
    name, layer = linear[-1] if linear else ("", None)
    if layer is None or layer.out_features != 1:
        raise ValueError(
            "signal 'information_gain' needs a critic whose last linear layer has one output, got "
            f"{'none' if layer is None else layer}"
        )
    return name


def with_quantiles(critic: TensorDictModule) -> TensorDictModule:
    """Make a network of new weights and :data:`QUANTILES` outputs from a critic."""
    name, network = last_layer(critic), deepcopy(critic)
    last = network.get_submodule(name)
    like = {"device": last.weight.device, "dtype": last.weight.dtype}
    place, _, attribute = name.rpartition(".")
    has_bias = last.bias is not None
    wider = nn.Linear(last.in_features, QUANTILES, bias=has_bias, **like)
    setattr(network.get_submodule(place), attribute, wider)
    for module in network.modules():
        if callable(reset := getattr(module, "reset_parameters", None)):
            reset()
    # All quantiles are equal at the start: a target is taken for certain until it was seen to vary.
    nn.init.zeros_(wider.weight)
    if has_bias:
        nn.init.zeros_(wider.bias)
    return network
