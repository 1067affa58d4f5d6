r"""ReaPER: errors count for more where the rest of their episode is well foreseen.

Pleiss et al. (2025), "Reliability-adjusted prioritized experience replay",
https://arxiv.org/abs/2506.18482, by the rules of the authors' public code. The target of a
transition is made of what comes after it: where the later TD errors of its episode are large, its
own error says little.

.. math::

    R_t = 1 - \frac{\sum_{i > t} |\delta_i|}{F}, \qquad F = \sum_i |\delta_i|, \qquad
    P(t) \propto R_t^{\,\omega}\, p_t^{\,\alpha}

Of an episode that is still under way, :math:`F` is the largest sum of one that has ended, and what
is not known of it counts as the difference: :math:`R_t = \sum_{i \le t} |\delta_i| / F`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.checks import POSITIVE, check
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.samplers.slots import as_slots
from torchrl_mpfa.signals import TD_ERROR, Signal
from torchrl_mpfa.storages.table import SignalTable

EPISODE = Signal("episode", key="episode", known_at="write")
"""The number of the episode that a transition is of, which the storage has to keep."""
ENDED = Signal("ended", key=("next", "done"), known_at="write")
"""Whether the transition is the last one of its episode, likewise."""
_LEAST = 1e-3
"""With a reliability of zero a transition would be lost for good."""
_SPARSE = 8
"""Up to so many numbers for each transition, those of the episodes serve as places in a table."""


def reliability(
    td_error: Tensor, episode: Tensor, time: Tensor, *, total: Tensor | None = None
) -> Tensor:
    r"""Share of the TD errors of an episode that do not come after a transition, :math:`R_t`.

    Args:
        td_error: :math:`|\delta|`, shape ``[N]``.
        episode: Number of the episode of each transition, shape ``[N]``.
        time: When each was written, shape ``[N]``.
        total: The sum :math:`F` that the share is of, shape ``[N]``; by default that of the
            episode.

    Returns:
        Reliabilities in [0, 1], in double precision, shape ``[N]``; 1 at the end of an episode, and
        where the sum is zero.

    Examples:
        >>> errors, time = torch.tensor([1.0, 2.0, 1.0]), torch.arange(3)
        >>> reliability(errors, torch.zeros(3), time).tolist()
        [0.25, 0.75, 1.0]
        >>> reliability(errors, torch.zeros(3), time, total=torch.full((3,), 8.0)).tolist()
        [0.125, 0.375, 0.5]
    """
    # In a ring buffer, rows are in the order of their times but for the place where it wraps.
    rising = bool((time.diff() > 0).all())
    order = torch.arange(len(time), device=time.device) if rising else time.argsort()
    order = order[episode[order].argsort(stable=True)]
    _, number, lengths = torch.unique_consecutive(
        episode[order], return_inverse=True, return_counts=True
    )
    errors = td_error[order].double()
    sums = errors.new_zeros(len(lengths)).index_add_(0, number, errors)
    before = sums.cumsum(0) - sums  # Of all episodes in front of this one.
    until = errors.cumsum(0) - before[number]
    whole = sums[number] if total is None else total[order].double()
    share = torch.where(whole > 0, until / whole, 1.0).clamp(0.0, 1.0)
    return torch.empty_like(share).index_copy_(0, order, share)


class ReaPERSampler(SignalSampler):
    r"""Prioritized sampling by :math:`R_t^{\,\omega} p_t^{\,\alpha}`.

    When a transition is learned from, all of its episode get the reliability that they have then. A
    transition that was not yet learned from counts with the highest TD error, as which it is
    sampled.

    Args:
        *args: As :class:`~torchrl_mpfa.SignalSampler`.
        exponent: :math:`\omega`.
        **kwargs: As :class:`~torchrl_mpfa.SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> ReaPERSampler(1000, 0.3, 0.4, signals=["td_error"]).exponent
        0.3
    """

    KIND = "reaper"

    def __init__(self, *args: Any, exponent: float = 0.3, **kwargs: Any) -> None:
        check(POSITIVE, exponent=exponent)
        self.exponent = exponent
        super().__init__(*args, **kwargs)

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Give fresh transitions the highest priority, and rely on episodes that they end.

        As :meth:`TreeSampler.mark_update`.
        """
        super().mark_update(index, storage=storage)
        if hasattr(storage, "signal_table"):
            table, slots = self.bind(storage), as_slots(index, storage).to(self.device)
            last = table.rows[slots, table.column[ENDED.name]] > 0
            if last.any():
                self._rely(table, slots[last])

    def update_signals(
        self,
        index: Tensor,
        signals: Mapping[str, Tensor],
        *,
        storage: Storage,
        written_at: Tensor | None = None,
        batches: int = 1,
    ) -> int:
        """Store new signals of a batch, and set what its episodes are sampled in proportion to.

        As :meth:`SignalSampler.update_signals`.
        """
        stale = super().update_signals(
            index, signals, storage=storage, written_at=written_at, batches=batches
        )
        table, slots = self.bind(storage), as_slots(index, storage).to(self.device)
        self._rely(table, slots[slots < table.size])
        return stale

    def bind(self, storage: Storage) -> SignalTable:
        """Take the signals of a storage, as :meth:`SignalSampler.bind`.

        Raises:
            ValueError: If it does not keep :data:`EPISODE`, :data:`ENDED` and the TD error.
        """
        table = super().bind(storage)
        kept = (EPISODE.name, ENDED.name, TD_ERROR.name)
        if absent := [name for name in kept if name not in table.column]:
            raise ValueError(f"the storage must keep the signals {absent}, got {table.names}")
        return table

    def _rely(self, table: SignalTable, slots: Tensor) -> None:
        """Write the leaves of all transitions of the episodes that these are of."""
        priority = self._priorities[: table.size]
        names = (TD_ERROR.name, EPISODE.name, ENDED.name)
        columns = [*(table.column[name] for name in names), table.time_column]
        # One at a time, which is much faster than by a list.
        errors, episode, last, time = (table.rows[: table.size, c].contiguous() for c in columns)
        errors = torch.where(errors.isnan(), priority - self._eps, errors)
        numbers = _numbers(episode)
        sums = torch.bincount(numbers, weights=errors)
        ended, touched = torch.zeros(2, len(sums), dtype=torch.bool, device=sums.device)
        ended[numbers[last.nonzero().squeeze(1)]] = True
        touched[numbers[slots]] = True
        totals = torch.where(ended, sums, sums[ended].max() if ended.any() else 0.0)
        mine = touched.index_select(0, numbers).nonzero().squeeze(1)
        of = numbers.index_select(0, mine)
        share = reliability(errors[mine], of, time[mine], total=totals[of])
        leaf = self._leaf(priority[mine]) * share.clamp_min(_LEAST).pow(self.exponent)
        self._write_leaves(mine, leaf)

    def _saved_leaves(self, state: Mapping[str, Any], written: Tensor) -> Tensor:
        # Reliabilities follow from the signals of the storage, and are at most 1.
        highest = super()._saved_leaves(state, written)
        found = state["_sum_tree"][written]
        return torch.where((found > 0) & (found <= highest * (1 + 1e-9)), found, highest)

    def _retransform_priority_trees(self, old_alpha: float, new_alpha: float) -> None:
        super()._retransform_priority_trees(old_alpha, new_alpha)
        if self._table is not None and self._table.size:
            self._rely(self._table, torch.arange(self._table.size, device=self.device))


def _numbers(episode: Tensor) -> Tensor:
    """Episodes numbered from 0, with gaps, shape ``[N]``."""
    lowest = episode.min()
    found = (episode - lowest).long()
    if bool((found + lowest == episode).all()) and int(found.max()) < _SPARSE * len(found):
        return found
    return torch.unique(episode, return_inverse=True)[1]
