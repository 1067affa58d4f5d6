r"""ReaPER: errors count for more where the rest of their episode is well predicted.

Pleiss et al. (2025), "Reliability-adjusted prioritized experience replay",
https://arxiv.org/abs/2506.18482, by the rules of the authors' public code. The target of a
transition is made of later ones: where the later TD errors of its episode are large, its
own error says little.

.. math::

    R_t = 1 - \frac{\sum_{i > t} |\delta_i|}{F}, \qquad F = \sum_i |\delta_i|, \qquad
    P(t) \propto R_t^{\,\omega}\, p_t^{\,\alpha}

Of an unfinished episode, :math:`F` is the largest sum of one that has ended, and its unknown rest
counts as the difference: :math:`R_t = \sum_{i \le t} |\delta_i| / F`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.checks import POSITIVE, as_mask, check
from torchrl_mpfa.episodes import episodes_of
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.slots import as_slots
from torchrl_mpfa.samplers.table import SignalTable
from torchrl_mpfa.signals import TD_ERROR, Signal

EPISODE = Signal("episode", key="episode", known_at="write")
"""The number of the episode that a transition is of, which the storage has to keep.

Numbers may begin again with a process or a collector: a transition continues an episode of its
number if it begins where that ended (:func:`~torchrl_mpfa.episodes.episodes_of`)."""
ENDED = Signal("ended", key=("next", "done"), known_at="write")
"""True for the last transition of an episode, likewise."""
_LEAST = 1e-3
"""With a reliability of zero a transition would be lost for good."""
_UNDER_WAY = 1024
"""Episodes that may continue; of more, those that were written last."""


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
    sum_of_episode = sums[number] if total is None else total[order].double()
    share = torch.where(sum_of_episode > 0, until / sum_of_episode, 1.0).clamp(0.0, 1.0)
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
    READS_ROWS = True
    KEPT = (EPISODE, ENDED)
    _steps: Any = None
    """The storage that is sampled from."""

    def __init__(self, *args: Any, exponent: float = 0.3, **kwargs: Any) -> None:
        self.exponent: float = check(POSITIVE, exponent=exponent)
        super().__init__(*args, **kwargs)
        if TD_ERROR not in self.signals:
            raise ValueError(f"signals must have {TD_ERROR.name!r}, got {self._names}")

    def _init(self) -> None:
        super()._init()
        # Numbers of the episodes that no two share, as those that are written may begin again.
        self._episodes = torch.zeros(self._max_capacity, dtype=torch.long, device=self.device)
        self._last_number = self._numbered = 0
        self._open = torch.empty(0, dtype=torch.long, device="cpu")

    def check_new(self, data: Any, count: int) -> Tensor:
        """See :meth:`SignalSampler.check_new`; the mark of an end must be a boolean."""
        if (ended := data.get(ENDED.key, None)) is not None:
            as_mask(repr(ENDED.key), ended)
        return super().check_new(data, count)

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Give fresh transitions the highest priority, and rely on episodes that they end.

        As :meth:`TreeSampler.mark_update`.
        """
        super().mark_update(index, storage=storage)
        if storage is None:
            return
        self._steps = storage
        table, slots = self.table, as_slots(index, storage).to(self.device)
        slots = slots[slots >= 0]
        last = table.rows[slots, table.column[ENDED.name]] > 0
        if last.any():
            self._rely(table, slots[last])

    def _learned_from(self, slots: Tensor, storage: Storage) -> None:
        self._steps = storage
        slots = slots.to(self.device)
        self._rely(self.table, slots[slots < self.table.size])

    def _number(self, table: SignalTable) -> None:
        """Number the episodes of the rows that were written since this was last done."""
        if not 0 < self._numbered <= table.writes:
            self._open, self._numbered = self._open[:0], 0
        if self._numbered == table.writes:
            return
        time = table.rows[: table.size, table.time_column].cpu()
        open_slots = self._open[time[self._open] < self._numbered]
        slots = torch.cat((open_slots, (time >= self._numbered).nonzero().squeeze(1)))
        slots = slots[time[slots].argsort()]
        number, last = (table.rows[slots, table.column[s.name]].cpu() for s in (EPISODE, ENDED))
        loaded, data = time[slots] < table.loaded, self._steps._storage
        first = episodes_of(data, slots, number, last > 0, loaded, ndim=self._steps.ndim)
        is_new = time[slots] >= self._numbered
        new_ids = self._last_number + (
            (first == torch.arange(len(first), device="cpu")) & is_new
        ).cumsum(0)
        ids = torch.where(is_new, new_ids, self._episodes[slots].cpu())[first]
        self._last_number = int(new_ids[-1])
        self._episodes[slots] = ids.to(self.device)
        # The last step of each is the one that is written last.
        last_step = torch.zeros(self._last_number + 1, dtype=torch.long, device="cpu")
        last_step[ids] = torch.arange(len(ids), device="cpu")
        last_step = last_step[ids.unique()].sort().values
        self._open = slots[last_step[~(last[last_step] > 0)]][-_UNDER_WAY:]
        self._numbered = table.writes

    def _rely(self, table: SignalTable, slots: Tensor) -> None:
        """Write the leaves of all transitions of the episodes that these are of."""
        priority = self.priorities()[: table.size]
        self._number(table)
        columns = [*(table.column[s.name] for s in (TD_ERROR, ENDED)), table.time_column]
        # One at a time, which is much faster than by a list.
        errors, last, time = (table.rows[: table.size, c].contiguous() for c in columns)
        errors = torch.where(errors.isnan(), priority - self._eps, errors)
        # From 0: they are places in a table.
        numbers = self._episodes[: table.size] - self._episodes[: table.size].min()
        sums = torch.bincount(numbers, weights=errors)
        ended, touched = torch.zeros(2, len(sums), dtype=torch.bool, device=sums.device)
        ended[numbers[last.nonzero().squeeze(1)]] = True
        touched[numbers[slots]] = True
        totals = torch.where(ended, sums, sums[ended].max() if ended.any() else 0.0)
        mine = touched.index_select(0, numbers).nonzero().squeeze(1)
        of = numbers.index_select(0, mine)
        # In the order of the numbers that were written, which rounding depends on.
        ordered = table.rows[mine, table.column[EPISODE.name]].long() * 2**32 + of
        share = reliability(errors[mine], ordered, time[mine], total=totals[of])
        leaf = self._leaf(priority[mine]) * share.clamp_min(_LEAST).pow(self.exponent)
        self._write_leaves(mine, leaf)

    def _retransform_priority_trees(self, old_alpha: float, new_alpha: float) -> None:
        super()._retransform_priority_trees(old_alpha, new_alpha)
        if self.table.size:
            self._rely(self.table, torch.arange(self.table.size, device=self.device))
