"""Signals beside the data of a TorchRL storage: checks and writes of transitions, and files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.checks import as_mask, generator_on
from torchrl_mpfa.files import load_safely, open_dump, save_atomically, seal_dump
from torchrl_mpfa.saved import Entry, check_entries, exactly
from torchrl_mpfa.storages.schema import INDEX_KEY, Pairs, Schema, check_finite_entries
from torchrl_mpfa.storages.states import (
    check_data_state,
    check_length,
    of_any_device,
    read_metadata,
    rows_of_data,
    signals_of_data,
)
from torchrl_mpfa.storages.table import SignalTable

_FORMAT = 1
_FILE = "signals.pt"
_CLOCK = "_signals_clock"
"""Entry of a state: the count of writes as it is now, not as it was."""


class SignalStorageMixin:
    """Adds a :class:`~torchrl_mpfa.storages.SignalTable` to a TorchRL storage.

    Every write of a slot resets its signals, whichever writer makes it, so that a transition
    never has those of the one that was there before; nothing of them shows in sampled batches.
    Transitions that do not fit are rejected before any of them is written.
    """

    signal_table: SignalTable
    ndim: int
    max_size: int
    #: Set by :class:`~torchrl_mpfa.SignalReplayBuffer`: every entry must be there and finite.
    strict = False
    #: Set by a buffer whose sampler fuses: a write without reward or signal is rejected.
    needs_signals = False
    #: Set by the same buffer: further entries that its sampler reads.
    needed_keys: Sequence[NestedKey] = ()
    #: Set by the same buffer: entries that its sampler reads as booleans.
    mask_keys: Sequence[NestedKey] = ()
    _allow_nonfinite: Sequence[NestedKey] = ()
    _schema: Schema | None = None
    _all_slots: Tensor | None = None
    _rng: torch.Generator | None

    def check(self, data: Any) -> tuple[Tensor | None, Pairs | None]:
        """Check transitions that are about to be written; nothing is changed.

        Args:
            data: Transitions, batch size ``[B]``, or ``[T, B]`` for a storage of two dimensions.

        Returns:
            Their rows of the signal table, or None if they have no entries that could be read; and
            pairs of a stored entry and its new values, or None if TorchRL has to find them.

        Raises:
            KeyError: If an entry is missing or unknown, or a reward or signal that the sampler
                needs is missing.
            ValueError: If shape or dtype of an entry are not those in the storage, or a number is
                not finite.
        """
        if not is_tensor_collection(data):
            return None, None
        for key in self.needed_keys:
            if data.get(key, None) is None:
                raise KeyError(f"the transitions lack {key!r}, which the sampler reads")
        for key in self.mask_keys:
            if (mask := data.get(key, None)) is not None:
                as_mask(repr(key), mask)
        lead = min(self.ndim, data.ndim)
        pairs = None
        if isinstance(data, TensorDictBase):
            self._check_shape(data)
            schema = self._known_schema()
            if schema is not None:
                pairs = schema.check(data, lead, whole=self.strict)
            elif self.strict:
                check_finite_entries(data, lead, self._allow_nonfinite)
        rows = self.signal_table.read(data, data.shape[:lead].numel())
        self._check_known(rows)
        return rows, pairs

    def get(self, index: Any) -> Any:
        """Read transitions; all slots come as a tensordict that shares their tensors."""
        found = super().get(index)  # type: ignore[misc]
        # A full storage gives itself in TorchRL, where a buffer's transform then writes in it.
        own = found is self._storage and isinstance(found, TensorDictBase)  # type: ignore[attr-defined]
        return found.copy() if own else found

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Write transitions and reset the signals of their slots, or raise as :meth:`check`."""
        rows, pairs = self.check(_as_batch(data))
        size = len(self)  # type: ignore[arg-type]
        try:
            if not (set_cursor and self._write(cursor, data, pairs)):
                super().set(cursor, data, set_cursor=set_cursor)  # type: ignore[misc]
                self._schema = None
        except BaseException:
            # TorchRL counts the rows before it writes them.
            self._len = size
            raise
        if self.max_size > self.signal_table.capacity:
            self.signal_table.grow(self.max_size)
        self._settle_device()
        table, slots = self.signal_table, self._slots(cursor)
        table.write(slots, table.blank(len(slots)) if rows is None else rows)
        table.size = len(self)  # type: ignore[arg-type]

    @contextmanager
    def rewriting(self, entries: Any, index: Any) -> Iterator[None]:
        """Check entries that are written in place inside of it, and read the signals again.

        All entries are as they were if it raises. Without an ``index`` of slots TorchRL checks the
        entries, but not whether their numbers are finite.
        """
        schema = self._known_schema() if self.strict else None
        if schema is not None and index is None:
            check_finite_entries(TensorDict(dict(entries)), 1, self._allow_nonfinite)
        elif schema is not None:
            filled = self.get(slice(None)).shape[: self.ndim]
            slots = torch.zeros(()).expand(filled)[index].shape
            try:
                given = TensorDict(dict(entries), slots)
            except RuntimeError as error:
                raise ValueError(
                    f"entries {[*dict(entries)]} must be of {[*slots]} transitions: {error}"
                ) from None
            schema.check(given, len(slots), whole=True, some=True)
        stored = self._storage if self.initialized else None  # type: ignore[attr-defined]
        kept = []
        if isinstance(stored, TensorDictBase):
            found = (stored.get(key, None) for key in self.signal_table.read_keys)
            kept = [(entry, entry.clone()) for entry in found if entry is not None]
        try:
            yield
            rows = rows_of_data(self.signal_table, stored, len(self))  # type: ignore[arg-type]
        except BaseException:
            for entry, before in kept:
                entry.copy_(before)
            raise
        self.signal_table.rewrite(rows)

    def _settle_device(self) -> None:
        """Move the signals to the device of the data, once it is known."""
        device = self.device  # type: ignore[attr-defined]
        if device != self.signal_table.device and isinstance(device, torch.device):
            self.signal_table.to(device)

    def _rand_given_ndim(self, batch_size: int) -> Any:
        """Slots sampled uniformly, as TorchRL does, which asks for a generator on the device."""
        kept, device = self._rng, getattr(self, "device", None)
        if not isinstance(device, torch.device):
            return super()._rand_given_ndim(batch_size)  # type: ignore[misc]
        self._rng = generator_on(device, kept)
        try:
            return super()._rand_given_ndim(batch_size)  # type: ignore[misc]
        finally:
            self._rng = kept

    def _check_known(self, rows: Tensor) -> None:
        """Reject rows of the signal table that lack an entry that the sampler needs."""
        if self.needs_signals and (name := self.signal_table.missing(rows)) is not None:
            keys = {s.name: s.key for s in self.signal_table.written}
            key = keys.get(name, self.signal_table.reward_key)
            raise KeyError(f"the transitions lack {name!r}: no finite entry at {key!r}")

    def _check_shape(self, data: TensorDictBase) -> None:
        """Reject rows of another width than those of a storage of several dimensions."""
        if self.ndim == 1 or data.ndim < self.ndim:
            return
        across = data.shape[1 : self.ndim]
        if self.initialized:  # type: ignore[attr-defined]
            expected = self._total_shape[1:]  # type: ignore[attr-defined]
            if across != expected:
                raise ValueError(
                    f"transitions must come {[*expected]} at a time, as the first ones did, got "
                    f"{[*across]}"
                )
        elif self.max_size % across.numel() and (
            # TorchRL rounds up; the sampler that fuses, or the file of the signals, could not.
            self.needs_signals or not self.signal_table.in_memory
        ):
            raise ValueError(
                f"max_size must be a multiple of the {across.numel()} transitions that come at a "
                f"time, got {self.max_size}"
            )

    def _known_schema(self) -> Schema | None:
        """Schema of the stored tensordict; None if there is none yet."""
        stored = getattr(self, "_storage", None)
        # What an empty storage was restored from is a tensordict without entries.
        if not self.initialized or type(stored) is not TensorDict:  # type: ignore[attr-defined]
            return None
        if self._schema is None or not self._schema.describes(stored):
            self._schema = Schema(stored, self.ndim, self._allow_nonfinite)
        return self._schema

    def _write(self, cursor: Any, data: Any, pairs: Pairs | None) -> bool:
        """Write checked entries one by one; False if TorchRL has to write them."""
        if not (
            self.strict
            and pairs
            and self.ndim == 1
            and isinstance(cursor, Tensor)
            and cursor.ndim == 1
            and cursor.dtype is torch.long
            and len(cursor) <= self.max_size
            and self._schema is not None
            and self._schema.only_tensors
        ):
            return False
        if (data.get(INDEX_KEY, None) is None) != (self._schema.index is None):
            return False
        device = cursor.device
        if any(value.device != device or stored.device != device for stored, value in pairs):
            return False
        self._set_last_cursor(cursor)  # type: ignore[attr-defined]
        with torch.no_grad():
            for stored, value in pairs:
                stored.index_copy_(0, cursor, value)
        self._len = min(len(self) + len(cursor), self.max_size)  # type: ignore[arg-type]
        self._bump_mutation_revision()  # type: ignore[attr-defined]
        return True

    def _slots(self, cursor: Any) -> Tensor:
        """Numbers of the slots that a writer's cursor names, shape ``[B]``."""
        if self.ndim == 1:
            return _as_index(cursor, self.max_size)
        if self._all_slots is None:
            self._all_slots = torch.arange(self.max_size).reshape(self._total_shape)  # type: ignore[attr-defined]
        if isinstance(cursor, Tensor):
            cursor = cursor.cpu()
        return self._all_slots[cursor].reshape(-1)

    def _empty(self) -> None:
        super()._empty()  # type: ignore[misc]
        self.signal_table.clear()

    def state_dict(self) -> dict[str, Any]:
        """The data, and the signals under ``"_signals"``.

        As in TorchRL the data are not copied: save or copy the state before more is written, after
        which it is rejected.
        """
        state: dict[str, Any] = super().state_dict()  # type: ignore[misc]
        table = self.signal_table
        own = {"_signals": table.state_dict(), "_signals_format": _FORMAT, _CLOCK: table.clock}
        return {**state, **own}

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Reject a state that does not fit, before anything changes.

        Raises:
            KeyError: If the state lacks an entry, or a reward or signal that the sampler needs.
            ValueError: If format, capacity, signals, or the form of the data differ, the data are
                not finite, or they were overwritten since the state was made.
        """
        self._checked_signals(state_dict)

    def _checked_signals(self, state: dict[str, Any]) -> dict[str, Any]:
        """The signals of a state that was checked, saved or, in TorchRL's own, made of the data."""
        foreign = "_signals" not in state and "_signals_format" not in state
        if not foreign:
            self._check_signals(state)
        check_entries("storage", state, map(Entry, ("_storage", "_len", "initialized")))
        rows = None if foreign else state["_signals"]["size"]
        length = check_length(state["_len"], self.max_size, rows)
        filled = Entry(
            "initialized",
            lambda found: isinstance(found, bool) and found >= bool(length),
            f"true with {length} rows",
        )
        check_entries("storage", state, [filled])
        self._check_data(state["_storage"], length)
        if not foreign:
            signals: dict[str, Any] = state["_signals"]
            return signals
        signals = signals_of_data(self.signal_table, state["_storage"], length)
        self._check_known(signals["rows"])
        return signals

    def _check_signals(self, state: dict[str, Any]) -> None:
        known = [
            exactly("_signals_format", _FORMAT, ", which this version reads"),
            Entry("_signals"),
        ]
        check_entries("storage", state, known)
        self.signal_table.check_state(state["_signals"])
        # The signals of a folder have none.
        if state.get(_CLOCK) not in (None, [state["_signals"]["writes"]]):
            raise ValueError(
                "the storage was written to since this state of it was made, whose data are the "
                "storage's own: save or copy a state before more is written"
            )

    def _check_data(self, data: Any, length: int) -> None:
        check_data_state(
            data,
            getattr(self, "_storage", None),
            length=length,
            ndim=self.ndim,
            max_size=self.max_size,
            allow_nonfinite=self._allow_nonfinite if self.strict else None,
        )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore data and signals.

        The state of one of TorchRL's own storages has no signals: its transitions count as written
        now, in the order of their slots. Their rewards are read from the data, and what a learner
        would have computed is not known yet.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`.
        """
        signals = self._checked_signals(state_dict)
        if state_dict.get(_CLOCK) is not self.signal_table.clock:
            self.signal_table.stop_clock()
        data = of_any_device(state_dict["_storage"])
        super().load_state_dict({**state_dict, "_storage": data})  # type: ignore[misc]
        self._schema = None
        self.signal_table.load_state_dict(signals)

    def dumps(self, path: str | Path) -> None:
        """Save data and signals in a folder, with a checksum of each of its files."""
        path = Path(path)
        super().dumps(path)  # type: ignore[misc]
        state = {"_signals": self.signal_table.state_dict(), "_signals_format": _FORMAT}
        save_atomically(state, path / _FILE)
        seal_dump(path, path)

    def check_dump(self, path: str | Path) -> dict[str, Any]:
        """Read the saved signals, and reject the folder as :meth:`check_state` does a state.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`; or if a file is damaged, missing, or one that
                could execute something.
        """
        path = open_dump(path)
        if not (path / _FILE).exists():
            raise KeyError(f"'_signals' is missing in the saved storage: no {path / _FILE}")
        state: dict[str, Any] = load_safely(path / _FILE)
        self._check_signals(state)
        found, is_tree = read_metadata(path)
        length = check_length(found, self.max_size, state["_signals"]["size"])
        if not is_tree:
            self._check_data(TensorDict.load_memmap(path, allow_pickle=False), length)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore data and signals from a folder, or raise as :meth:`check_dump` does."""
        state = self.check_dump(path)
        self.signal_table.stop_clock()
        super().loads(path)  # type: ignore[misc]
        self._schema = None
        self.signal_table.load_state_dict(state["_signals"])

    def __getstate__(self) -> Any:
        # The copy describes its own data.
        state: Any = super().__getstate__()
        return {**state, "_schema": None}


def _as_index(cursor: Any, capacity: int) -> Tensor:
    """The slots that a writer's cursor names, shape ``[B]``."""
    if isinstance(cursor, slice):
        return torch.arange(*cursor.indices(capacity))
    if isinstance(cursor, Tensor) and cursor.dtype is torch.bool:
        return cursor.nonzero().squeeze(1)
    return torch.as_tensor(cursor, dtype=torch.long).reshape(-1)


def _as_batch(data: Any) -> Any:
    """A list of transitions as one batch; anything else as it is."""
    if isinstance(data, list) and data and is_tensor_collection(data[0]):
        return torch.stack(data)
    return data
