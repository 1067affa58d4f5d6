"""The storages: data and the signals of their sampler in memory, or in memory-mapped files."""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
from collections.abc import Mapping, Set
from ctypes import c_size_t, c_void_p
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import MemoryMappedTensor, TensorDict, is_tensor_collection
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map
from torchrl.data import LazyMemmapStorage, LazyTensorStorage

from torchrl_mpfa.checks import check_counts, generator_on
from torchrl_mpfa.saving import allocate, dump, open_dump
from torchrl_mpfa.storages.entries import as_index
from torchrl_mpfa.storages.packed import map_anew, pack
from torchrl_mpfa.storages.plan import RowPlan
from torchrl_mpfa.storages.states import load_part, restore_rows, state_of

if TYPE_CHECKING:
    from torchrl_mpfa.samplers.table import SignalTable


class SignalTensorStorage(LazyTensorStorage):
    """:class:`~torchrl.data.LazyTensorStorage` that is faster, and holds the signals of a sampler.

    Reading and writing a batch of slots takes half of TorchRL's time where all entries are tensors
    on the CPU. The table of the first sampler that uses the storage lies beside its data, as
    ``signal_table``. Any storage of TorchRL's works too: the sampler then keeps the table itself.

    Args:
        max_size: Capacity ``N``.
        **kwargs: Arguments of TorchRL's storage. With ``ndim=2`` a slot is a step of one of several
            environments, as in TorchRL, and ``max_size`` must be a multiple of their number.

    Raises:
        ValueError: If ``max_size`` is not positive.

    Examples:
        >>> storage = SignalTensorStorage(4)
        >>> storage.set(torch.arange(2), TensorDict({"reward": torch.ones(2)}, [2]))
        >>> storage.get(torch.tensor([1, 1]))["reward"]
        tensor([1., 1.])
    """

    _storage: Any
    _rng: torch.Generator | None
    signal_table: SignalTable | None = None
    """Table of the sampler that uses the storage; None before the first use."""
    _plan: RowPlan | None = None

    def __init__(self, max_size: int, **kwargs: Any) -> None:
        max_size = check_counts(max_size=max_size)
        super().__init__(max_size, **kwargs)

    def hold(self, table: SignalTable) -> None:
        """Hold a table of signals beside the data."""
        self.signal_table = table

    def __getstate__(self) -> Any:
        # Another process writes transitions alone.
        mine = get_spawning_popen() is None
        state = {**super().__getstate__(), "_plan": None}
        return state if mine else {**state, "signal_table": None}

    def plan(self, slots: Any) -> RowPlan | None:
        """Return the plan by which rows of slots are read and written; None for what has none."""
        stored: Any = self._storage if self.initialized else None
        if type(stored) is not TensorDict or not _is_batch(slots) or len(slots) > self.max_size:
            return None
        if self._plan is None or not self._plan.describes(stored):
            self._plan = RowPlan(stored, self.ndim)
        return self._plan

    def batch(self, slots: Any, beside: Mapping[str, Tensor] | None = None) -> TensorDict | None:
        """Read transitions, with entries beside them, by the plan; None where PyTorch has to."""
        plan = self.plan(slots)
        return None if plan is None else plan.read(slots, len(self), beside)

    def get(self, index: Any) -> Any:
        """Read transitions; all slots come as a tensordict that shares their tensors."""
        if (batch := self.batch(index)) is not None:
            return batch
        rows = super().get(as_index(index))
        # A full storage gives itself in TorchRL, where a buffer's transform then writes in it.
        return rows.copy() if rows is self._storage and is_tensor_collection(rows) else rows

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Write transitions."""
        cursor = as_index(cursor)
        size, before = len(self), None if self.initialized else vars(self).copy()
        try:
            if set_cursor and type(data) is TensorDict and _is_batch(cursor):
                if before is not None and self.ndim == data.ndim == 1:
                    self._init(data[0])
                rows = plan.match(data) if (plan := self.plan(cursor)) else None
                if rows is not None and rows.write(cursor, self.max_size):
                    self.note_written(cursor)
                    return
            super().set(cursor, data, set_cursor=set_cursor)
        except BaseException:
            # TorchRL has counted the rows already, and taken the form of the first ones.
            if before is not None:
                self._forget_form()
                self.__dict__.clear()
                self.__dict__.update(before)
            self._len = size
            raise

    def _forget_form(self) -> None:
        """Remove what was made for the form of the first transitions."""

    def note_written(self, slots: Tensor) -> None:
        """Count transitions that were written in slots, the next ones, shape ``[B]``."""
        self._set_last_cursor(slots)
        self._len = min(len(self) + len(slots), self.max_size)
        self._bump_mutation_revision()

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write transitions in slots, and have the buffers that use the storage read them."""
        super().__setitem__(index, value)
        slots = slots_of(self, index)
        for buffer in self._attached_entities_iter():
            buffer.mark_update(slots)

    def _rand_given_ndim(self, batch_size: int) -> Any:
        """Sample slots uniformly, as TorchRL, which asks for a generator on the device."""
        source, device = self._rng, getattr(self, "device", None)
        if not isinstance(device, torch.device):
            return super()._rand_given_ndim(batch_size)
        self._rng = generator_on(device, source)
        try:
            return super()._rand_given_ndim(batch_size)
        finally:
            self._rng = source

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the data, saved on any device.

        Raises:
            KeyError: If an entry is missing; nothing is changed.
            ValueError: If the data are of another capacity or form; nothing is changed.
        """
        restore_rows(self, state_dict)

    def dumps(self, path: str | Path) -> None:
        """Save the data in a folder, with a checksum, or raise ``OSError`` if it is full."""
        dump(state_of(self), path)

    def loads(self, path: str | Path) -> None:
        """Restore the data from a folder.

        Raises:
            ValueError: If the file is damaged or could execute something, or the data are of
                another capacity or form; nothing is changed.
        """
        load_part(self, open_dump(path))


class SignalMemmapStorage(SignalTensorStorage, LazyMemmapStorage):
    """:class:`~torchrl.data.LazyMemmapStorage` that is faster, and holds the signals of a sampler.

    With ``scratch_dir`` the signals are memory-mapped too, to ``scratch_dir/signals.memmap``;
    without it they stay in memory, 8 bytes a column and slot. A pickled or copied storage has
    temporary files of its own. A load writes into the files once the state was found to fit; if
    the disk then fails, the storage is left half loaded.

    With ``scratch_dir`` the entries of one type also lie side by side in one file, as in
    ``scratch_dir/float32.rows``, so that a row from the disk is one page. What ``storage[:]``
    returns then has the strides of such rows, and TensorDict cannot load the folder. With
    ``shared_init`` each entry has a file, as in TorchRL.

    Further arguments: see :class:`SignalTensorStorage`.

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
        >>> storage.signal_table is None
        True
    """

    _claim: NDArray[np.float64] | None = None
    """The begin of the file of the signals."""
    _file: Path
    _files_before: Set[Path] = frozenset()
    """Files in the folder that are not of these data."""

    def __init__(
        self,
        max_size: int,
        *,
        scratch_dir: str | Path | None = None,
        existsok: bool = False,
        **kwargs: Any,
    ) -> None:
        if scratch_dir is not None:
            self._file = Path(scratch_dir) / "signals.memmap"
            self._claim = _claimed(self._file, existsok=existsok)
        super().__init__(max_size, scratch_dir=scratch_dir, existsok=existsok, **kwargs)

    def hold(self, table: SignalTable) -> None:
        """Hold a table of signals beside the data, in a file if they are in a folder."""
        if self._claim is not None:
            allocate(self._file, 8 * table.rows.numel())
            mapped = np.memmap(self._file, np.float64, "r+", shape=tuple(table.rows.shape))
            table.move_to(torch.from_numpy(mapped))
        super().hold(table)

    def _files(self) -> set[Path]:
        """Return all files in the folder of the data."""
        folder = getattr(self, "scratch_dir", None)
        paths = [] if folder is None else Path(folder).rglob("*")
        return {path for path in paths if path.is_file()}

    def _init(self, data: Any) -> None:
        self._files_before = self._files()
        super()._init(data)
        # With shared_init other processes look for TorchRL's files.
        if self.scratch_dir and type(self._storage) is TensorDict and not self.shared_init:
            self._storage = pack(self._storage, self.ndim, self.scratch_dir, self.existsok)
        # Texts and the like are kept in memory.
        leaves = tree_leaves(self._storage)
        entries = [entry for entry in leaves if isinstance(entry, MemoryMappedTensor)]
        # One without numbers has no file.
        for file in {_file_of(entry) for entry in entries if entry.numel()}:
            allocate(file)
        for entry in entries:
            _expect_random(entry)

    def state_dict(self) -> dict[str, Any]:
        """Return the state, whose tensors share the files."""
        state: dict[str, Any] = super().state_dict()
        if type(self._storage) is TensorDict:
            state["_storage"] = map_anew(self._storage).state_dict()
        return state

    def _check_mapped(self) -> None:
        """Reject entries without numbers, which TensorDict maps at the first write alone."""
        for entry in tree_leaves(self._storage):
            if isinstance(entry, MemoryMappedTensor) and not entry.numel():
                raise ValueError(
                    f"entries must have numbers to be copied, got shape {[*entry.shape]}: write "
                    "the transitions without it, or save by dumps(...)"
                )

    def _forget_form(self) -> None:
        """Remove the files that were made for the form of the first transitions."""
        for file in self._files() - self._files_before:
            file.unlink()

    def __getstate__(self) -> Any:
        state = {**super().__getstate__(), "_claim": None}
        if get_spawning_popen() is None:
            self._check_mapped()
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


def rows_with(storage: Any, index: Any, info: dict[Any, Any]) -> tuple[Any, dict[Any, Any]]:
    """Return stored rows, with what a sampler says of them, and what of that is still to be set."""
    if isinstance(storage, SignalTensorStorage) and isinstance(index, Tensor):
        # Entries of the top that have a number for each row.
        beside = {
            key: value
            for key, value in info.items()
            if isinstance(key, str) and isinstance(value, Tensor) and value.shape[:1] == index.shape
        }
        if (data := storage.batch(index, beside)) is not None:
            return data, {key: value for key, value in info.items() if key not in beside}
    return storage.get(index), info


def _file_of(entry: MemoryMappedTensor) -> str:
    return str(entry._filename or f"/proc/self/fd/{entry._handler.fd}")


def _is_batch(slots: Any) -> bool:
    """Return True if an index is one slot or more in a tensor on the CPU, ``[B]``."""
    return (
        isinstance(slots, Tensor)
        and slots.dtype is torch.long
        and slots.ndim == 1
        and slots.is_cpu
        and len(slots) > 0
    )


def slots_of(storage: Any, index: Any) -> Tensor:
    """Return the flat slots that an index of a storage names, shape ``[B]``."""
    slots = torch.arange(storage.max_size, device="cpu")
    if storage.ndim > 1:
        slots = slots.reshape(storage._total_shape)
    return slots[list(index) if isinstance(index, range) else index].reshape(-1)


def _expect_random(entry: Tensor) -> None:
    """Have the system read no more of a mapped file than is asked for.

    Rows of a batch lie far apart: with a file larger than memory, all else that it read ahead would
    take the place of what is needed.
    """
    memory = entry.untyped_storage()
    start = memory.data_ptr() // mmap.PAGESIZE * mmap.PAGESIZE
    size = memory.data_ptr() + memory.nbytes() - start
    ctypes.CDLL(None).madvise(c_void_p(start), c_size_t(size), mmap.MADV_RANDOM)


def _claimed(file: Path, *, existsok: bool) -> NDArray[np.float64]:
    """Map the begin of a file of signals, which is locked as long as the mapping lives."""
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
        allocate(file, 8)
        return np.memmap(opened, dtype=np.float64, mode="w+", shape=(1,))
