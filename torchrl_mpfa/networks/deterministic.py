"""Actor, critic and values of choices, with the options that keep them from collapsing.

Plain multi-layer perceptrons were seen to saturate the actor's tanh within some fifty episodes:
the robot then circles. The defaults follow the original DDPG paper (Lillicrap et al. 2016,
https://arxiv.org/abs/1509.02971: the action joins the critic at its second layer, last layers
start near zero) and add LayerNorm. ``docs/tuning.md`` has the reason of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from torchrl_mpfa.checks import COUNT, NOT_NEGATIVE, check_counts, keep
from torchrl_mpfa.networks.bounds import ActionScale, action_scale

OUT_KEYS = ["action_value", "action", "chosen_action_value"]
"""What a network of values writes."""


class DirectModule(TensorDictModule):
    """A :class:`~tensordict.nn.TensorDictModule` that is a plain function of its inputs as well.

    A loss that calls a network through tensordicts spends half as much time on them as on the
    network, if that is small. The learners of this package call these modules directly; any other
    module works in :class:`~torchrl_mpfa.ActorCritic`, too, but slower.

    Args:
        module: Function of one tensor per key of ``in_keys``, in their order.
        in_keys: Keys of the inputs.
        out_keys: Keys of the outputs.

    Examples:
        >>> import torch
        >>> double = DirectModule(lambda x: 2 * x, in_keys=["x"], out_keys=["y"])
        >>> double.outputs({"x": torch.ones(2)})["y"]
        tensor([2., 2.])
        >>> make_actor(24, 2).act(torch.rand(1, 24)).shape
        torch.Size([1, 2])
    """

    def outputs(
        self, inputs: Mapping[NestedKey, Tensor] | TensorDictBase
    ) -> dict[NestedKey, Tensor]:
        """Compute the outputs and leave the inputs as they are.

        Args:
            inputs: Tensors by key, in a mapping or a tensordict.

        Returns:
            Outputs by key.
        """
        outputs = self.module(*[inputs.get(key) for key in self.in_keys])
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        return dict(zip(self.out_keys, outputs, strict=True))

    def act(self, *inputs: Tensor) -> Tensor:
        """Choose actions without noise, ``[..., A]``, or one-hot, ``[..., K]``; for policies alone.

        Args:
            *inputs: A tensor per key of ``in_keys``, of :func:`make_actor` observations
                ``[..., O]``.

        Returns:
            What the policy writes as ``"action"``, without gradients.
        """
        with torch.no_grad():
            return self.outputs(dict(zip(self.in_keys, inputs, strict=True)))["action"]


@dataclass(frozen=True)
class Perceptron:
    """Options of a network, documented at :func:`~torchrl_mpfa.make_actor`."""

    width: int
    layers: int
    layer_norm: bool
    final_init: float | None

    def __post_init__(self) -> None:
        keep(self, width=COUNT, layers=COUNT)
        if self.final_init is not None:
            keep(self, final_init=NOT_NEGATIVE)

    def hidden(self, inputs: int, count: int) -> list[nn.Module]:
        """Make hidden layers, each followed by ReLU and, by option, LayerNorm before it."""
        layers: list[nn.Module] = []
        for _ in range(count):
            norm = [nn.LayerNorm(self.width)] if self.layer_norm else []
            layers += [nn.Linear(inputs, self.width), *norm, nn.ReLU()]
            inputs = self.width
        return layers

    def last(self, outputs: int) -> nn.Linear:
        """Make the linear layer after the hidden ones."""
        layer = nn.Linear(self.width, outputs)
        if self.final_init is not None:
            nn.init.uniform_(layer.weight, -self.final_init, self.final_init)
            nn.init.uniform_(layer.bias, -self.final_init, self.final_init)
        return layer


class Layers(nn.Module):
    """Hidden layers ``body``, and the last one ``head``."""

    def __init__(self, inputs: int, outputs: int, perceptron: Perceptron) -> None:
        super().__init__()
        # One flat sequence: in small networks each nested call is felt.
        self.body = nn.Sequential(*perceptron.hidden(inputs, perceptron.layers))
        self.head = perceptron.last(outputs)

    def layers(self) -> list[nn.Module]:
        """Return all layers in their order."""
        return [*self.body, self.head]


class Actor(Layers):
    """Deterministic policy, which returns the action before its tanh as well."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        perceptron: Perceptron,
        *,
        scale: ActionScale | None = None,
    ) -> None:
        super().__init__(observation_size, action_size, perceptron)
        self.scale = scale

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Map ``[..., O]`` to the preactivation and the action, each ``[..., A]``."""
        before = self.head(self.body(observation))
        action = torch.tanh(before)
        return before, action if self.scale is None else self.scale(action)

    def layers(self) -> list[nn.Module]:
        """Return all layers in their order, from observation to action."""
        scale = [] if self.scale is None else [self.scale]
        return [*super().layers(), nn.Tanh(), *scale]


class Critic(nn.Module):
    """Q function; the action joins at the first or the second layer."""

    def __init__(
        self, observation_size: int, action_size: int, perceptron: Perceptron, *, late_action: bool
    ) -> None:
        super().__init__()
        self.late_action = late_action
        first, second = observation_size, perceptron.width
        if late_action:
            second += action_size
        else:
            first += action_size
        self.first = nn.Sequential(*perceptron.hidden(first, 1))
        rest = perceptron.hidden(second, perceptron.layers - 1)
        self.rest = nn.Sequential(*rest, perceptron.last(1))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Map ``[..., O]`` and ``[..., A]`` to Q, ``[..., 1]``."""
        if self.late_action:
            joined = torch.cat((self.first(observation), action), -1)
        else:
            joined = self.first(torch.cat((observation, action), -1))
        return self.rest(joined)


