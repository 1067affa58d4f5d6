"""Samplers that fuse several signals into the priority of prioritized replay."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.adjustment import Adjustment, BatchFacts, PositiveBoost, PositiveDecay
from torchrl_mpfa.checks import bounds, check_finite, check_index, check_range
from torchrl_mpfa.fusion import EntropyFusion, FixedFusion, Fusion, fuse
from torchrl_mpfa.moving_fusion import Annealed
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal, SignalTable, as_signals
from torchrl_mpfa.statistics import batch_statistics
from torchrl_mpfa.tree import TreeSampler

_ENTROPY_REFRESH = 1 / 256


class SignalSampler(TreeSampler):
    r"""Prioritized sampling by a priority that is fused from several signals.

    The signals of a slot lie in the storage (:class:`~torchrl_mpfa.SignalTensorStorage`). After
    each training step :meth:`update_signals` stores the new ones of the batch, fuses them (Eq. 21),
    adjusts the result (Eqs. 22-24) and writes it to the segment tree that Eq. (8) draws from::

        signals [B, K] --fusion--> p_i [B] --adjustments--> p'_i [B] --alpha--> tree

    A fresh transition gets the highest priority in the buffer. Weights of Eq. (10) come as
    ``"priority_weight"``, divided by the largest one of the buffer.

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Args:
        max_capacity: Capacity of the storage ``N``.
        alpha: Priority exponent :math:`\alpha` of Eq. (8); 0 samples uniformly.
        beta: Importance exponent :math:`\beta` of Eq. (10).
        eps: :math:`\epsilon` of Eqs. (9) and (21), added once, before the adjustments.
        dtype: Type of the tree, as in TorchRL; only single precision works there.
        reduction: As in TorchRL.
        max_priority_within_buffer: Whether a fresh transition gets the highest priority *in the
            buffer*; if false, the highest ever seen. Unlike TorchRL's, either costs O(log N).
        device: Device of the trees; TorchRL's published wheels have those of the CPU alone.
        signals: The signals to fuse, as objects or names.
        fusion: How they are weighted, see :class:`~torchrl_mpfa.Fusion`.
        adjustments: What is done to the fused priorities, in order.
        entropy_refresh: Share of the buffer that may be rewritten before the fusion counts its
            probabilities anew; 0 counts at every update. The default costs a constant time per
            written transition, whatever the capacity.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = SignalSampler(1000, 0.6, 0.4, signals=["td_error"])
        >>> sampler.fusion
        FixedFusion(values={'td_error': 1.0})
    """

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
    ) -> None:
        check_range("entropy_refresh", entropy_refresh, low=0)
        self.signals = as_signals(signals)
        self.fusion = fusion or FixedFusion(dict.fromkeys([s.name for s in self.signals], 1.0))
        if not isinstance(self.fusion, Fusion):
            raise TypeError(f"fusion must have a method 'weights', got {type(fusion).__name__}")
        self.adjustments = tuple(adjustments)
        for adjust in self.adjustments:
            if not callable(adjust):
                raise TypeError(f"adjustments must be callable, got {type(adjust).__name__}")
        self.entropy_refresh = entropy_refresh
        self._learned = {s.name: s.priority for s in self.signals if s.known_at == "update"}
        self._names = [s.name for s in self.signals]
        self._columns: slice | list[int] = []
        self._table: SignalTable | None = None
        super().__init__(
            max_capacity, alpha, beta, eps, dtype, reduction, max_priority_within_buffer, device
        )

    def _init(self) -> None:
        super()._init()
        self._weights: Tensor | None = None
        self._weighed_at = 0
        self._last_batch: tuple[Tensor, Tensor] | None = None

    @property
    def weights(self) -> dict[str, float]:
        """The weight of each signal at the last count; empty before the first update."""
        if self._weights is None:
            return {}
        return dict(zip(self._names, self._weights.tolist(), strict=True))

    def anneal(self, progress: float) -> None:
        """Tell the fusion how much of the training is done, from 0 to 1, if it wants to know."""
        if isinstance(self.fusion, Annealed):
            self.fusion.anneal(progress)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Draw slots by Eq. (8), and count a replay for each.

        Args:
            storage: The storage to sample from.
            batch_size: ``B``.

        Returns:
            Slots, shape ``[B]``, and ``"priority_weight"`` of Eq. (10) with ``"written_at"``, by
            which an overwritten slot is known, each of shape ``[B]``.

        Raises:
            RuntimeError: If the storage is empty.
        """
        index, info = super().sample(storage, batch_size)
        self._last_batch = (index, info["priority_weight"])
        table = getattr(storage, "signal_table", None)
        if table is not None:
            table.count_replay(index)
            info["written_at"] = table.written_at(index)
        return index, info

    def update_signals(
        self,
        index: Tensor,
        signals: Mapping[str, Tensor],
        *,
        storage: Storage,
        written_at: Tensor | None = None,
    ) -> int:
        """Store new signals of a batch and set its priorities by Eqs. (21)-(24).

        Args:
            index: Slots, shape ``[B]``. Of a slot that appears twice, the last entry counts.
            signals: The learned signals by name, each of shape ``[B]`` or ``[B, 1]``.
            storage: The storage with the signal table.
            written_at: The entry of that name in the sampled batch, shape ``[B]``: rows whose
                slot was written since are left out.

        Returns:
            Number of rows left out.

        Raises:
            KeyError: If a signal that the sampler fuses is missing.
            IndexError: If a slot is outside the filled part of the buffer.
            ValueError: If a signal has the wrong shape, is negative or not finite.
            TypeError: If the storage keeps no signals.
        """
        table = self._bind(storage)
        slots = torch.as_tensor(index, dtype=torch.long, device="cpu").reshape(-1)
        if slots.numel() == 0:
            return 0
        if len(check_index(slots, table.size)) < len(slots):
            raise IndexError(f"index must be in [0, {table.size}), the filled slots, got -1")
        rows = table.rows.index_select(0, slots)
        for name, priority_of in self._learned.items():
            if name not in signals:
                raise KeyError(f"signal {name!r} is missing, got {sorted(signals)}")
            value = signals[name].detach()
            if value.numel() != slots.numel():
                raise ValueError(
                    f"signal {name!r} must have one number a transition, got shape "
                    f"{[*value.shape]} for {slots.numel()} slots"
                )
            value = value.reshape(-1)
            if priority_of is not None:
                value = priority_of(value)
            rows.select(1, table.column[name]).copy_(value)
        stale = 0
        if written_at is not None:
            live = rows.select(1, table.time_column) == written_at.reshape(-1)
            if not live.all():
                stale = int((~live).sum())
                rows, slots = rows[live], slots[live]
        self._check_signals(rows[:, self._columns])
        if slots.numel() == 0:
            return stale

        priority = self._fused(table, rows, slots)
        table.rows.index_copy_(0, slots, rows)
        self._write(slots, priority)
        return stale

    def _fused(self, table: SignalTable, rows: Tensor, slots: Tensor) -> Tensor:
        """Priorities of Eqs. (21)-(24), eps included, shape ``[B]``."""
        rows = rows.to(self.dtype)
        weights = self._weigh(table, slots)
        priority = fuse(rows[:, self._columns], weights, eps=self._eps)
        facts = BatchFacts(
            reward=rows.select(1, table.reward_column),
            replay_count=rows.select(1, table.count_column),
            index=slots,
        )
        for adjust in self.adjustments:
            priority = adjust(priority, facts)
        low, high = bounds(priority)
        if not (low >= 0 and high < math.inf):
            raise ValueError(
                f"adjusted priorities must be finite and not negative, got [{low}, {high}]"
            )
        return priority

    def _bind(self, storage: Storage) -> SignalTable:
        """The signals of the storage, with the fused ones in the order of their columns."""
        table = signal_table_of(storage, self)
        if table is not self._table:
            by_name = self.weights
            self._names = sorted((s.name for s in self.signals), key=table.column.__getitem__)
            places = [table.column[name] for name in self._names]
            # Neighbouring columns are read as a view, which is much faster than by a list.
            neighbours = places == list(range(places[0], places[0] + len(places)))
            self._columns = slice(places[0], places[-1] + 1) if neighbours else places
            self._set_weights(by_name)
            self._table = table
        return table

    def _check_signals(self, chosen: Tensor) -> None:
        if len(chosen) == 0:
            return
        # A NaN makes both of these NaN, so that one pass finds whatever is wrong.
        low, high = bounds(chosen)
        if low >= 0 and high < math.inf:
            return
        for name, value in zip(self._names, chosen.unbind(1), strict=True):
            if name not in self._learned and bool(value.isnan().any()):
                raise KeyError(f"signal {name!r} is missing: the stored transitions lack it")
            check_finite(f"signal {name!r}", value)

    def _set_weights(self, by_name: Mapping[str, float]) -> None:
        ordered = [by_name[name] for name in self._names] if by_name else None
        self._weights = None if ordered is None else torch.tensor(ordered, dtype=self.dtype)

    def _weigh(self, table: SignalTable, index: Tensor) -> Tensor:
        """Count the probabilities of Eqs. (16)-(17) anew if enough of the buffer changed."""
        fresh = table.writes - self._weighed_at
        due = not 0 <= fresh <= self.entropy_refresh * table.size or self.entropy_refresh == 0
        if self._weights is None or due or getattr(self.fusion, "every_batch", False):
            weights = self.fusion.weights(self._names, table, index)
            if weights.shape != (len(self._names),):
                raise ValueError(
                    f"fusion must give {len(self._names)} weights, got shape {[*weights.shape]}"
                )
            check_finite("weights of the fusion", weights)
            self._weights = weights.to(self.dtype)
            self._weighed_at = table.writes
        return self._weights

    def stats(self, storage: Storage) -> dict[str, float]:
        """What the priorities are made of; see ``docs/metrics.md`` for each entry.

        Args:
            storage: The storage that was sampled.

        Returns:
            Weights, entropies and shares of the signals, fractions of positive transitions,
            effective sample size and age of the last batch.
        """
        table = self._bind(storage)
        return batch_statistics(self._names, self.weights, self.fusion, table, self._last_batch)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only."""
        return {
            **super().state_dict(),
            "_signals": sorted(self._names),
            "_weights": self.weights,
            "_weighed_at": self._weighed_at,
        }

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Refuse a state that does not fit, before anything changes.

        Raises:
            ValueError: If format, capacity or signals differ.
        """
        super().check_state(state_dict)
        if (found := state_dict.get("_signals")) != sorted(self._names):
            raise ValueError(
                f"signals of the saved sampler are {found}, of this one {sorted(self._names)}"
            )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        super().load_state_dict(state_dict)
        self._set_weights(state_dict["_weights"])
        self._weighed_at = state_dict["_weighed_at"]


