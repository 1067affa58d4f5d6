"""Signals of every slot of a TorchRL storage: checks and writes of transitions, and files."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import MappingProxyType
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_mpfa.checks import as_mask, check_counts, generator_on
from torchrl_mpfa.saving import check_saved, load_safely, open_dump, save_atomically, seal_dump
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.storages.schema import INDEX_KEY, Pairs, Schema, as_index, check_finite_entries
from torchrl_mpfa.storages.table import SignalTable, allocate

_FORMAT = 1
_FILE = "signals.pt"
_CLOCK = "_signals_clock"
"""Entry of a state: the count of writes as it is now, not as it was."""


class SignalStorageMixin:
    """Adds a :class:`~torchrl_mpfa.storages.SignalTable` to a TorchRL storage.

    Every write of a slot resets its signals, by any writer, so that a transition never has the
    signals of the transition before it. Sampled batches hold no signals. Transitions that do not
    fit are rejected before any of them is written.

    Args:
        max_size: Capacity ``N``.
        signals: The signals to keep, as objects or names; those of the paper by default.
        reward_key: Where the signed reward of a transition is read.
        allow_nonfinite: Entries that may hold NaN and infinities; none by default.
        **kwargs: Arguments of TorchRL's storage. With ``ndim=2`` a slot is a step of one of several
            environments, as in TorchRL, and ``max_size`` must be a multiple of their number.

    Raises:
        ValueError: If ``max_size`` is not positive, or the signals are none or twice the same.
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
    _mapped: Mapping[str, Any] = MappingProxyType({})
    """File of the signals, where they are memory-mapped."""
    _schema: Schema | None = None
    _all_slots: Tensor | None = None
    _rng: torch.Generator | None

    def __init__(
        self,
        max_size: int,
        *,
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        reward_key: NestedKey = ("next", "reward"),
        allow_nonfinite: Sequence[NestedKey] = (),
        **kwargs: Any,
    ) -> None:
        max_size = check_counts(max_size=max_size)
        self._allow_nonfinite = tuple(allow_nonfinite)
        self.signal_table = SignalTable(max_size, signals, reward_key=reward_key, **self._mapped)
        super().__init__(max_size, **kwargs)  # type: ignore[call-arg]

    def check(self, data: Any) -> tuple[Tensor | None, Pairs | None]:
        """Check transitions that are about to be written; nothing is changed.

        Args:
            data: Transitions, batch size ``[B]``, or ``[T, B]`` for a storage of two dimensions.

        Returns:
            Their rows of the signal table, or None if they have no entries; and pairs of a stored
            entry and its new values, or None if TorchRL has to find them.

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
        found = super().get(as_index(index))  # type: ignore[misc]
        # A full storage gives itself in TorchRL, where a buffer's transform then writes in it.
        own = found is self._storage and isinstance(found, TensorDictBase)  # type: ignore[attr-defined]
        return found.copy() if own else found

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Write transitions and reset the signals of their slots, or raise as :meth:`check`."""
        cursor = as_index(cursor)
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

    def _settle_device(self) -> None:
        """Move the signals to the device of the data, once it is known."""
        device = self.device  # type: ignore[attr-defined]
        if device != self.signal_table.device and isinstance(device, torch.device):
            self.signal_table.to(device)

    def _rand_given_ndim(self, batch_size: int) -> Any:
        """Sample slots uniformly, as TorchRL, which asks for a generator on the device."""
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
        """Return the schema of the stored tensordict; None before the first write."""
        stored = getattr(self, "_storage", None)
        # What an empty storage was restored from is a tensordict without entries.
        if not self.initialized or type(stored) is not TensorDict:  # type: ignore[attr-defined]
            return None
        if self._schema is None or not self._schema.describes(stored):
            self._schema = Schema(stored, self.ndim, self._allow_nonfinite)
        return self._schema

    def _write(self, cursor: Any, data: Any, pairs: Pairs | None) -> bool:
        """Write checked entries one by one; return False if TorchRL has to write them."""
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
        """Return the slots that a writer's cursor names, shape ``[B]``."""
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
        """Return the data, and the signals under ``"_signals"``.

        As in TorchRL the data are not copied: save or copy the state before more is written, after
        which the state is rejected.
        """
        state: dict[str, Any] = super().state_dict()  # type: ignore[misc]
        table = self.signal_table
        own = {"_signals": table.state_dict(), "_signals_format": _FORMAT, _CLOCK: table.clock}
        return {**state, **own}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore data and signals; the saved transitions are checked as new ones are.

        The state of one of TorchRL's own storages has no signals: its transitions count as written
        now, in the order of their slots. Their rewards are read from the data, and learned signals
        are unknown.

        Raises:
            KeyError: If an entry, or a reward or signal that the sampler needs, is missing; nothing
                is changed.
            ValueError: If format, capacity, signals or the form of the data differ, a number is not
                finite, or the data were overwritten since the state was made; nothing is changed.
        """
        check_saved("storage", state_dict, ("_storage", "_len", "initialized"))
        data = _of_any_device(state_dict["_storage"])
        signals: Any = state_dict.get("_signals")
        if not {"_signals", "_signals_format"}.isdisjoint(state_dict):
            check_saved("storage", state_dict, ("_signals",), _signals_format=_FORMAT)
            # The signals of a folder have no clock.
            if state_dict.get(_CLOCK) not in (None, [signals["writes"]]):
                raise ValueError(
                    "the storage was written to since this state of it was made, whose data are "
                    "the storage's own: save or copy a state before more is written"
                )
        tree = TensorDict()
        found = tree.load_state_dict(data, strict=False) if isinstance(data, Mapping) else data
        signals = self._checked(found, state_dict["_len"], signals)
        if state_dict.get(_CLOCK) is not self.signal_table.clock:
            self.signal_table.stop_clock()
        super().load_state_dict({**state_dict, "_storage": data})  # type: ignore[misc]
        self._settle_loaded(signals)

    def dumps(self, path: str | Path) -> None:
        """Save data and signals in a folder, with checksums, or raise ``OSError`` if it is full."""
        path = Path(path)
        path.mkdir(exist_ok=True)
        if is_tensor_collection(data := self._storage):  # type: ignore[attr-defined]
            with NamedTemporaryFile(dir=path) as room:  # TorchRL asks for none.
                allocate(room.name, data.bytes())
        super().dumps(path)  # type: ignore[misc]
        state = {"_signals": self.signal_table.state_dict(), "_signals_format": _FORMAT}
        save_atomically(state, path / _FILE)
        seal_dump(path, path)

    def loads(self, path: str | Path) -> None:
        """Restore data and signals from a folder.

        Raises:
            KeyError: As :meth:`load_state_dict`.
            ValueError: As :meth:`load_state_dict`; or if a file is damaged, missing, or could
                execute something.
        """
        path = open_dump(path)
        if not (path / _FILE).exists():
            raise KeyError(f"'_signals' is missing in the saved storage: no {path / _FILE}")
        state = load_safely(path / _FILE)
        check_saved("storage", state, ("_signals",), _signals_format=_FORMAT)
        notes = json.loads((path / "storage_metadata.json").read_text(encoding="utf-8"))
        data = None if notes["is_pytree"] else TensorDict.load_memmap(path, allow_pickle=False)
        signals = self._checked(data, notes["len"], state["_signals"])
        self.signal_table.stop_clock()
        super().loads(path)  # type: ignore[misc]
        self._settle_loaded(signals)

    def _checked(self, data: Any, length: Any, signals: Any) -> dict[str, Any]:
        """Check saved transitions as new ones, and return their signals, saved or read again."""
        rows = None
        if type(length) is not int or not 0 <= length <= self.max_size:
            raise ValueError(
                f"'_len' of the saved storage must be in [0, {self.max_size}], got {length!r}"
            )
        if length and isinstance(data, TensorDictBase):
            slots = data.shape[: self.ndim]
            if slots.numel() != self.max_size:
                raise ValueError(
                    f"the saved storage must have {self.max_size} slots, got {[*slots]}"
                )
            rows, _ = self.check(data[: length // slots[1:].numel()])
        table = self.signal_table
        if signals is None:
            signals = table.state_of_new(table.blank(length) if rows is None else rows)
        table.check_state(signals)
        if signals["size"] != length:
            raise ValueError(f"the saved storage has {length} rows, its signals {signals['size']}")
        return signals

    def _settle_loaded(self, signals: dict[str, Any]) -> None:
        self._schema = None
        self.signal_table.load_state_dict(signals)

    def __getstate__(self) -> Any:
        # The copy describes its own data.
        state: Any = super().__getstate__()
        return {**state, "_schema": None}


def _as_index(cursor: Any, capacity: int) -> Tensor:
    """Return the slots that a writer's cursor names, shape ``[B]``."""
    if isinstance(cursor, slice):
        return torch.arange(*cursor.indices(capacity))
    if isinstance(cursor, Tensor) and cursor.dtype is torch.bool:
        return cursor.nonzero().squeeze(1)
    return torch.as_tensor(cursor, dtype=torch.long).reshape(-1)


def _as_batch(data: Any) -> Any:
    """Stack a list of transitions to one batch; return anything else unchanged."""
    if isinstance(data, list) and data and is_tensor_collection(data[0]):
        return torch.stack(data)
    return data


def _of_any_device(data: Any) -> Any:
    """Return saved data without the name of their device, for which another one rejects them."""
    found = getattr(data, "_metadata", None)
    if found is None:
        return data
    copied = OrderedDict(data)
    copied._metadata = {name: {**each, "device": None} for name, each in found.items()}  # type: ignore[attr-defined]
    return copied
