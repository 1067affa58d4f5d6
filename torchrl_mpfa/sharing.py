"""A buffer that other processes write to: its own process keeps signals and priorities alone."""

from __future__ import annotations

import multiprocessing
from typing import Any, NoReturn

import torch
from tensordict import MemoryMappedTensor
from torch.utils._pytree import tree_leaves
from torchrl.data import RandomSampler, RoundRobinWriter

_RAY = "torchrl_mpfa.integrations.ray.make_ray_replay has a buffer that any process may write to"


class WriterSampler(RandomSampler):
    """Sampler of a buffer in another process, which writes transitions and does nothing else.

    Args:
        by_priority: True if the process that made the buffer samples by priority.
    """

    def __init__(self, *, by_priority: bool) -> None:
        self.by_priority = by_priority

    def reject(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raise: signals and priorities are in the process that made the buffer."""
        raise RuntimeError(
            "a buffer in another process can only write: sample, empty, change and load it in the "
            f"process that made it. {_RAY}"
        )

    sample = load_state_dict = loads = reject


class SharedWrites:
    """Lock of the writes of a shared buffer, whose owner knows what other processes wrote.

    TorchRL's lock is another object, which one process cannot take twice.
    """

    def __init__(self, buffer: Any) -> None:
        self._buffer, self._lock, self._depth = buffer, multiprocessing.RLock(), 0
        self._seen = self._count()

    def _count(self) -> int:
        """Return the number of transitions that all processes wrote."""
        return int(getattr(getattr(self._buffer, "_writer", None), "_write_count", 0))

    def __enter__(self) -> None:
        self._lock.acquire()
        try:
            if self._depth == 0 and (new := self._count() - self._seen):
                self._read(new)
        except BaseException:
            self._lock.release()
            raise
        self._depth += 1

    def __exit__(self, *error: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._seen = self._count()
        self._lock.release()

    def _read(self, new: int) -> None:
        """Hand transitions of other processes to the sampler, the oldest first."""
        buffer = self._buffer
        sampler, storage, end = buffer._sampler, buffer._storage, int(buffer._writer._cursor)
        rows = [entry for entry in tree_leaves(storage._storage) if isinstance(entry, torch.Tensor)]
        # An entry without numbers has nothing to share.
        apart = [e for e in rows if e.numel() and not isinstance(e, MemoryMappedTensor)]
        if not all(entry.is_shared() for entry in apart):
            raise RuntimeError(
                "the transitions of another process are not in shared memory: start it by 'spawn', "
                f"not by 'fork'. {_RAY}"
            )
        slots = torch.arange(end - min(new, len(storage)), end, device="cpu")
        slots %= storage.max_size
        sampler.mark_update(slots, storage=storage)
        sampler.extend(slots)
        buffer._clock[0] += 1


def check_shared(buffer: Any) -> None:
    """Reject a buffer of which another process would get a copy, or whose slots it cannot name."""
    storage = buffer._storage
    for name, fits in (
        ("be shared, by buffer.share()", isinstance(buffer._write_lock, SharedWrites)),
        ("have a storage of one dimension", storage.ndim == 1),
        ("have a storage without shared_init", not getattr(storage, "shared_init", False)),
        ("have a RoundRobinWriter", isinstance(buffer._writer, RoundRobinWriter)),
        (
            "have a storage of its own",
            all(other is buffer for other in storage._attached_entities_iter()),
        ),
    ):
        if not fits:
            raise RuntimeError(f"a buffer that another process writes to must {name}. {_RAY}")
