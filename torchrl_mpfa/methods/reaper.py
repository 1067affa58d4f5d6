r"""ReaPER: errors count for more where the rest of their episode is well foreseen.

Pleiss et al. (2025), "Reliability-adjusted prioritized experience replay",
https://arxiv.org/abs/2506.18482. **A reconstruction**, from descriptions of it: episodes that still
run count as if they had ended, which the paper does not do. The target of a transition is made of
what comes after it: where the later TD errors of its episode are large, its own error says little.

.. math::

    R_t = 1 - \frac{\sum_{i > t} |\delta_i|}{\sum_i |\delta_i|}, \qquad
    P(t) \propto R_t^{\,\omega}\, p_t^{\,\alpha}
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import BatchFacts
from torchrl_mpfa.checks import POSITIVE, check
from torchrl_mpfa.signals import TD_ERROR, Signal

if TYPE_CHECKING:
    from torchrl_mpfa.storages.table import SignalTable

EPISODE = Signal("episode", key="episode", known_at="write")
"""The number of the episode that a transition is of, which the storage has to keep."""
_LEAST = 1e-3
"""With a reliability of zero a transition would be lost for good."""


def reliability(td_error: Tensor, episode: Tensor, time: Tensor) -> Tensor:
    r"""Share of the TD errors of an episode that do not come after a transition, :math:`R_t`.

    Args:
        td_error: :math:`|\delta|`, shape ``[N]``; NaN, which counts as 0, where it is not known.
        episode: Number of the episode of each transition, shape ``[N]``.
        time: When each was written, shape ``[N]``.

    Returns:
        Reliabilities in [0, 1], in double precision, shape ``[N]``; 1 at the end of an episode, and
        where nothing of it is known.

    Examples:
        >>> errors, time = torch.tensor([1.0, 2.0, 1.0]), torch.arange(3)
        >>> reliability(errors, torch.zeros(3), time).tolist()
        [0.25, 0.75, 1.0]
    """
    order = time.argsort()
    order = order[episode[order].argsort(stable=True)]
    _, number, lengths = torch.unique_consecutive(
        episode[order], return_inverse=True, return_counts=True
    )
    errors = td_error[order].double().nan_to_num(0.0)
    total = errors.new_zeros(len(lengths)).index_add_(0, number, errors)
    before = total.cumsum(0) - total  # Of all episodes in front of this one.
    until = errors.cumsum(0) - before[number]
    total = total[number]
    share = torch.where(total > 0, until / total, 1.0).clamp(0.0, 1.0)
    return torch.empty_like(share).index_copy_(0, order, share)


@dataclass(frozen=True)
class Reliability:
    r"""Multiplies priorities by a power of the reliability, :math:`R_t^{\,\omega / \alpha} p_t`.

    Reliabilities are those of the last count over the buffer. What was written since has 1, as a
    fresh transition has the highest priority.

    Args:
        exponent: :math:`\omega`.
        alpha: Priority exponent :math:`\alpha` of the sampler, which the product is raised to.

    Raises:
        ValueError: If an exponent is not positive and finite.

    Examples:
        >>> Reliability(0.3, alpha=0.6).counts
        True
    """

    exponent: float = 0.2
    alpha: float = 0.6

    def __post_init__(self) -> None:
        check(POSITIVE, exponent=self.exponent, alpha=self.alpha)

    @property
    def counts(self) -> bool:
        """Always."""
        return True

    def count(self, table: SignalTable, priority: Tensor) -> Tensor:
        """Reliability of each slot, and when it was written, counted from 1, shape ``[2, N]``.

        Raises:
            ValueError: If the storage does not keep :data:`EPISODE` and the TD error.
        """
        absent = [name for name in (EPISODE.name, TD_ERROR.name) if name not in table.column]
        if absent:
            raise ValueError(f"the storage must keep the signals {absent}, got {table.names}")
        rows = table.rows[: table.size]
        time = rows[:, table.time_column]
        errors, episode = (rows[:, table.column[s.name]] for s in (TD_ERROR, EPISODE))
        found = torch.zeros(2, table.capacity, dtype=torch.double)
        found[0, : table.size] = reliability(errors, episode, time)
        found[1, : table.size] = time + 1.0
        return found

    def __call__(self, priority: Tensor, batch: BatchFacts) -> Tensor:
        """Lower what is not reliable, shape ``[B]``."""
        if batch.counted is None or batch.written_at is None:
            return priority
        share, written = batch.counted[:, batch.index]
        share = torch.where(written == batch.written_at + 1.0, share, 1.0).clamp_min(_LEAST)
        return priority * share.pow(self.exponent / self.alpha)
