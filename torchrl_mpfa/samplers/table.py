"""The signals of every slot of a buffer, in one contiguous tensor."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from typing import Any, Literal

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.checks import (
    COUNT_OR_ZERO,
    Level,
    bounds,
    check,
    check_counts,
    check_index,
    check_not_negative,
    check_shape,
)
from torchrl_mpfa.native.tables import describe, fits, give, has_loops, join, tally
from torchrl_mpfa.saving import check_saved
from torchrl_mpfa.signals import Signal, as_signals

Agents = Literal["max", "mean"]
"""Number of a transition out of those of its agents: the largest one, or their mean."""
_LACKS = "the transitions lack {!r}: no finite entry at {!r}"


class SignalTable:
    """Signals, reward, replay count and time of writing of every slot: one contiguous tensor.

    The columns are the learned signals, those known at the write, what is kept and not fused, the
    signed reward, the replay count and the time of writing. A value that is not known yet is NaN.
    Double precision keeps counts and times exact.

    TorchRL's generations (``track_generations``) answer whether a slot was overwritten too, but
    not when, which ages, slices and episodes need.

    Args:
        capacity: Number of slots ``N``.
        signals: The signals that are fused.
        kept: Further signals, known at the write.
        reward_key: Where the signed reward of a transition is read.
        positive_above: A transition is positive when its reward is above this, a number or
            ``"mean"``, the mean reward of the buffer.
        agents: Number of a transition out of those of its agents, as :class:`SignalSampler` has it.
        device: Device of the tensor.
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        capacity: int,
        signals: Sequence[Signal | str],
        *,
        kept: Sequence[Signal] = (),
        reward_key: NestedKey = ("next", "reward"),
        positive_above: Level = 0.0,
        agents: Agents | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.capacity, self.reward_key = capacity, reward_key
        self.positive_above, self.agents = positive_above, agents
        fused = as_signals(signals)
        self.learned = [s for s in fused if s.known_at == "update"]
        self.written = [*(s for s in fused if s.known_at == "write"), *kept]
        self.read_keys = [reward_key, *(s.key for s in self.written)]
        self.names = [s.name for s in (*self.learned, *self.written)]
        self.fused = slice(len(fused))
        """Columns of the signals that are fused."""
        self.column = {name: place for place, name in enumerate(self.names)}
        self.reward_column = len(self.names)
        self.count_column = self.reward_column + 1
        self.time_column = self.reward_column + 2
        columns = self.reward_column + 3
        self._blank = torch.full((1, columns), torch.nan, dtype=torch.double, device="cpu")
        self._blank[0, self.count_column] = 0.0
        self.rows = self.blank(capacity, device)
        self.size = self.cleared = 0
        self.writes = self.loaded = 0
        """Count of all writes, and the same when a state was loaded."""

    @property
    def device(self) -> torch.device:
        """Device of the tensor."""
        return self.rows.device

    def move_to(self, rows: Tensor) -> None:
        """Keep the numbers in this tensor from now on."""
        rows.copy_(self.rows)
        self.rows = rows

    def take(self, other: SignalTable) -> None:
        """Take over the content of another table of the same signals, in the tensor of this one."""
        self.cleared = max(self.cleared, self.size)
        self.size, self.writes, self.loaded = other.size, other.writes, other.loaded
        if (self.rows.shape, self.device) == (other.rows.shape, other.device):
            self.rows.copy_(other.rows)
        else:
            self.capacity, self.rows = other.capacity, other.rows

    def clear(self) -> None:
        """Forget every slot; the count of writes continues, so that earlier batches stay stale."""
        self.rows.copy_(self._blank)
        self.cleared = max(self.cleared, self.size)
        self.size = 0

    @property
    def rewards(self) -> Tensor:
        """Signed rewards of the filled slots, shape ``[size]``."""
        return self.rows[: self.size, self.reward_column]

    @property
    def level(self) -> float:
        """Reward above which a transition is positive."""
        level = self.positive_above
        return float(self.rewards.mean()) if level == "mean" else float(level)

    def blank(self, count: int, device: torch.device | str = "cpu") -> Tensor:
        """Return rows of transitions of which nothing is known yet."""
        return self._blank.to(device).expand(count, -1).clone()

    def read(self, data: Any, count: int, *, whole: bool = False) -> Tensor:
        """Return checked rows for new transitions, with NaN for entries that are missing.

        They are on the device of the data, so that checks wait for no other device.

        Raises:
            KeyError: If ``whole`` and an entry is missing.
            ValueError: If one is no finite number for each transition, or a signal is negative.
        """
        if (rows := self._described(data, count)) is not None:
            return rows
        reward = self._column(data, self.reward_key, "reward", count)
        rows = self.blank(count, "cpu" if reward is None else reward.device)
        for signal in self.written:
            same = signal.key == self.reward_key
            value = reward if same else self._column(data, signal.key, signal.name, count)
            if value is not None:
                rows.select(1, self.column[signal.name]).copy_(_written_priority(signal, value))
            elif whole:
                raise KeyError(_LACKS.format(signal.name, signal.key))
        if reward is not None:
            rows.select(1, self.reward_column).copy_(reward)
        elif whole:
            raise KeyError(_LACKS.format("reward", self.reward_key))
        return rows

    def _described(self, data: Any, count: int) -> Tensor | None:
        """Return rows for new transitions by a loop; None where PyTorch has to, or finds fault."""
        if not has_loops(self.rows):
            return None
        reward = data.get(self.reward_key, None)
        numbers = [(reward, self.reward_column)]
        for signal in self.written:
            same = signal.key == self.reward_key
            value = reward if same else data.get(signal.key, None)
            if not fits(value, count, torch.float, torch.double):
                return None
            priority = _priority(signal, value.detach().reshape(count))
            numbers.append((priority, self.column[signal.name]))
        return describe(self.rows, numbers, count)

    def learned_rows(
        self,
        slots: Tensor,
        signals: Mapping[str, Tensor],
        written_at: Tensor | None,
        batches: int,
    ) -> tuple[Tensor, Tensor, Tensor | None, list[int]]:
        """Return copies of live rows with new learned signals, and as :meth:`_live_rows`.

        Raises:
            KeyError: If a signal is missing.
            IndexError: If a slot is not filled.
            ValueError: If a signal is negative, not finite or of another shape, or the slots are
                not so many equal batches.
        """
        new = [signals.get(s.name) for s in self.learned if s.priority is None]
        equal = type(batches) is int and batches > 0 and slots.numel() % batches == 0
        if equal and len(new) == len(self.learned) and has_loops(self.rows):
            end = self._reachable(written_at)
            rows = join(self.rows, slots, new, written_at, end, self.fused.stop)
            if rows is not None:
                return rows, slots, None, [slots.numel() // batches] * batches
        rows, slots, live, sizes = self._live_rows(slots, written_at, batches)
        self.fill_learned(rows, signals, live, sizes)
        self._check_fused(rows)
        return rows, slots, live, sizes

    def _reachable(self, written_at: Tensor | None) -> int:
        """Return the slots that a batch may be of."""
        # A batch from before the table was cleared is stale, as its times of writing show.
        return self.size if written_at is None else max(self.size, self.cleared)

    def fill_learned(
        self, rows: Tensor, signals: Mapping[str, Tensor], live: Tensor | None, sizes: Sequence[int]
    ) -> None:
        """Write learned signals of live rows in copies of them, batch by batch."""
        count = rows.shape[0] if live is None else live.shape[0]
        for signal in self.learned:
            name = signal.name
            if name not in signals:
                raise KeyError(f"signal {name!r} is missing, got {sorted(signals)}")
            value = self._one_each(f"signal {name!r}", signals[name].detach(), count)
            value = value if live is None else value.to(live.device)[live]
            column = rows.select(1, self.column[name])
            if signal.priority is None:
                column.copy_(value)
                continue
            for one, into in by_batch(sizes, value.to(rows.device), column):
                if len(one):
                    into.copy_(_priority(signal, one))

    def _check_fused(self, rows: Tensor) -> None:
        """Reject rows whose signals cannot be fused: missing, negative or not finite."""
        if rows.numel() == 0:
            return
        # A NaN makes both of these NaN, so that one pass finds any wrong number.
        chosen = rows[:, self.fused]
        low, high = bounds(chosen.T)
        if low >= 0 and high < math.inf:
            return
        written = {signal.name for signal in self.written}
        for name, value in zip(self.names, chosen.unbind(1), strict=False):
            if name in written and bool(value.isnan().any()):
                raise KeyError(f"signal {name!r} is missing: the stored transitions lack it")
            check_not_negative(f"signal {name!r}", value)

    def _live_rows(
        self, slots: Tensor, written_at: Tensor | None, batches: int
    ) -> tuple[Tensor, Tensor, Tensor | None, list[int]]:
        """Return live rows and slots, the mask of live ones, and the sizes of batches."""
        filled = self._reachable(written_at)
        if type(batches) is not int or batches < 1:
            check_counts(batches=batches)
        count = slots.numel()
        if count % batches:
            raise ValueError(f"{count} slots cannot make {batches} equal batches")
        if check_index(slots, filled).numel() < count:
            raise IndexError(f"index must be in [0, {filled}), the filled slots, got -1")
        rows, sizes = self.rows.index_select(0, slots), [count // batches] * batches
        if written_at is None:
            return rows, slots, None, sizes
        if written_at.numel() != count:
            raise ValueError(
                "written_at must have one number per transition, got shape "
                f"{[*written_at.shape]} for {count} slots"
            )
        now = rows.select(1, self.time_column)
        before = written_at.reshape(-1).to(now.device, now.dtype)
        if torch.equal(now, before):
            return rows, slots, None, sizes
        live = now == before
        return rows[live], slots[live], live, live.reshape(batches, -1).sum(1).tolist()

    def _column(self, data: Any, key: NestedKey, name: str, count: int) -> Tensor | None:
        """Return one finite double per transition, shape ``[count]``, or None without the entry."""
        value = data.get(key, None)
        if value is None:
            return None
        flat = self._one_each(f"{name} at {key!r}", value.detach(), count).to(torch.double)
        low, high = bounds(flat)
        if not (low > -math.inf and high < math.inf):
            bad = flat[~flat.isfinite()][0].item()
            raise ValueError(f"{name} at {key!r} must be finite, got {bad}")
        return flat

    def _one_each(self, name: str, value: Tensor, count: int) -> Tensor:
        """Return one number per transition out of those of its agents, shape ``[count]``."""
        if value.numel() == count and not value.is_complex():
            return value.reshape(count)
        several = self.agents is not None and value.ndim > 1 and len(value) == count
        if not several or value.is_complex():
            raise ValueError(
                f"{name} must have one real number per transition, got {value.dtype} of shape "
                f"{[*value.shape]} for {count} transitions: of several agents give the sampler "
                "agents='max' or 'mean'"
            )
        of_agents = value.reshape(count, -1)
        if self.agents == "mean":
            return of_agents.mean(1)
        # With its sign, which says whether a reward is positive.
        return of_agents.gather(1, of_agents.abs().argmax(1, keepdim=True)).squeeze(1)

    def write(self, index: Tensor, rows: Tensor) -> None:
        """Write new transitions in their slots, and reset all else of these slots."""
        count = len(rows)
        if count > self.capacity:
            # Of a slot that is named twice the last row must win, which indexing leaves open.
            self.writes += count - self.capacity
            index, rows = index[-self.capacity :], rows[-self.capacity :]
            count = self.capacity
        index, rows = index.to(self.device), rows.to(self.device)
        if has_loops(self.rows):
            give(self.rows, index, rows, self.rows.shape[1] - 1, time=self.writes)
        else:
            times = torch.arange(self.writes, self.writes + count, device=self.device)
            rows[:, self.time_column] = times
            self.rows[index] = rows
        self.writes += count

    def learn(self, slots: Tensor, rows: Tensor) -> None:
        """Write the learned signals of rows of :meth:`_live_rows`; the last of a slot counts."""
        count = len(self.learned)
        if has_loops(self.rows):
            give(self.rows, slots, rows, count)
        else:
            self.rows[:, :count].index_copy_(0, slots, rows[:, :count])

    def count_replay(self, index: Tensor) -> None:
        """Count one replay for each sampled slot, duplicates included."""
        if has_loops(self.rows):
            tally(self.rows, self.count_column, index)
        else:
            one = torch.ones(len(index), dtype=torch.double, device=self.device)
            self.rows.select(1, self.count_column).index_add_(0, index, one)

    def written_at(self, index: Tensor) -> Tensor:
        """Return the time of writing of each slot, a count of writes, shape ``[B]``."""
        return self.rows.select(1, self.time_column).index_select(0, index)

    def replay_counts(self, index: Tensor) -> Tensor:
        """Return the replays of each slot, shape ``[B]``."""
        return self.rows.select(1, self.count_column).index_select(0, index)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that restores the table; tensors and plain values only."""
        rows = self.rows[: self.size].to("cpu", copy=True)
        return {"names": list(self.names), "size": self.size, "writes": self.writes, "rows": rows}

    def restored(self, state: Any, capacity: int, device: torch.device) -> SignalTable:
        """Return a table with the result of :meth:`state_dict`; this one stays as it is.

        Raises:
            KeyError: If an entry is missing.
            ValueError: If the state is of other signals, or has an impossible number.
        """
        check_saved("signals", state, ("size", "writes", "rows"), names=self.names)
        check(COUNT_OR_ZERO, size=state["size"], writes=state["writes"])
        rows, shape = state["rows"], (min(state["size"], capacity), self._blank.shape[1])
        form = (rows.shape, rows.dtype) if isinstance(rows, Tensor) else rows
        if form != (shape, torch.double):
            raise ValueError(f"'rows' of the saved signals must be {[*shape]} doubles, got {form}")
        # NaN stands for what is not known yet.
        numbers = rows[:, : self.count_column].clone()
        numbers[:, self.reward_column].abs_()
        check_not_negative("signals and rewards of the saved signals", numbers[~numbers.isnan()])
        rest = rows[:, self.count_column :]
        check_not_negative("counts and times of the saved signals", rest)
        if len(rest) and (latest := rest[:, -1].max().item()) >= state["writes"]:
            raise ValueError(
                f"times of the saved signals must be below {state['writes']}, got {latest}"
            )
        table = copy(self)
        table.capacity, table.rows = capacity, self.blank(capacity, device)
        table.rows[: len(rows)] = rows.to(device)
        table.size, table.writes, table.loaded = state["size"], state["writes"], state["writes"]
        return table


def by_batch(sizes: Sequence[int], *columns: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """Split columns into the parts of each batch."""
    if len(sizes) == 1:
        return [columns]
    return zip(*(column.split(list(sizes)) for column in columns), strict=True)


def _priority(signal: Signal, value: Tensor) -> Tensor:
    """Return the priorities of a signal by its function, by default the absolute values."""
    name = f"priority of signal {signal.name!r}"
    return check_shape(name, (signal.priority or torch.abs)(value), value.shape)


def _written_priority(signal: Signal, value: Tensor) -> Tensor:
    """Return the priorities of a signal known at the write, of finite numbers."""
    if signal.priority is None:
        return value.abs()
    priority = _priority(signal, value)
    low, high = bounds(priority)
    if not (low >= 0 and high < math.inf):
        check_not_negative(f"signal {signal.name!r}", priority)
    return priority
