"""The storage whose data and signals lie in memory-mapped files."""

from __future__ import annotations

from collections.abc import Sequence
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any

from tensordict import is_tensor_collection
from tensordict.utils import NestedKey
from torch.utils._pytree import tree_map
from torchrl.data import LazyMemmapStorage

from torchrl_mpfa.checks import check_counts
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.storages.base import SignalStorageMixin
from torchrl_mpfa.storages.table import SignalTable


class SignalMemmapStorage(SignalStorageMixin, LazyMemmapStorage):
    """:class:`~torchrl.data.LazyMemmapStorage` with the signals of every slot beside the data.

    With ``scratch_dir`` the signals are memory-mapped too, to ``scratch_dir/signals.memmap``;
    without it they stay in memory, 8 bytes a column and slot. What is pickled or copied has
    temporary files of its own.

    Args:
        max_size: Capacity ``N``.
        signals: The signals to keep, as objects or names; those of the paper by default.
        reward_key: Where the signed reward of a transition is read.
        allow_nonfinite: As in :class:`SignalTensorStorage`.
        scratch_dir: Folder of the memory-mapped files; a temporary one by default.
        existsok: Whether files that an earlier storage left in ``scratch_dir`` are overwritten.
        **kwargs: As in :class:`SignalTensorStorage`, for :class:`~torchrl.data.LazyMemmapStorage`.

    Raises:
        ValueError: As :class:`SignalTensorStorage`.
        FileExistsError: If ``scratch_dir`` holds the files of an earlier storage and ``existsok``
            is false, or a living storage, of this process or another, uses it.

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
        signals: Sequence[Signal | str] = MPFA_SIGNALS,
        reward_key: NestedKey = ("next", "reward"),
        allow_nonfinite: Sequence[NestedKey] = (),
        scratch_dir: str | Path | None = None,
        existsok: bool = False,
        **kwargs: Any,
    ) -> None:
        check_counts(max_size=max_size)
        self._allow_nonfinite = tuple(allow_nonfinite)
        file = None if scratch_dir is None else Path(scratch_dir) / "signals.memmap"
        self.signal_table = SignalTable(
            max_size, signals, reward_key=reward_key, file=file, existsok=existsok
        )
        super().__init__(max_size, scratch_dir=scratch_dir, existsok=existsok, **kwargs)

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
