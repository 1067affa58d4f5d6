"""Storages that keep the signals of every slot beside the data, in memory or memory-mapped."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage

from torchrl_mpfa.checks import bounds
from torchrl_mpfa.saving import load_safely, save_atomically
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal, SignalTable

_FORMAT = 1
_FILE = "signals.pt"


class SignalStorageMixin:
    """Adds a :class:`~torchrl_mpfa.SignalTable` to a TorchRL storage.

    Every write of a slot resets its signals, whichever writer makes it, so that a transition
    never has those of the one that was there before; nothing of them shows in sampled batches.
    """

    signal_table: SignalTable
    #: Set by a buffer whose sampler needs them: a write without reward or signal is refused.
    strict = False

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Write transitions and reset the signals of their slots.

        Raises:
            KeyError: If the sampler needs a reward or signal that ``data`` lacks.
            ValueError: If a reward or signal in ``data`` is not finite or out of shape.
        """
        index = _as_index(cursor, self.max_size)  # type: ignore[attr-defined]
        rows = self.signal_table.read(_as_batch(data), len(index))
        if self.strict and (name := self.signal_table.missing(rows)) is not None:
            keys = {s.name: s.key for s in self.signal_table.written}
            key = keys.get(name, self.signal_table.reward_key)
            raise KeyError(f"the transitions lack {name!r}: no finite entry at {key!r}")
        size = len(self)  # type: ignore[arg-type]
        try:
            super().set(cursor, data, set_cursor=set_cursor)  # type: ignore[misc]
        except BaseException:
            # TorchRL counts the rows before it writes them.
            self._len = size
            raise
        self.signal_table.write(index, rows)
        self.signal_table.size = len(self)  # type: ignore[arg-type]

    def _empty(self) -> None:
        super()._empty()  # type: ignore[misc]
        self.signal_table.clear()

    def state_dict(self) -> dict[str, Any]:
        """The data, and the signals under ``"_signals"``."""
        state: dict[str, Any] = super().state_dict()  # type: ignore[misc]
        return {**state, "_signals": self.signal_table.state_dict(), "_signals_format": _FORMAT}

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Refuse a state that does not fit, before anything changes.

        Raises:
            KeyError: If the state has no signals.
            ValueError: If format, capacity or signals differ.
        """
        if "_signals" not in state_dict:
            raise KeyError("the saved storage has no signals: '_signals' is missing")
        _check_format(state_dict.get("_signals_format"))
        self.signal_table.check_state(state_dict["_signals"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore data and signals.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`.
        """
        self.check_state(state_dict)
        super().load_state_dict(state_dict)  # type: ignore[misc]
        self.signal_table.load_state_dict(state_dict["_signals"])

    def dumps(self, path: str | Path) -> None:
        """Save data and signals in a folder."""
        super().dumps(path)  # type: ignore[misc]
        state = {"_signals": self.signal_table.state_dict(), "_signals_format": _FORMAT}
        save_atomically(state, Path(path) / _FILE)

    def check_dump(self, path: str | Path) -> dict[str, Any]:
        """Read the saved signals and refuse them as :meth:`check_state` does."""
        file = Path(path) / _FILE
        if not file.exists():
            raise KeyError(f"the saved storage has no signals: {file} is missing")
        state: dict[str, Any] = load_safely(file)
        self.check_state(state)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore data and signals from a folder.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`.
        """
        state = self.check_dump(path)
        super().loads(path)  # type: ignore[misc]
        self.signal_table.load_state_dict(state["_signals"])


class SignalTensorStorage(SignalStorageMixin, LazyTensorStorage):
    """:class:`~torchrl.data.LazyTensorStorage` with the signals of every slot beside the data.

    Args:
        max_size: Capacity ``N``.
        signals: The signals to keep, as objects or names; those of the paper by default.
        reward_key: Where the signed reward of a transition is read.
        **kwargs: Passed to :class:`~torchrl.data.LazyTensorStorage`.

    Raises:
        ValueError: If ``ndim`` is not 1 (multi-dimensional storages are not supported), or the
            signals are none or twice the same.

    Examples:
        >>> storage = SignalTensorStorage(1000)
        >>> storage.signal_table.names
        ['td_error', 'action_gradient', 'reward']
    """

    def __init__(
        self,
        max_size: int,
        *,
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        reward_key: NestedKey = ("next", "reward"),
        **kwargs: Any,
    ) -> None:
        _check_arguments(max_size, kwargs)
        self.signal_table = SignalTable(max_size, signals, reward_key=reward_key)
        self._looked_at: Any = None
        self._where: torch.device | None = None
        super().__init__(max_size, **kwargs)

    def get(self, index: Any) -> Any:
        """Read transitions; the usual case, a batch of slots, twice as fast as by indexing."""
        if (
            self.initialized
            and isinstance(index, Tensor)
            and index.ndim == 1
            and len(index) > 0
            and index.dtype is torch.long
            and isinstance(self._storage, TensorDict)
            and index.device == self._device_of_tensors()
            and _within(index, len(self))
        ):
            return self._storage.apply(
                lambda leaf: leaf.index_select(0, index), batch_size=index.shape
            )
        return super().get(index)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore data and signals.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`.
        """
        super().load_state_dict(state_dict)
        self._settle_device()

    def loads(self, path: str | Path) -> None:
        """Restore data and signals from a folder.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`.
        """
        super().loads(path)
        self._settle_device()

    def _settle_device(self) -> None:
        # TorchRL finds the device "auto" out at the first write, which a restored storage has had.
        if self.initialized and getattr(self, "device", None) == "auto":
            self.device = self._device_of_tensors() or torch.device("cpu")

    def _device_of_tensors(self) -> torch.device | None:
        """Device of all entries; None if one is no tensor: texts need TorchRL's way."""
        if self._looked_at is not self._storage:
            self._looked_at, self._where = self._storage, _common_device(self._storage)
        return self._where


class SignalMemmapStorage(SignalStorageMixin, LazyMemmapStorage):
    """:class:`~torchrl.data.LazyMemmapStorage` with the signals of every slot beside the data.

    With ``scratch_dir`` the signals are memory-mapped too, to ``scratch_dir/signals.memmap``;
    without it they stay in memory, 8 bytes a column and slot.

    Args:
        max_size: Capacity ``N``.
        signals: The signals to keep, as objects or names; those of the paper by default.
        reward_key: Where the signed reward of a transition is read.
        scratch_dir: Folder of the memory-mapped files; a temporary one by default.
        **kwargs: Passed to :class:`~torchrl.data.LazyMemmapStorage`.

    Raises:
        ValueError: As :class:`SignalTensorStorage`.

    Examples:
        >>> import tempfile
        >>> storage = SignalMemmapStorage(1000, scratch_dir=tempfile.mkdtemp())
        >>> storage.signal_table.rows.shape
        torch.Size([1000, 6])
    """

    def __init__(
        self,
        max_size: int,
        *,
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        reward_key: NestedKey = ("next", "reward"),
        scratch_dir: str | Path | None = None,
        **kwargs: Any,
    ) -> None:
        _check_arguments(max_size, kwargs)
        file = None if scratch_dir is None else Path(scratch_dir) / "signals.memmap"
        self.signal_table = SignalTable(max_size, signals, reward_key=reward_key, file=file)
        super().__init__(max_size, scratch_dir=scratch_dir, **kwargs)


def _check_arguments(max_size: int, kwargs: dict[str, Any]) -> None:
    if isinstance(max_size, bool) or not isinstance(max_size, int) or max_size < 1:
        raise ValueError(f"max_size must be a positive integer, got {max_size}")
    if (ndim := kwargs.get("ndim", 1)) != 1:
        raise ValueError(f"ndim must be 1, got {ndim}: flatten trajectories before extending")


def _check_format(found: Any) -> None:
    if found != _FORMAT:
        raise ValueError(f"format of the saved signals is {found}, this version reads {_FORMAT}")


def _as_index(cursor: Any, capacity: int) -> Tensor:
    """The slots that a writer's cursor names, shape ``[B]``."""
    if isinstance(cursor, slice):
        return torch.arange(*cursor.indices(capacity))
    if isinstance(cursor, Tensor) and cursor.dtype is torch.bool:
        return cursor.nonzero().squeeze(1).cpu()
    return torch.as_tensor(cursor, dtype=torch.long, device="cpu").reshape(-1)


def _common_device(data: Any) -> torch.device | None:
    """Device of all tensors in a tensordict; None if there are several, or other entries."""
    if isinstance(data, Tensor):
        return data.device
    if type(data) is not TensorDict:
        return None
    devices = {_common_device(entry) for entry in data.values()}
    return devices.pop() if len(devices) == 1 else None


def _within(index: Tensor, size: int) -> bool:
    """Whether all slots are filled ones, counted from the front."""
    low, high = bounds(index)
    return low >= 0 and high < size


def _as_batch(data: Any) -> Any:
    """A list of transitions as one batch; anything else as it is."""
    if isinstance(data, list) and data and is_tensor_collection(data[0]):
        return torch.stack(data)
    return data
