"""Rows in files: all entries of one type lie side by side, so that a page has whole rows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from tensordict import MemoryMappedTensor, TensorDict
from torch import Tensor


class PackedTensor(MemoryMappedTensor):
    """Some numbers of a mapped file, which another process finds by their places in it.

    TensorDict's own has an index of the whole file, for which it takes that of a part of a part.
    """

    @classmethod
    def at(cls, file: str, place: Sequence[Any], *whole: Any) -> PackedTensor:
        """Map a file of a type and shape, and return the numbers of a size, stride and offset."""
        return _named(MemoryMappedTensor.from_filename(file, *whole).as_strided(*place), file)

    def _index_wrap(self, tensor: Tensor, item: object, check: bool = False) -> PackedTensor:
        return _named(tensor, self.filename)

    def __reduce__(self) -> tuple[Any, ...]:
        place = self.shape, self.stride(), self.storage_offset()
        count = self.untyped_storage().nbytes() // self.itemsize
        return PackedTensor.at, (self.filename, place, self.dtype, (count,))


def _named(part: Tensor, file: str) -> PackedTensor:
    entry = PackedTensor(part)
    entry.filename = file
    return entry


def pack(data: TensorDict, ndim: int, folder: str, existsok: bool) -> TensorDict:
    """Map entries to a file for each of their types, in place of a file for each of them.

    Args:
        data: Entries that are mapped to files, with nothing in them.
        ndim: Dimensions of slots.
        folder: Folder of the new files.
        existsok: True to overwrite files.

    Raises:
        FileExistsError: If a file is there and ``existsok`` is false.
    """
    # One without numbers has no file, nor have texts.
    leaves = data.values(True, True)
    found = [entry for entry in leaves if isinstance(entry, MemoryMappedTensor) and entry.numel()]
    packed: dict[int, Tensor] = {}
    for dtype in {entry.dtype for entry in found}:
        entries = [entry for entry in found if entry.dtype is dtype]
        widths = [entry.shape[ndim:].numel() for entry in entries]
        file = Path(folder).absolute() / f"{dtype}.rows".removeprefix("torch.")
        file.touch(exist_ok=existsok)
        shape = (*data.batch_size[:ndim], sum(widths))
        rows = MemoryMappedTensor.from_filename(file, dtype, shape)
        for entry, part in zip(entries, rows.split(widths, -1), strict=True):
            packed[id(entry)] = _named(part.view(entry.shape), str(file))
            Path(entry.filename).unlink()
            # By it TensorDict would load what has no files.
            Path(entry.filename).with_name("meta.json").unlink(missing_ok=True)
    joined = data.apply(lambda entry: packed.get(id(entry), entry), propagate_lock=True)
    form = {"batch_size": data.batch_size, "device": data.device}
    return TensorDict._new_unsafe(dict(joined.items()), **form, lock=True, is_memmap=True)


def map_anew(data: TensorDict) -> TensorDict:
    """Map packed entries once more, to be read from begin to end: the system then reads ahead."""
    whole = cache(MemoryMappedTensor.from_filename)

    def again(entry: Tensor) -> Tensor:
        # PyTorch would make a file that was removed anew.
        if not isinstance(entry, PackedTensor) or not Path(entry.filename).exists():
            return entry
        file, place, *form = entry.__reduce__()[1]
        return whole(file, *form).as_strided(*place)

    return data.apply(again)
