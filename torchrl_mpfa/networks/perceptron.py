"""The options that all perceptrons of this package share, and the layers that they are made of."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn

from torchrl_mpfa.checks import NOT_NEGATIVE, check, check_counts


@dataclass(frozen=True)
class Perceptron:
    """Options of an actor, a critic, or a value network, see :func:`~torchrl_mpfa.make_actor`."""

    width: int
    layers: int
    layer_norm: bool
    final_init: float | None

    def __post_init__(self) -> None:
        check_counts(width=self.width, layers=self.layers)
        if self.final_init is not None:
            check(NOT_NEGATIVE, final_init=self.final_init)

    def hidden(self, inputs: int, count: int) -> list[nn.Module]:
        """So many hidden layers, each followed by LayerNorm (if asked) and ReLU."""
        layers: list[nn.Module] = []
        for _ in range(count):
            norm = [nn.LayerNorm(self.width)] if self.layer_norm else []
            layers += [nn.Linear(inputs, self.width), *norm, nn.ReLU()]
            inputs = self.width
        return layers

    def last(self, outputs: int) -> nn.Linear:
        """The linear layer after the hidden ones."""
        layer = nn.Linear(self.width, outputs)
        if self.final_init is not None:
            nn.init.uniform_(layer.weight, -self.final_init, self.final_init)
            nn.init.uniform_(layer.bias, -self.final_init, self.final_init)
        return layer
