"""Actor and critic for DDPG, with what keeps them from collapsing as arguments.

Plain multi-layer perceptrons were seen to saturate the actor's tanh within some fifty episodes:
the robot then circles. The defaults follow the original DDPG paper (Lillicrap et al. 2016,
https://arxiv.org/abs/1509.02971: the action joins the critic at its second layer, last layers
start near zero) and add LayerNorm. ``docs/design.md`` has the reason of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, pairwise

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn


class DirectModule(TensorDictModule):
    """A :class:`~tensordict.nn.TensorDictModule` that is a plain function of its inputs as well.

    A loss that calls a network through tensordicts spends half as much time on them as on the
    network, if that is small. :class:`~torchrl_mpfa.SignalDDPGLoss` calls these directly; any
    other module works there, too, but slower.

    Args:
        module: Function of one tensor per key of ``in_keys``, in their order.
        in_keys: What it reads.
        out_keys: What it gives.

    Examples:
        >>> double = DirectModule(lambda x: 2 * x, in_keys=["x"], out_keys=["y"])
        >>> double.outputs({"x": torch.ones(2)})["y"]
        tensor([2., 2.])
    """

    def __init__(
        self, module: nn.Module, in_keys: list[NestedKey], out_keys: list[NestedKey]
    ) -> None:
        super().__init__(module, in_keys=in_keys, out_keys=out_keys)

    def outputs(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase
    ) -> dict[NestedKey, Tensor]:
        """Compute the outputs and leave the inputs as they are.

        Args:
            inputs: Tensors by key, in a mapping or a tensordict.

        Returns:
            Outputs by key.
        """
        return self.by_key(self.module(*[inputs.get(key) for key in self.in_keys]))

    def by_key(self, found: Tensor | tuple[Tensor, ...]) -> dict[NestedKey, Tensor]:
        """Name what the module gave."""
        return dict(
            zip(self.out_keys, found if isinstance(found, tuple) else (found,), strict=True)
        )


def _layer(inputs: int, outputs: int, layer_norm: bool) -> list[nn.Module]:
    norm = [nn.LayerNorm(outputs)] if layer_norm else []
    return [nn.Linear(inputs, outputs), *norm, nn.ReLU()]


def _last(inputs: int, outputs: int, final_init: float | None) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    if final_init is not None:
        nn.init.uniform_(layer.weight, -final_init, final_init)
        nn.init.uniform_(layer.bias, -final_init, final_init)
    return layer


class Actor(nn.Module):
    """Deterministic policy with actions in [-1, 1]; gives the action before its tanh as well."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        width: int,
        layers: int,
        layer_norm: bool,
        final_init: float | None,
    ) -> None:
        super().__init__()
        sizes = [observation_size, *[width] * layers]
        hidden = [_layer(a, b, layer_norm) for a, b in pairwise(sizes)]
        # One flat sequence: in small networks each nested call is felt.
        self.body = nn.Sequential(*chain(*hidden))
        self.head = _last(width, action_size, final_init)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """From ``[..., O]`` to the preactivation and the action, each ``[..., A]``."""
        before = self.head(self.body(observation))
        return before, torch.tanh(before)


class Critic(nn.Module):
    """Q function; the action joins at the first or the second layer."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        width: int,
        layers: int,
        layer_norm: bool,
        final_init: float | None,
        late_action: bool,
    ) -> None:
        super().__init__()
        self.late_action = late_action
        first = observation_size if late_action else observation_size + action_size
        second = width + action_size if late_action else width
        self.first = nn.Sequential(*_layer(first, width, layer_norm))
        sizes = [second, *[width] * (layers - 1)]
        rest = [_layer(a, b, layer_norm) for a, b in pairwise(sizes)]
        self.rest = nn.Sequential(*chain(*rest), _last(sizes[-1], 1, final_init))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """From ``[..., O]`` and ``[..., A]`` to Q, ``[..., 1]``."""
        if self.late_action:
            joined = torch.cat((self.first(observation), action), -1)
        else:
            joined = self.first(torch.cat((observation, action), -1))
        value: Tensor = self.rest(joined)
        return value


def _check_sizes(**sizes: int) -> None:
    for name, value in sizes.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def make_actor(
    observation_size: int,
    action_size: int,
    *,
    width: int = 256,
    layers: int = 2,
    layer_norm: bool = True,
    final_init: float | None = 3e-3,
) -> DirectModule:
    """Policy from ``"observation"`` to ``"preactivation"`` and ``"action"``.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        width: Units of each hidden layer.
        layers: Number of hidden layers.
        layer_norm: Normalize each hidden layer, so that no feature grows without bound.
        final_init: The last layer starts uniformly within this, hence near the middle of the
            tanh; None leaves PyTorch's start.

    Returns:
        A module for TorchRL's losses and collectors.

    Raises:
        ValueError: If a size is below one.

    Examples:
        >>> actor = make_actor(24, 2)
        >>> from tensordict import TensorDict
        >>> actor(TensorDict({"observation": torch.rand(5, 24)}, [5]))["action"].shape
        torch.Size([5, 2])
    """
    _check_sizes(
        observation_size=observation_size, action_size=action_size, width=width, layers=layers
    )
    actor = Actor(
        observation_size,
        action_size,
        width=width,
        layers=layers,
        layer_norm=layer_norm,
        final_init=final_init,
    )
    return DirectModule(actor, in_keys=["observation"], out_keys=["preactivation", "action"])


def make_critic(
    observation_size: int,
    action_size: int,
    *,
    width: int = 256,
    layers: int = 2,
    layer_norm: bool = True,
    final_init: float | None = 3e-3,
    late_action: bool = True,
) -> DirectModule:
    """Critic from ``"observation"`` and ``"action"`` to ``"state_action_value"``.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        width: Units of each hidden layer.
        layers: Number of hidden layers; with ``late_action`` at least two.
        layer_norm: As in :func:`make_actor`.
        final_init: As in :func:`make_actor`.
        late_action: Whether the action joins at the second layer in place of the first.

    Returns:
        A module for TorchRL's losses.

    Raises:
        ValueError: If a size is below one, or a late action has no second layer to join.

    Examples:
        >>> make_critic(24, 2).out_keys
        ['state_action_value']
    """
    _check_sizes(
        observation_size=observation_size, action_size=action_size, width=width, layers=layers
    )
    if late_action and layers < 2:
        raise ValueError(f"layers must be at least 2 with late_action, got {layers}")
    critic = Critic(
        observation_size,
        action_size,
        width=width,
        layers=layers,
        layer_norm=layer_norm,
        final_init=final_init,
        late_action=late_action,
    )
    return DirectModule(critic, in_keys=["observation", "action"], out_keys=["state_action_value"])
