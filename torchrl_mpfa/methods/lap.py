r"""LAP: priorities that do not fall below the bend of the Huber loss, and no importance weights.

Fujimoto et al. (2020), "An equivalence between loss functions and non-uniform sampling in
experience replay", https://arxiv.org/abs/2007.06049. Its uniform twin PAL is a loss:
:func:`~torchrl_mpfa.losses.functional.pal_distance`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import BatchFacts
from torchrl_mpfa.checks import POSITIVE, SHARE, check

if TYPE_CHECKING:
    from torchrl_mpfa.storages.table import SignalTable

BEND = "bend"
"""Entry of a batch that tells the loss where to bend, in the units of the environment's reward."""
_LEAST = 1e-6
"""Where all errors are zero, their quantile is no bend."""


def running_bend(priority: Tensor, *, quantile: float, otherwise: float) -> Tensor:
    """The least known priority, shape ``[]``, that a share of the known ones does not exceed."""
    known = priority[~priority.isnan()]
    if len(known) == 0:
        return priority.new_tensor(otherwise)
    # Selection in place of torch.quantile's sorting, which takes several times as long.
    place = max(math.ceil(quantile * len(known)), 1)
    return known.kthvalue(place).values.clamp_min(_LEAST)


@dataclass(frozen=True)
class LAPFloor:
    r"""No priority below a floor, :math:`\max(|\delta_i|, 1)`.

    Args:
        floor: The floor in the units of the environment's reward. LAP's 1 is where its Huber loss
            bends: of a loss with rewards scaled by ``s`` it is ``1 / s``.
        quantile: Share of the priorities in the buffer that are to lie below the floor, which then
            moves with them, and with it the bend of the loss: sampled batches have it as
            ``"bend"``. The floor that is given counts until errors are known. 0: a constant floor.

    Raises:
        ValueError: If the floor is not positive and finite, or the quantile not in [0, 1].

    Examples:
        >>> import torch
        >>> facts = BatchFacts(torch.zeros(2), torch.ones(2), torch.arange(2))
        >>> LAPFloor(1.0)(torch.tensor([0.2, 3.0]), facts).tolist()
        [1.0, 3.0]
    """

    floor: float = 1.0
    quantile: float = 0.0

    def __post_init__(self) -> None:
        check(POSITIVE, floor=self.floor)
        check(SHARE, quantile=self.quantile)

    @property
    def counts(self) -> bool:
        """Whether the floor moves."""
        return self.quantile > 0

    def count(self, table: SignalTable, priority: Tensor) -> Tensor:
        """The floor of the moment, shape ``[]``."""
        return running_bend(priority, quantile=self.quantile, otherwise=self.floor)

    def entries(self, counted: Tensor | None, count: int) -> dict[str, Tensor]:
        """The bend for the loss of a batch of this many transitions, if it moves."""
        if not self.counts:
            return {}
        bend = torch.tensor(self.floor) if counted is None else counted
        return {BEND: bend.float().expand(count).clone()}

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Raise what is below the floor, shape ``[B]``."""
        return priority.clamp_min(self.floor if batch.counted is None else batch.counted)