class ValueNetwork(Layers):
    """A perceptron with an output for each action."""

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map ``[..., O]`` to values and choice, ``[..., K]``, and its value, ``[..., 1]``."""
        return with_best(self.head(self.body(observation)))


def with_best(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return values, the greatest as a one-hot choice, and the greatest value."""
    choice = nn.functional.one_hot(values.argmax(-1), values.shape[-1])
    return values, choice, values.amax(-1, keepdim=True)


def make_actor(
    observation_size: int,
    action_size: int,
    *,
    action_spec: TensorSpec | None = None,
    saturation_limit: float | None = None,
    width: int = 256,
    layers: int = 2,
    layer_norm: bool = True,
    final_init: float | None = 3e-3,
) -> DirectModule:
    """Make a policy from ``"observation"`` to ``"preactivation"`` and ``"action"``.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        action_spec: A bounded spec, such as ``env.action_spec``: actions are the tanh, scaled to
            its bounds. None: actions are in [-1, 1].
        saturation_limit: Preactivation at which an action reaches its bound (see
            :class:`~torchrl_mpfa.networks.ActionScale`): give the limit of the loss's penalty,
            which holds actions at 0.905 of their bounds otherwise, for a limit of 1.5. None: the
            bound is approached, and never reached.
        width: Units of each hidden layer.
        layers: Number of hidden layers.
        layer_norm: True to normalize each hidden layer, so that no feature grows without bound.
        final_init: Bound of the last layer's uniform start, hence near the middle of the tanh;
            None keeps PyTorch's start.

    Returns:
        A module for :class:`~torchrl_mpfa.ActorCritic`, TorchRL's losses and collectors.

    Raises:
        ValueError: If a size is not a positive integer, the spec has other actions, or the limit is
            not positive.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> actor = make_actor(3, 1, action_spec=Bounded(low=-2.0, high=2.0, shape=(1,)))
        >>> actor(TensorDict({"observation": torch.rand(5, 3)}, [5]))["action"].shape
        torch.Size([5, 1])
    """
    check_counts(observation_size=observation_size, action_size=action_size)
    perceptron = Perceptron(width, layers, layer_norm, final_init)
    scale = action_scale(action_spec, action_size, saturation_limit=saturation_limit)
    actor = Actor(observation_size, action_size, perceptron, scale=scale)
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
    """Make a critic from ``"observation"`` and ``"action"`` to ``"state_action_value"``.

    Args:
        observation_size: ``O``.
        action_size: ``A``.
        width: Units of each hidden layer.
        layers: Number of hidden layers; with ``late_action`` at least two.
        layer_norm: As in :func:`make_actor`.
        final_init: As in :func:`make_actor`.
        late_action: True to feed the action to the second layer, and not to the first.

    Returns:
        A module for :class:`~torchrl_mpfa.ActorCritic` and TorchRL's losses.

    Raises:
        ValueError: If a size is not a positive integer, or a late action has no second layer.

    Examples:
        >>> make_critic(24, 2).out_keys
        ['state_action_value']
    """
    check_counts(observation_size=observation_size, action_size=action_size)
    perceptron = Perceptron(width, layers, layer_norm, final_init)
    if late_action and layers < 2:
        raise ValueError(f"layers must be at least 2 with late_action, got {layers}")
    critic = Critic(observation_size, action_size, perceptron, late_action=late_action)
    return DirectModule(critic, in_keys=["observation", "action"], out_keys=["state_action_value"])


def make_value_network(
    observation_size: int,
    actions: int,
    *,
    width: int = 256,
    layers: int = 2,
    layer_norm: bool = True,
    final_init: float | None = 3e-3,
) -> DirectModule:
    """Make a network from ``"observation"`` to a value for each action, and the best one, one-hot.

    Args:
        observation_size: ``O``.
        actions: Number of actions ``K``.
        width: Units of each hidden layer.
        layers: Number of hidden layers.
        layer_norm: As in :func:`~torchrl_mpfa.make_actor`.
        final_init: As in :func:`~torchrl_mpfa.make_actor`.

    Returns:
        A module for :class:`~torchrl_mpfa.DQN` and TorchRL's ``DQNLoss``.

    Raises:
        ValueError: If a size is not a positive integer.

    Examples:
        >>> make_value_network(24, 7).outputs({"observation": torch.rand(5, 24)})["action"].shape
        torch.Size([5, 7])
    """
    check_counts(observation_size=observation_size, actions=actions)
    perceptron = Perceptron(width, layers, layer_norm, final_init)
    network = ValueNetwork(observation_size, actions, perceptron)
    return DirectModule(network, in_keys=["observation"], out_keys=OUT_KEYS)
