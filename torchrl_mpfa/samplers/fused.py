"""Samplers that fuse several signals into the priority of prioritized replay."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Storage, TensorStorage

from torchrl_mpfa.adjustment import Adjustment, BatchFacts, check_adjustments
from torchrl_mpfa.checks import (
    LEVEL,
    NOT_NEGATIVE,
    Level,
    check,
    check_counts,
    check_shape,
)
from torchrl_mpfa.fusion import FixedFusion, Fusion, check_fusion, checked_weights, fuse
from torchrl_mpfa.samplers.composition import composition
from torchrl_mpfa.samplers.prioritized import TreeSampler
from torchrl_mpfa.samplers.slots import Steps, as_slots, in_dimensions_of, last_of_each
from torchrl_mpfa.samplers.table import Agents, SignalTable, by_batch
from torchrl_mpfa.samplers.weighing import (
    COUNT_REFRESH,
    Weighing,
    counts_of,
    one_sided,
    restored_weighing,
    warn_of_mean,
)
from torchrl_mpfa.saving import check_saved
from torchrl_mpfa.signals import REWARD, Signal, as_signals


class SignalSampler(TreeSampler):
    r"""Prioritized sampling by a priority that is fused from several signals.

    The sampler keeps the signals of every slot in :attr:`table`. A write of a slot resets them:
    those that are known at the write are read from the storage, whatever it is. After each training
    step :meth:`update_signals` stores the new ones of the batch, fuses them (Eq. 21), adjusts the
    result (Eqs. 22-24) and writes it to the segment tree that Eq. (8) samples from::

        signals [B, K] --fusion--> p_i [B] --adjustments--> p'_i [B] --alpha--> tree

    A fresh transition gets the highest priority there was. Weights of Eq. (10) come as
    ``"priority_weight"``, divided by the largest one of the buffer.

    Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166

    Args:
        max_capacity: As in :class:`~torchrl_mpfa.samplers.TreeSampler`, and so all that follow but
            for these.
        alpha: Priority exponent :math:`\alpha` of Eq. (8).
        beta: Importance exponent :math:`\beta` of Eq. (10).
        eps: :math:`\epsilon` of Eq. (21), added once, before the adjustments.
        dtype: Type of the importance weights.
        reduction: As in TorchRL.
        max_priority_within_buffer: True to give it the highest priority that is in the buffer.
        device: Device of priorities and sampled slots.
        stratified: True to sample one slot from each of ``B`` parts.
        signals: The signals to fuse, as objects or names.
        fusion: Weights of the signals, see :class:`~torchrl_mpfa.Fusion`; by default equal ones.
        adjustments: Changes of the fused priorities, see :class:`~torchrl_mpfa.Adjustment`, in
            order.
        positive_above: A transition is positive when its reward is above this: a number (0 in the
            paper), or ``"mean"``, the mean reward of the buffer. Fusion and adjustments use it.
        entropy_refresh: Share of the buffer that may be rewritten before the fusion counts its
            probabilities again; 0 counts at every update. The default costs a constant time per
            written transition, for any capacity.
        reward_key: Where the signed reward of a transition is read.
        agents: Number of a transition where reward or signal has one for each agent: the largest by
            magnitude, ``"max"``, or the ``"mean"``; None: that is an error.

    Raises:
        TypeError: If fusion or adjustments are of other types.
        ValueError: If an argument is out of its range, or the fusion names a signal that is not
            among the ``signals``.

    Warns:
        UserWarning: If ``positive_above`` is ``"mean"`` and the fusion counts entropies.

    Examples:
        >>> sampler = SignalSampler(1000, 0.6, 0.4, signals=["td_error"])
        >>> sampler.fusion
        FixedFusion(values={'td_error': 1.0})
    """

    KIND = "signals"
    _weighing: Weighing | None
    KEPT: tuple[Signal, ...] = ()
    """Further entries of transitions that the table keeps."""
    READS_ROWS = False
    """True if neighbours of a transition are looked for among the stored tensors."""

    def __init__(
        self,
        max_capacity: int | None,
        alpha: float,
        beta: float,
        eps: float = 1e-8,
        dtype: torch.dtype = torch.float,
        reduction: str = "max",
        max_priority_within_buffer: bool = False,
        device: torch.device | str | None = None,
        *,
        stratified: bool = False,
        signals: Sequence[Signal | str] = ("td_error",),
        fusion: Fusion | None = None,
        adjustments: Sequence[Adjustment] = (),
        positive_above: Level = 0.0,
        entropy_refresh: float = 1 / 256,
        reward_key: NestedKey = ("next", "reward"),
        agents: Agents | None = None,
    ) -> None:
        # The reward is where the transitions have it.
        self._signals = tuple(
            replace(signal, key=reward_key) if signal == REWARD else signal
            for signal in as_signals(signals)
        )
        equal = FixedFusion(dict.fromkeys((signal.name for signal in self._signals), 1.0))
        self.fusion = equal if fusion is None else fusion
        self.adjustments = adjustments
        self._positive_above: Level = check(LEVEL, positive_above=positive_above)
        warn_of_mean(positive_above, self.fusion)
        self.entropy_refresh: float = check(NOT_NEGATIVE, entropy_refresh=entropy_refresh)
        if agents not in (None, *get_args(Agents)):
            raise ValueError(f"agents must be 'max', 'mean' or None, got {agents!r}")
        self._reward_key, self._agents = reward_key, agents
        self._warned: set[str] = set()
        self._next_rows: Tensor | None = None
        self._attached = False
        rest = dtype, reduction, max_priority_within_buffer, device
        super().__init__(max_capacity, alpha, beta, eps, *rest, stratified=stratified)
        self.table = self._empty_table()
        """Signals, reward, replay count and time of writing of every slot."""
        self._names = self.table.names[self.table.fused]

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that are fused, which the table of signals is made for."""
        return self._signals

    @property
    def fusion(self) -> Fusion:
        """How signals become one priority; another one counts its weights at the next update."""
        return self._fusion

    @fusion.setter
    def fusion(self, fusion: Fusion) -> None:
        check_fusion(fusion, [signal.name for signal in self._signals])
        self._fusion, self._weighing = fusion, None

    @property
    def adjustments(self) -> Sequence[Adjustment]:
        """Changes of fused priorities, in order; others count the buffer at the next update."""
        return self._adjustments

    @adjustments.setter
    def adjustments(self, adjustments: Sequence[Adjustment]) -> None:
        check_adjustments(adjustments)
        self._adjustments, self._weighing = tuple(adjustments), None
        self._counting = [adjust.counts for adjust in adjustments]

    @property
    def positive_above(self) -> Level:
        """Reward above which a transition is positive."""
        return self._positive_above

    @positive_above.setter
    def positive_above(self, level: Level) -> None:
        self._positive_above = self.table.positive_above = check(LEVEL, positive_above=level)
        self._weighing = None

    def _empty_table(self) -> SignalTable:
        return SignalTable(
            self._max_capacity,
            self.signals,
            kept=[signal for signal in self.KEPT if signal not in self.signals],
            reward_key=self._reward_key,
            positive_above=self._positive_above,
            agents=self._agents,
            device=self.device,
        )

    @property
    def compiled(self) -> bool:
        """True if compiled loops go through the trees; else TorchRL's do, or a GPU."""
        return bool(self.trees.compiled)

    def _init(self) -> None:
        super()._init()
        self._weighing = None
        self._last_batch: tuple[Tensor, Tensor] | None = None

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each signal at the last count; empty before the first update."""
        if self._weighing is None:
            return {}
        return dict(zip(self._names, self._weighing.weights.tolist(), strict=True))

    def anneal(self, fraction: float) -> None:
        """Move a fusion with a schedule to a share of the training that is done, from 0 to 1."""
        self.fusion.anneal(fraction)

    def _resize(self, capacity: int) -> None:
        super()._resize(capacity)
        self.table = self._empty_table()

    def _empty(self) -> None:
        super()._empty()
        self.table.clear()

    def _maybe_init_from_storage(self, storage: Storage | None) -> None:
        super()._maybe_init_from_storage(storage)
        # A storage of this package has room for them, in its files if it has some.
        if getattr(storage, "signal_table", self.table) is None:
            storage.hold(self.table)  # type: ignore[union-attr]

    def attach(self, storage: Storage) -> SignalTable:
        """Use the storage of a buffer that hands signals on; return the table of the signals."""
        if self.READS_ROWS and not isinstance(storage, TensorStorage):
            raise TypeError(
                f"storage must hold tensors of all steps with {type(self).__name__}, as "
                f"SignalTensorStorage does, got {type(storage).__name__}"
            )
        self._maybe_init_from_storage(storage)
        self._attached = True
        return self.table

    def check_new(self, data: Any, count: int) -> Tensor:
        """Check transitions that are about to be written; nothing is changed.

        Returns:
            Their rows of the table, shape ``[count, C]``.

        Raises:
            KeyError: If a reward or signal that is known at the write is missing.
            ValueError: If one is no finite number for each transition, or a signal is negative.
        """
        return self.table.read(data, count, whole=True)

    def take_rows(self, rows: Tensor | None) -> None:
        """Take rows of :meth:`check_new` for the next :meth:`mark_update`; None: it reads them."""
        self._next_rows = rows

    def _record(self, slots: Tensor, storage: Storage | None) -> None:
        """Keep the signals of new transitions, read from the storage unless they were handed in."""
        if storage is None:
            return
        rows, self._next_rows = self._next_rows, None
        if rows is None:
            rows = self.table.read(Steps(storage, slots), len(slots))
        self.table.write(slots, rows)
        self.table.size = len(storage)

    def check_batch_size(self, batch_size: int) -> None:
        """Reject a batch size that cannot be sampled."""
        check_counts(batch_size=batch_size)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[Any, Tensor]]:
        """Sample slots by Eq. (8), and count a replay for each.

        As :meth:`TreeSampler.sample`; ``"written_at"``, shape ``[B]``, marks overwritten slots.
        """
        slots, weight = self._sampled(storage, batch_size)
        self.table.count_replay(slots)
        written_at = self.table.written_at(slots)
        self._last_batch = (slots, weight)
        info = {"priority_weight": weight, "written_at": written_at}
        return in_dimensions_of(storage, slots), info

    def update_priority(
        self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None
    ) -> None:
        """Set priorities directly, see :meth:`TreeSampler.update_priority`."""
        # TorchRL's buffers hand a first priority to transitions that they find in a storage.
        if not self._attached and self._highest is not None:
            self._warn_once(
                "one number",
                f"{type(self).__name__} was given one number as the priority: it is neither fused "
                "nor adjusted. TorchRL's own buffers do so in update_tensordict_priority. Use "
                "SignalReplayBuffer",
            )
        super().update_priority(index, priority, storage=storage)

    def _warn_once(self, subject: str, text: str) -> None:
        """Warn of a subject that this sampler has not yet warned of."""
        if subject not in self._warned:
            self._warned.add(subject)
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
            storage: The storage of the transitions.
            written_at: The entry of that name in the sampled batch, shape ``[B]``: rows whose
                slot was written since are left out.
            batches: Number of batches of one size in these slots, one after the other; each is
                adjusted by itself.

        Returns:
            Number of rows left out.

        Raises:
            KeyError: If a signal that the sampler fuses is missing.
            IndexError: If a slot was never filled or, without ``written_at``, is not filled now.
            ValueError: If a signal or ``written_at`` has the wrong shape, a signal is negative or
                not finite, or the slots are not so many equal batches.
            TypeError: If the index holds anything but integers.
        """
        table = self.attach(storage)
        sampled = slots = as_slots(index, storage)
        if slots.numel() == 0:
            return 0
        slots = slots.to(table.device)
        # Eqs. (13)-(14); the reward of Eq. (12) was read at the write.
        count = slots.numel()
        rows, slots, sizes = table.learned_rows(slots, signals, written_at, batches)
        stale = count - slots.numel()
        if slots.numel() == 0:
            return stale
        # One group of all batches where that is allowed, else a group for each batch.
        per_group = batches if batches > 1 and stale == 0 and self._takes_batches() else 1
        groups = [(slots, rows)] if per_group > 1 else by_batch(sizes, slots, rows)
        weighing, priorities = self._weighing, []
        for group_slots, group_rows in groups:
            if count := group_slots.numel():
                first_batch = group_slots[: count // per_group]
                weighing = self._weigh(first_batch, weighing)  # Eqs. (15)-(20).
                # Eqs. (21)-(24).
                priorities.append(self._fused(group_rows, group_slots, weighing, per_group))
        priority = priorities[0] if len(priorities) == 1 else torch.cat(priorities)
        if (last := last_of_each(slots)) is not None:
            slots, rows, priority = slots[last], rows[last], priority[last]
        highest = self._checked(priority, "adjusted priorities")

        # Nothing has changed so far, so that a call that raises leaves everything as it was.
        self._weighing = weighing
        table.learn(slots, rows)
        self._set(slots, priority, highest)  # Eq. (8).
        self._learned_from(sampled, storage)
        return stale

    def _learned_from(self, slots: Tensor, storage: Storage) -> None:
        """Change what depends on transitions that were learned from: nothing here."""

    def _weigh(self, index: Tensor, last: Weighing | None) -> Weighing:
        """Return the weights of Eqs. (15)-(20), computed again if enough of the buffer changed."""
        table, refresh = self.table, self.entropy_refresh
        weighing = last or Weighing()
        changed = table.writes - weighing.writes
        due = last is None or refresh == 0 or not 0 <= changed <= refresh * table.size
        if due or self.fusion.every_batch:
            weights = checked_weights(self.fusion, self._names, table, index)
            weighing = replace(weighing, weights=weights)
        if due:
            level, rewards = self.positive_above, table.rewards
            if (text := one_sided(level, rewards, self.fusion, self.adjustments)) is not None:
                self._warn_once("one side", text)
            mean = float(rewards.mean())
            weighing = replace(weighing, mean_reward=mean, writes=table.writes)
        return self._count(len(index), weighing) if any(self._counting) else weighing

    def _count(self, batch_size: int, weighing: Weighing) -> Weighing:
        """Have the adjustments count the buffer, by present weights, if enough of it changed."""
        table = self.table
        changed = table.writes - weighing.counted_writes + weighing.learned_since
        few = 0 <= changed <= COUNT_REFRESH * table.size and self.entropy_refresh > 0
        if weighing.counted and few:
            return replace(weighing, learned_since=weighing.learned_since + batch_size)
        fused = self._combined(table.rows[: table.size], weighing)
        counted, writes = counts_of(self.adjustments, table, fused), table.writes
        return replace(weighing, counted=counted, counted_writes=writes, learned_since=batch_size)

    def _takes_batches(self) -> bool:
        """Return True if equal batches can be fused and adjusted in one call."""
        # Nothing may be counted again between two batches.
        if any(self._counting) or self.fusion.every_batch or self.entropy_refresh == 0:
            return False
        return all(adjust.takes_batches for adjust in self.adjustments)

    def _fused(self, rows: Tensor, slots: Tensor, weighing: Weighing, batches: int) -> Tensor:
        """Return priorities of so many batches by Eqs. (21)-(24), eps included, ``[U * B]``."""
        *_, reward, replay_count, written_at = rows.unbind(1)
        numbers = [self._combined(rows, weighing), reward, replay_count, slots, written_at]
        if batches > 1:
            numbers = [number.view(batches, -1) for number in numbers]
        priority, reward, replay_count, slots, written_at = numbers
        level = weighing.mean_reward if self.positive_above == "mean" else self.positive_above
        facts = BatchFacts(reward, replay_count, slots, level, written_at)
        for place, adjust in enumerate(self.adjustments):
            if weighing.counted:
                facts = replace(facts, counted=weighing.counted[place])
            name = f"priorities of {type(adjust).__name__}"
            priority = check_shape(name, adjust(priority, facts), slots.shape)
        return priority.double().reshape(-1) if batches > 1 else priority.double()

    def _combined(self, rows: Tensor, weighing: Weighing) -> Tensor:
        """Return priorities by Eq. (21), eps included, shape ``[B]``."""
        return fuse(rows[:, self.table.fused], weighing.weights, eps=self._eps)

    def stats(self) -> dict[str, float]:
        """Return the composition of buffer and last batch by name, see ``docs/metrics.md``."""
        return composition(self, self._weighing, self._last_batch)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next batches depend on; tensors and plain values only."""
        last = self._weighing or Weighing()
        return {
            **super().state_dict(),
            "_signals": self.table.state_dict(),
            **last.state_dict(self._names, counts=any(self._counting)),
        }

    def _restore(self, state: dict[str, Any]) -> None:
        check_saved("sampler", state, ("_signals",))
        super()._restore(state)
        self.table = self.table.restored(state["_signals"], self._max_capacity, self.device)
        self._weighing = restored_weighing(state, self._names, self._counting, self.device)

    def _take(self, twin: Any) -> None:
        table = self.table
        super()._take(twin)
        # The storage holds this one.
        table.take(self.table)
        self.table = table
