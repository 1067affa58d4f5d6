"""States of a buffer's parts: rows of a storage, and files where TorchRL has nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from tempfile import NamedTemporaryFile, TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDict, is_tensor_collection
from torch import Tensor
from torchrl.data import LazyTensorStorage, Storage, TensorDictMaxValueWriter
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.saving import allocate, check_saved
from torchrl_mpfa.storages.plan import RowPlan

_FILES = "_files"
_ENDINGS = {".json", ".memmap"}
"""Of tensors and plain values. TensorDict unpickles what has others, also inside of archives."""
_EVALUATED = "data_indices.json"
"""File by whose presence TorchRL's storage executes text of its ``metadata.json``."""


def state_of(part: Any) -> dict[str, Any]:
    """Return the state of a part of a buffer, or the content of its files.

    Raises:
        OSError: If there is no room for these files.
        ValueError: If an entry of the data is no tensor.
    """
    if not _has_files(part):
        _check_tensors(getattr(part, "_storage", None))
        return part.state_dict()
    with TemporaryDirectory() as name:
        folder = Path(name)
        if isinstance(part, Storage):
            _check_room(part._storage, folder)
            part.checkpointer.dumps(part, folder)
        else:
            part.dumps(folder)
        files = [file for file in folder.rglob("*") if file.is_file()]
        names = [_checked(file.relative_to(folder).as_posix()) for file in files]
        # Mapped: the content is there as long as its tensor, after the folder is gone.
        return {_FILES: dict(zip(names, map(_content, files), strict=True))}


def load_part(part: Any, state: Any) -> None:
    """Restore what :func:`state_of` returned.

    Raises:
        KeyError: As ``load_state_dict`` of the part.
        ValueError: As that; or if a file could execute something; nothing is changed.
    """
    if isinstance(state, Mapping) and _FILES in state:
        with TemporaryDirectory() as name:
            for file, content in state[_FILES].items():
                path = Path(name, _checked(file))
                path.parent.mkdir(parents=True, exist_ok=True)
                content.numpy().tofile(path)
            if not isinstance(part, Storage):
                part.loads(Path(name))
                return
            # Loaded apart, to be checked like any other state.
            twin = LazyTensorStorage(part.max_size, ndim=part.ndim)
            part.checkpointer.loads(twin, Path(name))
            state = twin.state_dict()
    if isinstance(part, LazyTensorStorage):
        # TorchRL's own would check nothing, and map a first state in a folder of its choice.
        restore_rows(part, state)
    else:
        part.load_state_dict(state)


def _has_files(part: Any) -> bool:
    """Return True if files alone hold the state: TorchRL's trees, and what a user has chosen."""
    if isinstance(part, Storage):
        own = part.checkpointer
        is_set = type(own) is not part._default_checkpointer
        return is_set or bool(own._save_hooks or own._load_hooks)
    trees = isinstance(part, PrioritizedSampler) and not hasattr(part, "KIND")
    return trees or isinstance(part, TensorDictMaxValueWriter)


def _check_tensors(data: Any) -> None:
    """Reject texts and the like, which TorchRL leaves out of a state."""
    for key, entry in data.items(True) if isinstance(data, TensorDict) else ():
        if not isinstance(entry, Tensor | TensorDict):
            raise ValueError(
                f"entries must be tensors to be saved, got {type(entry).__name__} at {key!r}: "
                "write the transitions without it"
            )


def _check_room(data: Any, folder: Path) -> None:
    """Reject a disk without room for the files of a checkpointer, which asks for none."""
    if is_tensor_collection(data):
        with NamedTemporaryFile(dir=folder) as room:
            allocate(room.name, data.bytes())


def _content(file: Path) -> Tensor:
    return torch.from_file(str(file), size=file.stat().st_size, dtype=torch.uint8)


def _checked(name: str) -> str:
    """Return the name of a file, which must lie in its folder and execute nothing when read."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"files of a part must lie in its folder, got {name!r}")
    if path.suffix.lower() not in _ENDINGS or path.name.lower() == _EVALUATED:
        raise ValueError(
            f"{name} could execute anything when it is read: dumps hold tensors and plain values "
            "only"
        )
    return name


def restore_rows(storage: LazyTensorStorage, state: Any) -> None:
    """Restore the rows of a storage of tensors, saved on any device, see ``load_state_dict``."""
    check_saved("storage", state, ("_storage", "_len", "initialized"))
    data, length = state["_storage"], state["_len"]
    rows = data if isinstance(data, Tensor) else rows_of(data).auto_device_()
    _check_rows(storage, rows, length)
    if state["initialized"]:
        # As at a first write: on the device, and in the folder, of the storage.
        storage.set(slice(None), rows, set_cursor=False)
    storage.initialized, storage._len = state["initialized"], length
    storage._bump_mutation_revision()


def rows_of(state: Any) -> TensorDict:
    """Return the tensordict whose flat ``state_dict`` this is, without the name of its device.

    TensorDict's own takes each dot in a name for an entry of an entry.
    """
    check_saved("rows", state)
    notes = getattr(state, "_metadata", {"": {"batch_size": ()}})
    rows = TensorDict({}, notes[""]["batch_size"])
    paths: dict[str, tuple[str, ...]] = {"": ()}

    def path_of(name: str) -> tuple[str, ...]:
        above = max((p for p in paths if name.startswith(p + ".")), key=len, default="")
        return (*paths[above], name[len(above) + 1 :] if above else name)

    for name in sorted(filter(None, notes), key=len):
        paths[name] = path_of(name)
        rows[paths[name]] = TensorDict({}, notes[name]["batch_size"])
    for name, value in state.items():
        rows[path_of(name)] = value
    return rows


def _check_rows(storage: LazyTensorStorage, rows: Any, length: Any) -> None:
    if type(length) is not int or not 0 <= length <= storage.max_size:
        raise ValueError(
            f"'_len' of the saved storage must be in [0, {storage.max_size}], got {length!r}"
        )
    if length and isinstance(rows, TensorDict):
        slots = rows.shape[: storage.ndim]
        if slots.numel() != storage.max_size:
            raise ValueError(
                f"the saved storage must have {storage.max_size} slots, got {[*slots]}"
            )
        stored: Any = storage._storage if storage.initialized else None
        if type(stored) is TensorDict and len(stored.keys()):
            # TorchRL would leave the old values of an entry that is missing.
            keys = list(stored.keys(True, True))
            RowPlan(stored, storage.ndim, keys).check(rows, storage.ndim)
