"""The storages: data and signals in memory, or in memory-mapped files."""

from __future__ import annotations

from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, is_tensor_collection
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map
from torchrl.data import LazyMemmapStorage, LazyTensorStorage

from torchrl_mpfa.checks import bounds
from torchrl_mpfa.storages.storage import SignalStorageMixin
from torchrl_mpfa.storages.table import allocate


class SignalTensorStorage(SignalStorageMixin, LazyTensorStorage):
    """:class:`~torchrl.data.LazyTensorStorage` with the signals of every slot next to the data.

    Further arguments and errors: see :class:`~torchrl_mpfa.storages.SignalStorageMixin`.

    Examples:
        >>> storage = SignalTensorStorage(1000)
        >>> storage.signal_table.names
        ['td_error', 'action_gradient', 'reward']
    """

    _storage: Any
    _looked_at: Any = None
    _where: torch.device | None = None

    def get(self, index: Any) -> Any:
        """Read transitions; a batch of slots takes half of the time of indexing."""
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

    def _settle_loaded(self, signals: dict[str, Any]) -> None:
        found = self._device_of_tensors() if self.initialized else None
        if getattr(self, "device", None) == "auto":
            # TorchRL finds it out at the first write, which a restored storage has had.
            self.device = (found or torch.device("cpu")) if self.initialized else "auto"
        elif found not in (None, self.device):
            # What was saved on another device.
            self._storage = self._storage.to(self.device)
        super()._settle_loaded(signals)
        self._settle_device()

    def _device_of_tensors(self) -> torch.device | None:
        """Return the device of all entries; None if one is no tensor, which TorchRL reads."""
        if self._looked_at is not self._storage:
            self._looked_at, self._where = self._storage, _common_device(self._storage)
        return self._where


class SignalMemmapStorage(SignalStorageMixin, LazyMemmapStorage):
    """:class:`~torchrl.data.LazyMemmapStorage` with the signals of every slot next to the data.

    With ``scratch_dir`` the signals are memory-mapped too, to ``scratch_dir/signals.memmap``;
    without it they stay in memory, 8 bytes a column and slot. A pickled or copied storage has
    temporary files of its own. A load writes into the files once the state was found to fit; if
    the disk then fails, the storage is left half loaded.

    Further arguments and errors: see :class:`~torchrl_mpfa.storages.SignalStorageMixin`.

    Args:
        max_size: Capacity ``N``.
        scratch_dir: Folder of the memory-mapped files; a temporary one by default.
        existsok: True to overwrite files that an earlier storage left in ``scratch_dir``.
        **kwargs: Further arguments.

    Raises:
        FileExistsError: If ``scratch_dir`` holds the files of an earlier storage and ``existsok``
            is false, or a living storage, of this process or another, uses it.
        OSError: If the disk has no room for the files, at the first write too; nothing is stored.

    Examples:
        >>> import tempfile
        >>> storage = SignalMemmapStorage(1000, scratch_dir=tempfile.mkdtemp())
        >>> storage.signal_table.rows.shape
        torch.Size([1000, 6])
    """

    _storage: Any

    def __init__(
        self,
        max_size: int,
        *,
        scratch_dir: str | Path | None = None,
        existsok: bool = False,
        **kwargs: Any,
    ) -> None:
        if scratch_dir is not None:
            self._mapped = {"file": Path(scratch_dir) / "signals.memmap", "existsok": existsok}
        super().__init__(max_size, scratch_dir=scratch_dir, existsok=existsok, **kwargs)

    def _init(self, data: Any) -> None:
        super()._init(data)
        entries = tree_leaves(self._storage)
        files = [e._filename or f"/proc/self/fd/{e._handler.fd}" for e in entries]
        try:
            for file in files:
                allocate(file)
        except OSError:
            self._storage, self.initialized = None, False
            for entry in entries:
                if entry._filename is not None:
                    Path(entry._filename).unlink()
            raise

    def __getstate__(self) -> Any:
        state = super().__getstate__()
        if get_spawning_popen() is None:
            # The copy has files of its own. Processes that TorchRL starts share those of this one.
            state |= {"scratch_dir": None, "_scratch_dir_is_temp": True}
            if self.initialized:
                state["_storage"] = tree_map(lambda entry: entry.clone(), self._storage)
        return state

    def __setstate__(self, state: Any) -> None:
        super().__setstate__(state)
        data: Any = self._storage if self.initialized else None
        if is_tensor_collection(data) and not data.is_memmap():
            self._storage = data.memmap()


def _common_device(data: Any) -> torch.device | None:
    """Return the device of all tensors in a tensordict; None for several, or other entries."""
    if isinstance(data, Tensor):
        return data.device
    if type(data) is not TensorDict:
        return None
    devices = {_common_device(entry) for entry in data.values()}
    return devices.pop() if len(devices) == 1 else None


def _rows_of(data: TensorDict, index: Tensor) -> TensorDict:
    """Return rows of a tensordict that holds tensors only."""
    rows = {
        key: _rows_of(entry, index) if type(entry) is TensorDict else entry.index_select(0, index)
        for key, entry in data.items()
    }
    # As TorchRL does inside: the constructor would check what fits, for two thirds of the time.
    size = index.shape + data.batch_size[1:]
    return TensorDict._new_unsafe(rows, batch_size=size, device=data.device)


def _within(index: Tensor, size: int) -> bool:
    """Return True if all slots are filled ones, counted from the front."""
    low, high = bounds(index)
    return low >= 0 and high < size
