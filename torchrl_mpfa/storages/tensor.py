"""The storage whose data and signals lie in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyTensorStorage

from torchrl_mpfa.checks import bounds, check_counts
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.storages.base import SignalStorageMixin
from torchrl_mpfa.storages.table import SignalTable


class SignalTensorStorage(SignalStorageMixin, LazyTensorStorage):
    """:class:`~torchrl.data.LazyTensorStorage` with the signals of every slot beside the data.

    Args:
        max_size: Capacity ``N``.
        signals: The signals to keep, as objects or names; those of the paper by default.
        reward_key: Where the signed reward of a transition is read.
        allow_nonfinite: Entries that may hold NaN and infinities; none by default.
        **kwargs: Passed to :class:`~torchrl.data.LazyTensorStorage`. With ``ndim=2`` a slot is a
            step of one of several environments, as in TorchRL, and ``max_size`` must be a multiple
            of their number.

    Raises:
        ValueError: If ``max_size`` is not positive, or the signals are none or twice the same.

    Examples:
        >>> storage = SignalTensorStorage(1000)
        >>> storage.signal_table.names
        ['td_error', 'action_gradient', 'reward']
    """

    _storage: Any

    def __init__(
        self,
        max_size: int,
        *,
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        reward_key: NestedKey = ("next", "reward"),
        allow_nonfinite: Sequence[NestedKey] = (),
        **kwargs: Any,
    ) -> None:
        check_counts(max_size=max_size)
        self._allow_nonfinite = tuple(allow_nonfinite)
        self.signal_table = SignalTable(max_size, signals, reward_key=reward_key)
        self._looked_at: Any = None
        self._where: torch.device | None = None
        super().__init__(max_size, **kwargs)

    def get(self, index: Any) -> Any:
        """Read transitions; the usual case, a batch of slots, twice as fast as by indexing."""
        if (
            self.initialized
            and self.ndim == 1
            and isinstance(index, Tensor)
            and index.is_cpu
            and index.ndim == 1
            and len(index) > 0
            and index.dtype is torch.long
            and isinstance(self._storage, TensorDict)
            and index.device == self._device_of_tensors()
            and _within(index, len(self))
        ):
            return _rows_of(self._storage, index)
        return super().get(index)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore data and signals, or raise as :meth:`check_state` does."""
        super().load_state_dict(state_dict)
        self._settle_loaded()

    def loads(self, path: str | Path) -> None:
        """Restore data and signals from a folder, or raise as :meth:`check_state` does."""
        super().loads(path)
        self._settle_loaded()

    def _settle_loaded(self) -> None:
        found = self._device_of_tensors() if self.initialized else None
        if getattr(self, "device", None) == "auto":
            # TorchRL finds it out at the first write, which a restored storage has had.
            self.device = (found or torch.device("cpu")) if self.initialized else "auto"
        elif found not in (None, self.device):
            # What was saved beside another device.
            self._storage = self._storage.to(self.device)
        self._settle_device()

    def _device_of_tensors(self) -> torch.device | None:
        """Device of all entries; None if one is no tensor, such as a text: TorchRL reads those."""
        if self._looked_at is not self._storage:
            self._looked_at, self._where = self._storage, _common_device(self._storage)
        return self._where


def _common_device(data: Any) -> torch.device | None:
    """Device of all tensors in a tensordict; None if there are several, or other entries."""
    if isinstance(data, Tensor):
        return data.device
    if type(data) is not TensorDict:
        return None
    devices = {_common_device(entry) for entry in data.values()}
    return devices.pop() if len(devices) == 1 else None


def _rows_of(data: TensorDict, index: Tensor) -> TensorDict:
    """Rows of a tensordict that holds tensors only."""
    rows = {
        key: _rows_of(entry, index) if type(entry) is TensorDict else entry.index_select(0, index)
        for key, entry in data.items()
    }
    # As TorchRL does inside: the constructor would check what fits, for two thirds of the time.
    size = index.shape + data.batch_size[1:]
    return TensorDict._new_unsafe(rows, batch_size=size, device=data.device)


def _within(index: Tensor, size: int) -> bool:
    """Whether all slots are filled ones, counted from the front."""
    low, high = bounds(index)
    return low >= 0 and high < size
