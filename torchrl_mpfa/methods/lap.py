r"""LAP: priorities that do not fall below the bend of the Huber loss, and no importance weights.

Fujimoto et al. (2020), "An equivalence between loss functions and non-uniform sampling in
experience replay", https://arxiv.org/abs/2007.06049. Its uniform twin PAL is a loss:
:func:`~torchrl_mpfa.losses.pal_distance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from torchrl_mpfa.adjustment import Adjustment, BatchFacts
from torchrl_mpfa.checks import POSITIVE, keep

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class LAPFloor(Adjustment):
    r"""Raise priorities to a floor, :math:`\max(|\delta_i|, 1)`.

    Args:
        floor: The floor in the units of the environment's reward. LAP's 1 is where its Huber loss
            bends: of a loss with rewards scaled by ``s`` it is ``1 / s``.

    Raises:
        ValueError: If the floor is not positive and finite.

    Examples:
        >>> import torch
        >>> facts = BatchFacts(torch.zeros(2), torch.ones(2), torch.arange(2))
        >>> LAPFloor(1.0)(torch.tensor([0.2, 3.0]), facts).tolist()
        [1.0, 3.0]
    """

    floor: float = 1.0
    takes_batches: ClassVar[bool] = True

    def __post_init__(self) -> None:
        keep(self, floor=POSITIVE)

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Raise priorities to the floor, shape ``[B]``."""
        return priority.clamp_min(self.floor)
