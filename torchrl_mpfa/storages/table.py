"""The signals of every slot of a storage, in one contiguous tensor."""

from __future__ import annotations

import fcntl
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.checks import (
    COUNT_OR_ZERO,
    bounds,
    check,
    check_counts,
    check_finite,
    check_index,
)
from torchrl_mpfa.saving import check_saved
from torchrl_mpfa.signals import Signal, as_signals

Priority = Callable[[Tensor], Tensor] | None
Columns = slice | Tensor


class SignalTable:
    """Signals, reward, replay count and age of every slot: one contiguous tensor.

    The columns are the learned signals, those known at the write, the signed reward, the replay
    count and the time of writing. A value that is not known yet is NaN. Double precision keeps
    counts and times exact.

    Args:
        capacity: Number of slots ``N``.
        signals: The signals to keep.
        reward_key: Where the signed reward of a transition is read.
        file: Memory-map the table to this file in place of keeping it in memory. No other table
            may be mapped to it as long as this one lives.
        existsok: True to overwrite a file that is there already.

    Raises:
        FileExistsError: If the file is there and ``existsok`` is false, or another table, of this
            process or another, is mapped to it.
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        capacity: int,
        signals: Sequence[Signal | str],
        *,
        reward_key: NestedKey = ("next", "reward"),
        file: Path | None = None,
        existsok: bool = False,
    ) -> None:
        made = as_signals(signals)
        self.capacity = capacity
        self.device = torch.device("cpu")
        self.in_memory = file is None
        self.learned = [s for s in made if s.known_at == "update"]
        self.written = [s for s in made if s.known_at == "write"]
        self.reward_key = reward_key
        self.read_keys = [reward_key, *(s.key for s in self.written)]
        self.names = [s.name for s in (*self.learned, *self.written)]
        self.column = {name: place for place, name in enumerate(self.names)}
        self.reward_column = len(self.names)
        self.count_column = self.reward_column + 1
        self.time_column = self.reward_column + 2
        width = self.reward_column + 3
        if file is None:
            self.rows = torch.empty(capacity, width, dtype=torch.double)
        else:
            self.rows = torch.from_numpy(_map(file, (capacity, width), existsok=existsok))
        self._blank = torch.full((1, width), torch.nan, dtype=torch.double)
        self._blank[0, self.count_column] = 0.0
        self.size = self.cleared = 0
        self.writes = self.loaded = 0
        """Count of all writes, and the same when a state was loaded."""
        self.clock = [0]
        """Count of writes that saved states share, and see change."""
        self.clear()

    def stop_clock(self) -> None:
        """Invalidate states that share the clock: the data are no longer those of its writes."""
        self.clock[0] = -1
        self.clock = [self.writes]

    def to(self, device: torch.device) -> None:
        """Move to the device of the data."""
        self.rows, self.device = self.rows.to(device), device

    def clear(self) -> None:
        """Forget every slot; the count of writes continues, so that earlier batches stay stale."""
        self.rows.copy_(self._blank)
        self.cleared = max(self.cleared, self.size)
        self.size = 0

    def grow(self, capacity: int) -> None:
        """Add slots at the end; only for a table in memory."""
        more = self.blank(capacity - self.capacity, self.device)
        self.rows, self.capacity = torch.cat([self.rows, more]), capacity

    @property
    def rewards(self) -> Tensor:
        """Signed rewards of the filled slots, shape ``[size]``."""
        return self.rows[: self.size, self.reward_column]

    def blank(self, count: int, device: torch.device | str = "cpu") -> Tensor:
        """Return rows of transitions of which nothing is known yet."""
        return self._blank.to(device).expand(count, -1).clone()

    def read(self, data: Any, count: int) -> Tensor:
        """Return checked rows for new transitions, with NaN for missing entries.

        They are on the device of the data, so that checks wait for no other device.
        """
        reward = _column(data, self.reward_key, "reward", count)
        rows = self.blank(count, "cpu" if reward is None else reward.device)
        if reward is not None:
            rows[:, self.reward_column] = reward
        for signal in self.written:
            same = signal.key == self.reward_key
            value = reward if same else _column(data, signal.key, signal.name, count)
            if value is not None:
                rows[:, self.column[signal.name]] = _not_negative(signal, value)
        return rows

    def fill_learned(
        self,
        rows: Tensor,
        signals: Mapping[str, Tensor],
        learned: Mapping[str, Priority],
        live: Tensor | None,
        sizes: Sequence[int],
    ) -> None:
        """Write learned signals of live rows in copies of them, batch by batch."""
        count = len(rows) if live is None else len(live)
        for name, priority_of in learned.items():
            if name not in signals:
                raise KeyError(f"signal {name!r} is missing, got {sorted(signals)}")
            value = signals[name].detach().to(rows.device)
            if value.numel() != count or value.is_complex():
                raise ValueError(
                    f"signal {name!r} must have one real number per transition, got {value.dtype} "
                    f"of shape {[*value.shape]} for {count} slots"
                )
            value = value.reshape(-1) if live is None else value.reshape(-1)[live]
            column = rows.select(1, self.column[name])
            if priority_of is None:
                column.copy_(value)
                continue
            for one, into in by_batch(sizes, value, column):
                if len(one):
                    into.copy_(priority_of(one))

    def check_fused(self, rows: Tensor, names: Sequence[str], columns: Columns) -> None:
        """Reject rows whose signals cannot be fused: missing, negative or not finite."""
        if len(rows) == 0:
            return
        # A NaN makes both of these NaN, so that one pass finds any wrong number.
        chosen = rows[:, columns]
        low, high = bounds(chosen)
        if low >= 0 and high < math.inf:
            return
        written = {signal.name for signal in self.written}
        for name, value in zip(names, chosen.unbind(1), strict=True):
            if name in written and bool(value.isnan().any()):
                raise KeyError(f"signal {name!r} is missing: the stored transitions lack it")
            check_finite(f"signal {name!r}", value)

    def live_rows(
        self, slots: Tensor, written_at: Tensor | None, batches: int
    ) -> tuple[Tensor, Tensor, Tensor | None, list[int]]:
        """Return live rows and slots, the mask of live ones, and the sizes of batches."""
        # A batch from before the table was cleared is stale, as its times of writing show.
        filled = self.size if written_at is None else max(self.size, self.cleared)
        check_counts(batches=batches)
        if len(check_index(slots, filled)) < len(slots):
            raise IndexError(f"index must be in [0, {filled}), the filled slots, got -1")
        if len(slots) % batches:
            raise ValueError(f"{len(slots)} slots cannot make {batches} equal batches")
        rows, sizes = self.rows.index_select(0, slots), [len(slots) // batches] * batches
        if written_at is None:
            return rows, slots, None, sizes
        if written_at.numel() != len(rows):
            raise ValueError(
                "written_at must have one number per transition, got shape "
                f"{[*written_at.shape]} for {len(rows)} slots"
            )
        now = rows.select(1, self.time_column)
        before = written_at.reshape(-1).to(now.device, now.dtype)
        if torch.equal(now, before):
            return rows, slots, None, sizes
        live = now == before
        return rows[live], slots[live], live, live.reshape(batches, -1).sum(1).tolist()

    def missing(self, rows: Tensor) -> str | None:
        """Return the name of the first entry known at the write that some rows lack, or None."""
        # Of two rewards the signal counts first: it is the one that an error should name.
        for name in [*(s.name for s in self.written), "reward"]:
            column = self.column.get(name, self.reward_column)
            if rows[:, column].isnan().any():
                return name
        return None

    def write(self, index: Tensor, rows: Tensor) -> None:
        """Write new transitions in their slots, and reset all else of these slots."""
        count = len(rows)
        if count > self.capacity:
            # Of a slot that is named twice the last row must win, which indexing leaves open.
            self.writes += count - self.capacity
            index, rows = index[-self.capacity :], rows[-self.capacity :]
            count = self.capacity
        index, rows = index.to(self.device), rows.to(self.device)
        if count == 1:
            rows[0, self.time_column] = self.writes
        else:
            times = torch.arange(self.writes, self.writes + count, device=self.device)
            rows[:, self.time_column] = times
        self.rows[index] = rows
        self.writes += count
        self.clock[0] = self.writes

    def count_replay(self, index: Tensor) -> None:
        """Count one replay for each sampled slot, duplicates included."""
        if self.rows.is_cpu:
            np.add.at(self.rows.numpy()[:, self.count_column], index.numpy(), 1.0)
        else:
            one = torch.ones(len(index), dtype=torch.double, device=self.device)
            self.rows.select(1, self.count_column).index_add_(0, index, one)

    def written_at(self, index: Tensor) -> Tensor:
        """Return the time of writing of each slot, a count of writes, shape ``[B]``."""
        return self.rows.select(1, self.time_column).index_select(0, index)

    def replay_counts(self, index: Tensor) -> Tensor:
        """Return the replays of each slot, shape ``[B]``."""
        return self.rows.select(1, self.count_column).index_select(0, index)

    def __getstate__(self) -> dict[str, Any]:
        # A copy is in memory: the file is that of this one.
        return {**vars(self), "rows": self.rows.clone(), "in_memory": True}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that restores the table; tensors and plain values only."""
        return self._state(self.rows[: self.size].to("cpu", copy=True), self.writes)

    def state_of_new(self, rows: Tensor) -> dict[str, Any]:
        """Return the state of a table in whose first slots these rows are written now."""
        # Times continue, so that a batch sampled before is known to be old.
        writes = self.writes + len(rows)
        rows[:, self.time_column] = torch.arange(self.writes, writes)
        return self._state(rows, writes)

    def _state(self, rows: Tensor, writes: int) -> dict[str, Any]:
        kept = {"capacity": self.capacity, "names": list(self.names)}
        return {**kept, "size": len(rows), "writes": writes, "rows": rows}

    def check_state(self, state: dict[str, Any]) -> None:
        """Reject the state of a table of other signals or capacity, or with impossible numbers."""
        kept = {"capacity": self.capacity, "names": self.names}
        check_saved("signals", state, ("size", "writes", "rows"), **kept)
        check(COUNT_OR_ZERO, size=state["size"], writes=state["writes"])
        rows, shape = state["rows"], (min(state["size"], self.capacity), self.rows.shape[1])
        form = (rows.shape, rows.dtype) if isinstance(rows, Tensor) else rows
        if form != (shape, torch.double):
            raise ValueError(f"'rows' of the saved signals must be {[*shape]} doubles, got {form}")
        # NaN stands for what is not known yet.
        known = rows[:, : self.count_column].clone()
        known[:, self.reward_column].abs_()
        check_finite("signals and rewards of the saved signals", known[~known.isnan()])
        rest = rows[:, self.count_column :]
        check_finite("counts and times of the saved signals", rest)
        if len(rest) and (latest := rest[:, -1].max().item()) >= state["writes"]:
            raise ValueError(
                f"times of the saved signals must be below {state['writes']}, got {latest}"
            )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`, or raise as :meth:`check_state`."""
        self.check_state(state)
        self.clear()
        self.size, self.writes = state["size"], state["writes"]
        self.loaded = self.clock[0] = self.writes
        self.rows[: self.size] = state["rows"]


def by_batch(sizes: Sequence[int], *columns: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """Split columns into the parts of each batch."""
    if len(sizes) == 1:
        return [columns]
    return zip(*(column.split(list(sizes)) for column in columns), strict=True)


def signal_table_of(storage: object, signals: Sequence[Signal], capacity: int) -> SignalTable:
    """Return the signals of a storage, which must fit those and the capacity of a sampler."""
    table = getattr(storage, "signal_table", None)
    if not isinstance(table, SignalTable):
        raise TypeError(
            f"storage must keep signals (SignalTensorStorage, SignalMemmapStorage), got "
            f"{type(storage).__name__}"
        )
    if table.capacity != capacity:
        raise ValueError(
            f"max_capacity of the sampler is {capacity}, max_size of the storage {table.capacity}"
        )
    absent = [signal.name for signal in signals if signal.name not in table.column]
    if absent:
        raise ValueError(f"signals {absent} of the sampler are not in the storage: {table.names}")
    return table


def allocate(path: str | Path, size: int = 0) -> None:
    """Reserve room on the disk for a file that is mapped to memory, or raise ``OSError``.

    A write to a mapped file for which the disk has no room would kill the process.
    """
    with open(path, "r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size or os.path.getsize(path) or 1)
        except OSError as error:
            error.filename = str(path)
            raise


def _map(file: Path, shape: tuple[int, int], *, existsok: bool) -> NDArray[np.float64]:
    """Map numbers to a file, which is locked as long as they are in use."""
    file.parent.mkdir(parents=True, exist_ok=True)
    # Opened without emptying it: it may be another's.
    with open(os.open(file, os.O_RDWR | os.O_CREAT, 0o666), "r+b") as opened:
        try:
            # The mapping holds on to the lock after the file is closed.
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise FileExistsError(
                f"{file} is in use by a living storage: give each a scratch_dir of its own"
            ) from None
        if file.stat().st_size and not existsok:
            raise FileExistsError(
                f"{file} is there from an earlier storage: pass existsok=True to overwrite it"
            )
        opened.truncate(0)
        allocate(file, 8 * math.prod(shape))
        return np.memmap(opened, dtype=np.float64, mode="w+", shape=shape)


def _column(data: Any, key: NestedKey, name: str, count: int) -> Tensor | None:
    """Return one finite double per transition, shape ``[count]``, or None without the entry."""
    value = data.get(key, None)
    if value is None:
        return None
    if value.numel() != count or value.is_complex():
        raise ValueError(
            f"{name} at {key!r} must have one real number per transition, got {value.dtype} of "
            f"shape {[*value.shape]} for {count} transitions"
        )
    flat = value.detach().reshape(count).to(torch.double)
    low, high = bounds(flat)
    if not (low > -math.inf and high < math.inf):
        bad = flat[~flat.isfinite()][0].item()
        raise ValueError(f"{name} at {key!r} must be finite, got {bad}")
    return flat


def _not_negative(signal: Signal, value: Tensor) -> Tensor:
    priority = (signal.priority or torch.abs)(value)
    low, high = bounds(priority)
    if not (low >= 0 and high < math.inf):
        check_finite(f"signal {signal.name!r}", priority)
    return priority
