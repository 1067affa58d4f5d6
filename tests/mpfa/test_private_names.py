"""Private names of TorchRL and TensorDict that the package depends on: all of them, each tried.

What breaks here with another version of TorchRL is what the package has to follow.
"""

from __future__ import annotations

import ast
import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import MemoryMappedTensor, TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    PrioritizedSampler,
    TensorDictReplayBuffer,
    TensorStorageCheckpointer,
)

import torchrl_mpfa


def rows(count: int) -> TensorDict:
    return TensorDict({"a": torch.arange(float(count)).unsqueeze(1)}, [count])


def made() -> TensorDictReplayBuffer:
    """A buffer of TorchRL's of eight slots, with five rows."""
    sampler = PrioritizedSampler(8, 0.6, 0.4)
    storage = LazyTensorStorage(8)
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=2)
    buffer.extend(rows(5))
    return buffer


def mapped() -> Any:
    """An entry of a memory-mapped storage."""
    storage = LazyMemmapStorage(8)
    storage.set(torch.arange(2), rows(2))
    return storage._storage["a"]


def takes(function: Any, *names: str) -> bool:
    """Return True if a function has these arguments."""
    return set(names) <= set(inspect.signature(function).parameters)


def locks(lock: Any) -> bool:
    with lock:
        return True


def rewound(buffer: Any) -> bool:
    buffer._storage._set_last_cursor(3)
    return buffer._storage._last_cursor == 3


def set_by_path() -> bool:
    data = TensorDict({"n": TensorDict({}, [2])}, [2])
    data._set_tuple(("n", "x"), torch.ones(2), inplace=False, validated=True, non_blocking=False)
    return bool(data["n", "x"].all())


BUFFER = {
    "_batch_size": lambda b: b._batch_size == 2,
    "_clear_prefetch_queue_locked": lambda b: takes(b._clear_prefetch_queue_locked),
    "_collate_fn": lambda b: b._collate_fn(b._storage.get(torch.arange(2))).shape == (2,),
    "_consume_after_n_samples": lambda b: b._consume_after_n_samples is None,
    "_futures_lock": lambda b: locks(b._futures_lock),
    "_initialize_prioritized_sampler": lambda b: takes(b._initialize_prioritized_sampler),
    "_is_consuming": lambda b: b._is_consuming() is False,
    "_pin_memory": lambda b: not b._pin_memory,
    "_prefetch": lambda b: not b._prefetch,
    "_prefetch_cap": lambda b: not b._prefetch_cap,
    "_replay_lock": lambda b: locks(b._replay_lock),
    "_sample": lambda b: b._sample(3)[0].shape == (3,),
    "_sample_unit": lambda b: b._sample_unit is None,
    "_sampler": lambda b: isinstance(b._sampler, PrioritizedSampler),
    "_transform": lambda b: len(b._transform) == 0,
    "_transpose": lambda b: takes(b._transpose, "data"),
    "_warned_batch_size_conflict": lambda b: b._warned_batch_size_conflict is False,
    "_write_lock": lambda b: locks(b._write_lock),
    "_writer": lambda b: b._writer is b.writer,
}
STORAGE = {
    "_attached_entities_iter": lambda b: [*b._storage._attached_entities_iter()] == [b],
    "_default_checkpointer": lambda b: (
        type(b._storage.checkpointer) is b._storage._default_checkpointer
    ),
    "_bump_mutation_revision": lambda b: takes(b._storage._bump_mutation_revision),
    "_len": lambda b: b._storage._len == 5,
    "_len_along_dim0": lambda b: b._storage._len_along_dim0 == 5,
    "_rand_given_ndim": lambda b: b._storage._rand_given_ndim(3).shape == (3,),
    "_set_last_cursor": rewound,
    "_storage": lambda b: b._storage._storage["a"].shape == (8, 1),
    "_total_shape": lambda b: b._storage._total_shape == (8,),
}
SAMPLER = {
    "_STATE_SCHEMA_VERSION": lambda b: isinstance(b._sampler._STATE_SCHEMA_VERSION, int),
    "_alpha": lambda b: b._sampler._alpha == 0.6,
    "_beta": lambda b: b._sampler._beta == 0.4,
    "_device": lambda b: hasattr(b._sampler, "_device"),
    "_empty": lambda b: b._sampler._empty() is None,
    "_eps": lambda b: b._sampler._eps == 1e-8,
    "_init": lambda b: b._sampler._init() is None,
    "_max_capacity": lambda b: b._sampler._max_capacity == 8,
    "_max_priority_within_buffer": lambda b: b._sampler._max_priority_within_buffer is False,
    "_maybe_init_from_storage": lambda b: takes(b._sampler._maybe_init_from_storage, "storage"),
    "_retransform_priority_trees": lambda b: takes(
        b._sampler._retransform_priority_trees, "old_alpha", "new_alpha"
    ),
    "_rng": lambda b: b._sampler._rng is b._rng,
}
WRITER = {
    "_cursor": lambda b: b._writer._cursor == 5,
    "_write_count": lambda b: b._writer._write_count == 5,
}
REST = {
    "_buffers": lambda b: "running_mean" in torch.nn.BatchNorm1d(1)._buffers,
    "_filename": lambda b: mapped()._filename is None or Path(mapped()._filename).exists(),
    "_handler": lambda b: mapped()._handler is None or isinstance(mapped()._handler.fd, int),
    "_load_hooks": lambda b: not TensorStorageCheckpointer()._load_hooks,
    "_save_hooks": lambda b: not TensorStorageCheckpointer()._save_hooks,
    "_new_unsafe": lambda b: (
        TensorDict._new_unsafe({"x": torch.ones(2)}, batch_size=torch.Size([2]), device=None).shape
        == (2,)
    ),
    "_set_tuple": lambda b: set_by_path(),
    "_tensordict": lambda b: rows(2)._tensordict["a"].shape == (2, 1),
}
KNOWN: dict[str, Any] = {**BUFFER, **STORAGE, **SAMPLER, **WRITER, **REST}
OURS = {"_depth", "_step"}
"""Names of the package's own that happen to be TensorDict's or PyTorch's too."""


@pytest.mark.parametrize("name", KNOWN)
def test_a_private_name_means_what_the_package_takes_it_for(name: str) -> None:
    assert KNOWN[name](made())


def test_no_other_private_name_of_torchrl_or_tensordict_is_used() -> None:
    buffer = made()
    theirs = (
        *(buffer, buffer._storage, buffer._sampler, buffer._writer, buffer._transform),
        *(LazyMemmapStorage(8), TensorDict({}, []), mapped(), TensorStorageCheckpointer()),
    )
    [package] = torchrl_mpfa.__path__
    used = {
        node.attr
        for file in Path(package).rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and node.attr.startswith("_")
    }
    private = {name for name in used if not name.startswith("__")} - OURS
    found = {name for name in private if any(hasattr(part, name) for part in theirs)}
    assert found == KNOWN.keys()
    assert isinstance(mapped(), MemoryMappedTensor)
