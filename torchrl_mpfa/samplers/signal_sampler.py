"""Samplers that fuse several signals into the priority of prioritized replay."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.adjustment import Adjustment, BatchFacts
from torchrl_mpfa.checks import NOT_NEGATIVE, bounds, check, check_counts, check_index
from torchrl_mpfa.fusion import COMBINATIONS, FixedFusion, Fusion
from torchrl_mpfa.moving_fusion import Annealed
from torchrl_mpfa.positive import level_of, one_sided
from torchrl_mpfa.samplers.binding import signal_table_of
from torchrl_mpfa.samplers.rows import check_signals, write_signals
from torchrl_mpfa.samplers.slots import SERIAL, as_slots, last_of_each
from torchrl_mpfa.samplers.statistics import batch_statistics
from torchrl_mpfa.samplers.tree import TreeSampler, in_dimensions_of
from torchrl_mpfa.samplers.weighing import (
    Weighing,
    boost_factor,
    count_anew,
    counted_entries,
    counted_state,
    entries_of,
    weighing_entries,
    weights_of,
)
from torchrl_mpfa.saved import Entry, exactly
from torchrl_mpfa.signals import Signal, as_signals
from torchrl_mpfa.spelling import unknown
from torchrl_mpfa.storages.table import SignalTable

_ENTROPY_REFRESH = 1 / 256


class SignalSampler(TreeSampler):
    r"""Prioritized sampling by a priority that is fused from several signals.

    The signals of a slot lie in the storage (:class:`~torchrl_mpfa.SignalTensorStorage`). After
    each training step :meth:`update_signals` stores the new ones of the batch, fuses them (Eq. 21),
    adjusts the result (Eqs. 22-24) and writes it to the segment tree that Eq. (8) samples from::

        signals [B, K] --fusion--> p_i [B] --adjustments--> p'_i [B] --alpha--> tree

    A fresh transition gets the highest priority in the buffer. Weights of Eq. (10) come as
    ``"priority_weight"``, divided by the largest one of the buffer.

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Args:
        max_capacity: Capacity of the storage ``N``.
        alpha: Priority exponent :math:`\alpha` of Eq. (8); 0 samples uniformly.
        beta: Importance exponent :math:`\beta` of Eq. (10).
        eps: :math:`\epsilon` of Eqs. (9) and (21), added once, before the adjustments.
        dtype: As in :class:`~torchrl_mpfa.samplers.TreeSampler`.
        reduction: As in TorchRL.
        max_priority_within_buffer: Whether a fresh transition gets the highest priority that a
            transition *in the buffer* was given by an update; if false, the highest ever.
        device: Device of the trees; TorchRL's published wheels have those of the CPU alone.
        signals: The signals to fuse, as objects or names.
        fusion: How they are weighted, see :class:`~torchrl_mpfa.Fusion`.
        adjustments: What is done to the fused priorities, in order.
        entropy_refresh: Share of the buffer that may be rewritten before the fusion counts its
            probabilities anew; 0 counts at every update. The default costs a constant time per
            written transition, whatever the capacity.
        stratified: Whether a batch takes one slot from each of ``B`` equal parts of the total
            priority, as the PER paper does, in place of ``B`` independent ones.
        combination: What is made of signals and weights: their ``"sum"`` (Eq. 21), or their
            ``"product"``, :func:`~torchrl_mpfa.fusion.fuse_product`.

    Raises:
        ValueError: If an argument is out of its range, or the fusion names a signal that is not
            among the ``signals``.

    Examples:
        >>> sampler = SignalSampler(1000, 0.6, 0.4, signals=["td_error"])
        >>> sampler.fusion
        FixedFusion(values={'td_error': 1.0})
    """

    KIND = "signals"

    def __init__(
        self,
        max_capacity: int,
        alpha: float,
        beta: float,
        eps: float = 1e-8,
        dtype: torch.dtype = torch.float,
        reduction: str = "max",
        max_priority_within_buffer: bool = False,
        device: torch.device | str | None = "cpu",
        *,
        signals: Sequence[Signal | str] = ("td_error",),
        fusion: Fusion | None = None,
        adjustments: Sequence[Adjustment] = (),
        entropy_refresh: float = _ENTROPY_REFRESH,
        stratified: bool = False,
        combination: str = "sum",
    ) -> None:
        if combination not in COMBINATIONS:
            raise ValueError(unknown("combination", combination, COMBINATIONS))
        self.combination = combination
        check(NOT_NEGATIVE, entropy_refresh=entropy_refresh)
        self.signals = as_signals(signals)
        self.fusion = fusion or FixedFusion(dict.fromkeys([s.name for s in self.signals], 1.0))
        if not isinstance(self.fusion, Fusion):
            raise TypeError(f"fusion must have a method 'weights', got {type(fusion).__name__}")
        fused = [signal.name for signal in self.signals]
        for name in getattr(self.fusion, "signal_names", ()):
            if name not in fused:
                raise ValueError(unknown("signal of the fusion", name, fused))
        self.adjustments = tuple(adjustments)
        for adjust in self.adjustments:
            if not callable(adjust):
                raise TypeError(f"adjustments must be callable, got {type(adjust).__name__}")
        self.entropy_refresh = entropy_refresh
        self._learned = {s.name: s.priority for s in self.signals if s.known_at == "update"}
        self._names = [s.name for s in self.signals]
        self._columns: slice | list[int] = []
        self._table: SignalTable | None = None
        self._warned: set[str] = set()
        super().__init__(
            max_capacity,
            alpha,
            beta,
            eps,
            dtype,
            reduction,
            max_priority_within_buffer,
            device,
            stratified=stratified,
        )

    def _init(self) -> None:
        super()._init()
        self._weighing: Weighing | None = None
        self._last_batch: tuple[Tensor, Tensor] | None = None

    @property
    def weights(self) -> dict[str, float]:
        """The weight of each signal at the last count; empty before the first update."""
        if self._weighing is None:
            return {}
        return dict(zip(self._names, self._weighing.weights.tolist(), strict=True))

    def anneal(self, fraction: float) -> None:
        """Tell the fusion how much of the training is done, from 0 to 1, if it wants to know."""
        if isinstance(self.fusion, Annealed):
            self.fusion.anneal(fraction)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[str, Tensor]]:
        """Sample slots by Eq. (8), and count a replay for each.

        Args:
            storage: The storage to sample from.
            batch_size: ``B``.

        Returns:
            Slots, shape ``[B]``, or for a storage of several dimensions a tuple of places along
            each; and ``"priority_weight"`` of Eq. (10) with ``"written_at"``, by which an
            overwritten slot is known, each of shape ``[B]``.

        Raises:
            RuntimeError: If the storage is empty.
            ValueError: If ``batch_size`` is not positive.
        """
        slots, weight = self._sampled(storage, batch_size)
        told = entries_of(self._weighing, self.adjustments, len(slots))
        info = {"priority_weight": weight, **told}
        self._last_batch = (slots, weight)
        table = getattr(storage, "signal_table", None)
        if table is not None:
            table.count_replay(slots)
            info["written_at"] = table.written_at(slots)
        else:
            self._warn_once(
                f"{type(self).__name__} samples from a {type(storage).__name__}, which keeps no "
                "signals: nothing can be fused. Use SignalTensorStorage or SignalMemmapStorage, in "
                "a SignalReplayBuffer"
            )
        return in_dimensions_of(storage, slots), info

    def update_priority(
        self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None
    ) -> None:
        """Set priorities directly, as TorchRL's sampler does: neither fused nor adjusted.

        Args:
            index: As in :meth:`TreeSampler.update_priority`.
            priority: Priorities before eps and alpha, shape ``[B]``, ``[B, 1]`` or ``[]``.
            storage: The storage, which places in several dimensions need.

        Raises:
            IndexError: If a slot is outside the buffer.
            TypeError: If the index holds anything but integers.
            RuntimeError: If ``priority`` has not one number a slot.
            ValueError: If a priority is negative or not finite, or so high that sums overflow.
        """
        # TorchRL's buffers hand a first priority to transitions that they find in a storage.
        if self._table is None and self._highest is not None:
            self._warn_once(
                f"{type(self).__name__} was given one number as the priority: it is neither fused "
                "nor adjusted. TorchRL's own buffers do so in update_tensordict_priority; use "
                "SignalReplayBuffer, with SignalTensorStorage or SignalMemmapStorage"
            )
        super().update_priority(index, priority, storage=storage)

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            warnings.warn(text, UserWarning, stacklevel=3)

    def update_signals(
        self,
        index: Tensor,
        signals: Mapping[str, Tensor],
        *,
        storage: Storage,
        written_at: Tensor | None = None,
        batches: int = 1,
    ) -> int:
        """Store new signals of a batch and set its priorities by Eqs. (21)-(24).

        Args:
            index: Slots, shape ``[B]``, or places in a storage of ``D`` dimensions, shape
                ``[B, D]``. Of a slot that appears twice, the last entry counts.
            signals: The learned signals by name, each of shape ``[B]`` or ``[B, 1]``.
            storage: The storage with the signal table.
            written_at: The entry of that name in the sampled batch, shape ``[B]``: rows whose
                slot was written since are left out.
            batches: How many batches of one size these slots are, one after the other; each is
                adjusted as a batch of its own.

        Returns:
            Number of rows left out.

        Raises:
            KeyError: If a signal that the sampler fuses is missing.
            IndexError: If a slot was never filled or, without ``written_at``, is not filled now.
            ValueError: If a signal or ``written_at`` has the wrong shape, a signal is negative or
                not finite, or the slots are not so many equal batches.
            TypeError: If the storage keeps no signals, or the index holds anything but integers.
        """
        table = self.bind(storage)
        slots = as_slots(index, storage)
        if slots.numel() == 0:
            return 0
        check_counts(batches=batches)
        if len(slots) % batches:
            raise ValueError(f"{len(slots)} slots cannot make {batches} equal batches")
        sizes = [len(slots) // batches] * batches
        # A batch from before the buffer was emptied is stale, as its times of writing tell.
        filled = table.size if written_at is None else table.known
        if len(check_index(slots, filled)) < len(slots):
            raise IndexError(f"index must be in [0, {filled}), the filled slots, got -1")
        rows, live, stale = table.rows.index_select(0, slots), None, 0
        if written_at is not None:
            if written_at.numel() != slots.numel():
                raise ValueError(
                    "written_at must have one number per transition, got shape "
                    f"{[*written_at.shape]} for {slots.numel()} slots"
                )
            written_at = written_at.reshape(-1).to(rows.device)
            same = rows.select(1, table.time_column) == written_at
            if not same.all():
                live, stale = same, int((~same).sum())
                sizes = same.reshape(batches, -1).sum(1).tolist()
                rows, slots = rows[same], slots[same]
        write_signals(rows, table, signals, self._learned, live=live, sizes=sizes)
        check_signals(rows[:, self._columns], self._names, self._learned)
        if slots.numel() == 0:
            return stale

        weighing, fused = self._weighing, []
        for one, of_one in zip(slots.split(sizes), rows.split(sizes), strict=True):
            if len(one):
                weighing = self._counted(table, one, self._weigh(table, one, weighing), weighing)
                fused.append(self._fused(table, of_one, one, weighing))
        priority = fused[0] if len(fused) == 1 else torch.cat(fused)
        highest = self._checked(priority, "adjusted priorities")
        self._weighing = weighing
        if len(slots) > SERIAL and (last := last_of_each(slots)) is not None:
            slots, rows, priority = slots[last], rows[last], priority[last]
            highest = bounds(priority)[1]
        table.rows.index_copy_(0, slots, rows)
        self._set(slots, priority, highest)
        return stale

    def _fused(self, table: SignalTable, rows: Tensor, slots: Tensor, weighing: Weighing) -> Tensor:
        """Priorities of Eqs. (21)-(24), eps included, shape ``[B]``."""
        priority = self._combined(rows, weighing)
        facts = BatchFacts(
            reward=rows.select(1, table.reward_column),
            replay_count=rows.select(1, table.count_column),
            index=slots,
            mean_reward=weighing.mean_reward,
            written_at=rows.select(1, table.time_column),
        )
        for adjust, counted in zip_longest(self.adjustments, weighing.counted):
            priority = adjust(
                priority, facts if counted is None else replace(facts, counted=counted)
            )
        if priority.shape != slots.shape:
            raise ValueError(
                f"adjusted priorities must have shape {[*slots.shape]}, got {[*priority.shape]}"
            )
        return priority.to(torch.double)

    def _combined(self, rows: Tensor, weighing: Weighing) -> Tensor:
        """Priorities before any adjustment, eps included, shape ``[B]``."""
        combine = COMBINATIONS[self.combination]
        return combine(rows[:, self._columns], weighing.weights, eps=self._eps)

    def bind(self, storage: Storage) -> SignalTable:
        """Take the signals of a storage as those to fuse.

        Args:
            storage: The storage.

        Returns:
            Its signals.

        Raises:
            TypeError: If the storage keeps no signals.
            ValueError: If its capacity or its signals are not those of the sampler.
        """
        table = signal_table_of(storage, self.signals, self._max_capacity)
        if table is not self._table:
            weights, before = self.weights, self._weighing
            self._names = sorted((s.name for s in self.signals), key=table.column.__getitem__)
            places = [table.column[name] for name in self._names]
            # Neighbouring columns are read as a view, which is much faster than by a list.
            neighbours = places == list(range(places[0], places[0] + len(places)))
            self._columns = slice(places[0], places[-1] + 1) if neighbours else places
            if before is not None:
                self._weighing = replace(before, weights=self._ordered(weights))
            self._table = table
        return table

    def _weigh(self, table: SignalTable, index: Tensor, last: Weighing | None) -> Weighing:
        """Count the probabilities of Eqs. (16)-(17) anew if enough changed since the last count."""
        fresh = table.writes - (0 if last is None else last.writes)
        due = not 0 <= fresh <= self.entropy_refresh * table.size or self.entropy_refresh == 0
        if last is not None and not due and not getattr(self.fusion, "every_batch", False):
            return last
        weights = weights_of(self.fusion, self._names, table, index)
        if last is not None and not due:
            return replace(last, weights=weights)
        if (text := one_sided(table.rewards, (self.fusion, *self.adjustments))) is not None:
            self._warn_once(text)
        return Weighing(weights, float(table.rewards.mean()), table.writes)

    def _counted(
        self, table: SignalTable, index: Tensor, weighing: Weighing, last: Weighing | None
    ) -> Weighing:
        """The weighing with what the adjustments counted, anew if enough has changed."""
        return count_anew(
            weighing,
            last,
            self.adjustments,
            table,
            lambda made: self._combined(table.rows[: table.size], made),
            learned=len(index),
            always=self.entropy_refresh == 0,
        )

    def stats(self, storage: Storage) -> dict[str, float]:
        """What the priorities are made of; see ``docs/metrics.md`` for each entry.

        Args:
            storage: The storage that was sampled.

        Returns:
            Weights, entropies and shares of the signals, fractions of positive transitions,
            effective sample size and age of the last batch, and the factor of the boost.
        """
        table = self.bind(storage)
        level = level_of((*self.adjustments, self.fusion))
        found = batch_statistics(
            self._names, self.weights, self.fusion, table, self._last_batch, level
        )
        return {**found, **boost_factor(self._weighing, self.adjustments)}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only."""
        return {
            **super().state_dict(),
            "_signals": sorted(self._names),
            "_weights": self.weights,
            "_weighed_at": 0 if self._weighing is None else self._weighing.writes,
            "_mean_reward": 0.0 if self._weighing is None else self._weighing.mean_reward,
            **counted_state(self._weighing, self.adjustments),
        }

    def _entries(self) -> list[Entry]:
        names = sorted(self._names)
        return [
            *super()._entries(),
            exactly("_signals", names),
            *weighing_entries(names),
            *counted_entries(self.adjustments),
        ]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        super().load_state_dict(state_dict)
        if state_dict["_weights"]:
            self._weighing = Weighing(
                self._ordered(state_dict["_weights"]),
                state_dict["_mean_reward"],
                state_dict["_weighed_at"],
                tuple(state_dict.get("_counted", ())),
                state_dict.get("_counted_writes", 0),
                state_dict.get("_learned_since", 0),
            )

    def _ordered(self, weights: Mapping[str, float]) -> Tensor:
        return torch.tensor([weights[name] for name in self._names], dtype=torch.double)
