"""Networks and tables that value each of a few actions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.networks.deterministic import DirectModule, Perceptron

_OUT_KEYS = ["action_value", "action", "chosen_action_value"]


class ValueNetwork(nn.Module):
    """A perceptron with an output for each action."""

    def __init__(self, observation_size: int, actions: int, perceptron: Perceptron) -> None:
        super().__init__()
        self.body = nn.Sequential(*perceptron.hidden(observation_size, perceptron.layers))
        self.head = perceptron.last(actions)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map ``[..., O]`` to values and choice, ``[..., K]``, and its value, ``[..., 1]``."""
        return _chosen(self.head(self.body(observation)))

    def layers(self) -> list[nn.Module]:
        """Return all layers in their order, from observation to values."""
        return [*self.body, self.head]


class ValueTable(nn.Module):
    """A table with a row of values for each cell of the observations."""

    table: Tensor

    def __init__(self, cell_of: Callable[[Tensor], Tensor], cells: int, actions: int) -> None:
        super().__init__()
        self.cell_of = cell_of
        self.register_buffer("table", torch.zeros(cells, actions))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map ``[..., O]`` to values and choice, ``[..., K]``, and its value, ``[..., 1]``."""
        return _chosen(self.table[self.cell_of(observation)])


def _chosen(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return values, the greatest as a one-hot choice, and the greatest value."""
    choice = nn.functional.one_hot(values.argmax(-1), values.shape[-1])
    return values, choice, values.amax(-1, keepdim=True)


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
    return DirectModule(network, in_keys=["observation"], out_keys=_OUT_KEYS)


def make_value_table(cell_of: Callable[[Tensor], Tensor], cells: int, actions: int) -> DirectModule:
    """Make a table from ``"observation"`` to values of actions, zero at first, and the best one.

    Args:
        cell_of: From observations, shape ``[..., O]``, to integers in [0, cells), shape ``[...]``.
        cells: Number of rows.
        actions: Number of actions ``K``.

    Returns:
        A module for :class:`~torchrl_mpfa.learners.TabularQLearner`.

    Raises:
        ValueError: If a size is not a positive integer.

    Examples:
        >>> table = make_value_table(lambda seen: (seen[..., 0] > 0).long(), 2, 3)
        >>> table.outputs({"observation": torch.rand(5, 24)})["action_value"].shape
        torch.Size([5, 3])
    """
    check_counts(cells=cells, actions=actions)
    table = ValueTable(cell_of, cells, actions)
    return DirectModule(table, in_keys=["observation"], out_keys=_OUT_KEYS)
