r"""Linear layers whose weights stay on the unit sphere, so that their steps keep their size.

Weights that grow make each step of the optimizer a smaller turn, and a network that bootstraps for
long loses its pace. SimbaV2 (Lee et al. 2025, https://arxiv.org/abs/2502.15280) therefore sets each
row back to length one after each step. Of that architecture this alone is taken, for the hidden
layers, beside LayerNorm in place of its normalized features.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

_LEAST_LENGTH = 1e-12


def unit_rows(weight: Tensor) -> Tensor:
    r"""Rows set to length one, :math:`w_i / \lVert w_i \rVert_2`.

    Args:
        weight: Weights of a layer, ``[outputs, inputs]``, or of several, ``[C, outputs, inputs]``.

    Returns:
        Weights of the same shape.

    Examples:
        >>> unit_rows(torch.tensor([[3.0, 4.0]]))
        tensor([[0.6000, 0.8000]])
    """
    length: Tensor = torch.linalg.vector_norm(weight, dim=-1, keepdim=True)
    return weight / length.clamp_min(_LEAST_LENGTH)


class UnitLinear(nn.Linear):
    """A linear layer that starts with rows of length one, and that a learner keeps so.

    Examples:
        >>> [round(row.norm().item(), 4) for row in UnitLinear(24, 2).weight]
        [1.0, 1.0]
    """

    def reset_parameters(self) -> None:
        """Start as ever, but for the length of the rows."""
        super().reset_parameters()
        project_rows([self.weight])


@torch.no_grad()
def project_rows(weights: Iterable[Tensor]) -> None:
    """Set the rows of weights to length one, in place."""
    for weight in weights:
        weight.copy_(unit_rows(weight))
