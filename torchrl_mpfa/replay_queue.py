"""TorchRL's buffer that samples ahead: in one order, and no batch from before a state was left."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl.data import TensorDictReplayBuffer


class QueueReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer whose thread samples batches ahead, as one seed always gives them.

    Of TorchRL's locks ``_replay_lock`` is held by whoever samples, writes or updates, and
    ``_futures_lock`` by whoever takes or drops batches in the queue; where both are, the latter
    comes first. Whatever changes the next batches waits for those that are being sampled.
    """

    def __init__(self, **kwargs: Any) -> None:
        self._queued_size: int | None = None
        super().__init__(**kwargs)
        self._sample_in_order()

    def _sample_in_order(self) -> None:
        """Have one thread sample: of TorchRL's, one for each batch, any may be the first."""
        if self._prefetch:
            self._prefetch_executor = ThreadPoolExecutor(1, thread_name_prefix="prefetch")

    def _wait_for_queue(self) -> None:
        """Wait for the batches that are being sampled; their errors are for who takes them."""
        if self._prefetch:
            with self._futures_lock:
                queued = tuple(self._prefetch_queue)
            wait(queued)

    @contextmanager
    def _without_queue(self) -> Iterator[None]:
        """Drop the batches that were sampled ahead; nobody samples more while this is open."""
        with self._futures_lock:
            # Not cancelled: which of them were sampled, and moved the generator, is then certain.
            wait(self._prefetch_queue)
            self._prefetch_queue.clear()
            yield

    @contextmanager
    def _queue_of(self, batch_size: int | None) -> Iterator[None]:
        """While a batch is taken: those in the queue are of its size."""
        if not self._prefetch:
            yield
            return
        size = self._batch_size if batch_size is None else batch_size
        with self._futures_lock:
            if size != self._queued_size:
                with self._without_queue():
                    self._queued_size = size
            yield

    def empty(self, empty_write_count: bool = True) -> None:
        """Forget all transitions, and the batches that were sampled ahead.

        Args:
            empty_write_count: As in TorchRL.
        """
        with self._without_queue(), self._replay_lock, self._write_lock:
            super().empty(empty_write_count)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state, without batches that were sampled ahead."""
        with self._without_queue():
            super().load_state_dict({**state_dict, "_prefetch_state": None})

    def loads(self, path: str | Path) -> None:
        """Restore from a folder, without batches that were sampled ahead."""
        with self._without_queue():
            super().loads(path)

    @contextmanager
    def _capture_prefetch_state(self, *, clone_queue: bool = True) -> Iterator[dict[str, Any]]:
        """Drop the queue whenever a state is saved: who goes on and who resumes sample the same."""
        with self._without_queue(), super()._capture_prefetch_state(clone_queue=clone_queue) as now:
            yield now

    def _dump_prefetch_state(self, path: Path, prefetch_state: dict[str, Any]) -> None:
        """Nothing: TorchRL would pickle it, and what is pickled can execute anything."""

    def _load_prefetch_state(self, path: Path) -> None:
        """Nothing: TorchRL would unpickle it."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._sample_in_order()