class MPFASampler(SignalSampler):
    r"""The paper's replay: entropy-weighted signals, positive transitions boosted and decayed.

    :class:`SignalSampler` with the choices of MPFA-PER: the signals of Eqs. (12)-(14), the weights
    of Eqs. (16)-(20), and the adjustments of Eqs. (22)-(24).

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Args:
        max_capacity: Capacity of the storage ``N``.
        alpha: Priority exponent :math:`\alpha` of Eq. (8).
        beta: Importance exponent :math:`\beta` of Eq. (10), to be raised to 1 over the training.
        eps: :math:`\epsilon` of Eq. (21).
        dtype: As in :class:`SignalSampler`.
        reduction: As in :class:`SignalSampler`.
        max_priority_within_buffer: As in :class:`SignalSampler`.
        device: As in :class:`SignalSampler`.
        signals: As in :class:`SignalSampler`.
        fusion: As in :class:`SignalSampler`.
        adjustments: As in :class:`SignalSampler`.
        entropy_refresh: As in :class:`SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = MPFASampler(100_000)
        >>> [type(adjust).__name__ for adjust in sampler.adjustments]
        ['PositiveBoost', 'PositiveDecay']
    """

    def __init__(
        self,
        max_capacity: int,
        alpha: float = 0.6,
        beta: float = 0.4,
        eps: float = 0.05,
        dtype: torch.dtype = torch.float,
        reduction: str = "max",
        max_priority_within_buffer: bool = True,
        device: torch.device | str | None = "cpu",
        *,
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        fusion: Fusion | None = None,
        adjustments: Sequence[Adjustment] | None = None,
        entropy_refresh: float = _ENTROPY_REFRESH,
    ) -> None:
        super().__init__(
            max_capacity,
            alpha,
            beta,
            eps,
            dtype,
            reduction,
            max_priority_within_buffer,
            device,
            signals=signals,
            fusion=EntropyFusion() if fusion is None else fusion,
            adjustments=(PositiveBoost(), PositiveDecay()) if adjustments is None else adjustments,
            entropy_refresh=entropy_refresh,
        )


def signal_table_of(storage: Storage, sampler: SignalSampler) -> SignalTable:
    """The signals of a storage, after a check that they fit the sampler.

    Raises:
        TypeError: If the storage keeps no signals.
        ValueError: If its capacity or its signals are not those of the sampler.
    """
    table = getattr(storage, "signal_table", None)
    if not isinstance(table, SignalTable):
        raise TypeError(
            f"storage must keep signals (SignalTensorStorage, SignalMemmapStorage), got "
            f"{type(storage).__name__}"
        )
    if table.capacity != sampler.max_size:
        raise ValueError(
            f"max_capacity of the sampler is {sampler.max_size}, max_size of the storage "
            f"{table.capacity}"
        )
    absent = [signal.name for signal in sampler.signals if signal.name not in table.column]
    if absent:
        raise ValueError(f"signals {absent} of the sampler are not in the storage: {table.names}")
    return table
