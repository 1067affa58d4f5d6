"""TorchRL's buffer with signals that follow writes in place, and a warning of a wrong transform."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import RoundRobinWriter, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler
from torchrl.envs.transforms import MultiStepTransform

from torchrl_mpfa.checks import check_finite
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.storages.base import SignalStorageMixin
from torchrl_mpfa.storages.schema import as_path
from torchrl_mpfa.transform_memory import TransformMemory


def _followed(write: Callable[..., Any], told: Callable[..., tuple[Any, Any]]) -> Any:
    """A write in place, of certain entries in certain slots, that the signals follow."""

    @wraps(write)
    def followed(self: TensorDictReplayBuffer, *args: Any, **kwargs: Any) -> Any:
        if not isinstance(self.storage, SignalStorageMixin):
            return write(self, *args, **kwargs)
        with self._replay_lock, self.storage.rewriting(*told(*args, **kwargs)):
            written = write(self, *args, **kwargs)
        if isinstance(self.sampler, SignalSampler):
            self.sampler.reread(self.storage)
        return written

    return followed


def _chosen(data: Any, clone: bool = False, *, keys_to_update: Any = None) -> tuple[Any, Any]:
    chosen = data if keys_to_update is None else TensorDict(dict(data)).select(*keys_to_update)
    return chosen, slice(None)


_Buffer = TensorDictReplayBuffer


class FollowedReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer with signals in its storage that follow every write in place."""

    set_ = _followed(_Buffer.set_, lambda key, value: ({key: value}, slice(None)))
    set_at_ = _followed(_Buffer.set_at_, lambda key, value, index: ({key: value}, index))
    update_ = _followed(_Buffer.update_, _chosen)
    update_if_present = _followed(_Buffer.update_if_present, lambda patch, **_: (patch, None))
    _set_places = _followed(_Buffer.__setitem__, lambda index, value: (value, index))

    def _extend_checked(self, data: TensorDictBase | None, prioritizes: bool) -> Tensor:
        """Write what the transforms made."""
        if data is None or data.shape.numel() == 0:
            shape = (0,) if self._storage.ndim == 1 else (0, self._storage.ndim)
            return torch.zeros(shape, dtype=torch.long)
        priority = data.get(self.priority_key, None)
        # The writer adds the slots to it, and the caller's is left as it is.
        taken = priority is not None and isinstance(self.sampler, SignalSampler)
        data = data.exclude(self.priority_key) if taken else data.copy()
        if type(data) is not TensorDict:
            data = data.contiguous()
        if priority is not None:
            priority = self._first_priorities(priority, data.shape, prioritizes)
        if self._storage.ndim == 1 and data.ndim > 1:
            data = data.reshape(-1)
        with self._replay_lock, self._write_lock:
            index = self._write(data)
        if priority is not None and prioritizes:
            self.update_priority(index, priority)
        return index

    def _first_priorities(self, priority: Any, shape: torch.Size, prioritizes: bool) -> Any:
        """Priorities of new transitions in the order of their slots, or raise before any is."""
        name = f"{self.priority_key!r} of the transitions"
        # Where nothing is sampled by it, a reward may be negative.
        weighs = isinstance(self._sampler, PrioritizedSampler)
        if not (weighs or self.priority_key != self._storage.signal_table.reward_key):
            return priority
        real = isinstance(priority, Tensor) and not priority.is_complex()
        if weighs and prioritizes and not (real and priority.numel() == shape.numel()):
            found = f"{priority.dtype} of shape {[*priority.shape]}" if real else type(priority)
            raise ValueError(f"{name} must be one real number for each of {[*shape]}, got {found}")
        check_finite(name, priority)
        if prioritizes and hasattr(self._sampler, "check_priority"):
            self._sampler.check_priority(priority)
        if not weighs:
            return priority
        # In the order of the slots, which is that of the data as they were written.
        priority = priority.reshape(shape)
        return (self._transpose(priority) if self.dim_extend > 0 else priority).reshape(-1)

    def _write(self, data: TensorDictBase) -> Tensor:
        if self.dim_extend > 0:
            data = self._transpose(data)
        writer = self._writer
        in_a_ring = isinstance(writer, RoundRobinWriter)
        if not in_a_ring:
            # It may hand on some of them only, and takes note of them before the storage does.
            self._storage.check(data)
        place = (writer._cursor, writer._write_count) if in_a_ring else None
        try:
            with torch.no_grad():
                index: Tensor = writer.extend(data)
        except BaseException:
            if place is not None:
                # It moves on before the storage checks what it is to write.
                writer._cursor, writer._write_count = place
            raise
        self._sampler.extend(index)
        return index

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write transitions, or by a key one entry of all of them, in place.

        With a key TorchRL writes to a copy where the storage is not full, and where it is puts the
        value itself in the storage.
        """
        if not isinstance(self.storage, SignalStorageMixin) or not isinstance(index, str | tuple):
            super().__setitem__(index, value)
        elif isinstance(index, str) or all(isinstance(word, str) for word in index):
            self.set_(index, self._transpose(value) if self.dim_extend > 0 else value)
        elif len(index) == 1:
            self[index[0]] = value
        else:
            self._set_places(index, value)

    def _initialize_prioritized_sampler(self) -> None:
        # The last that is done when the parts are made.
        super()._initialize_prioritized_sampler()
        _warn_of_steps_past_the_end(self._transform)
        signals = isinstance(self._storage, SignalStorageMixin)
        allowed = self._storage._allow_nonfinite if signals else None
        self._memory = TransformMemory(self._transform, allowed)
        self._memory.parts()

    def append_transform(self, transform: Any, *, invert: bool = False) -> Any:
        """Add a transform at the end, as in TorchRL."""
        _warn_of_steps_past_the_end(transform)
        found = super().append_transform(transform, invert=invert)
        self._memory.parts()
        return found

    def insert_transform(self, index: int, transform: Any, *, invert: bool = False) -> Any:
        """Add a transform at a place, as in TorchRL."""
        _warn_of_steps_past_the_end(transform)
        found = super().insert_transform(index, transform, invert=invert)
        self._memory.parts()
        return found

    def empty(self, empty_write_count: bool = True) -> None:
        """Forget all transitions, and those that wait in a transform.

        Args:
            empty_write_count: As in TorchRL.
        """
        with self._replay_lock, self._write_lock:
            super().empty(empty_write_count)
        self._memory.empty()


def _warn_of_steps_past_the_end(transform: Any) -> None:
    """Warn of n-step transitions that do not know that their last step ended the episode."""
    for part in transform.modules() if isinstance(transform, nn.Module) else ():
        if not isinstance(part, MultiStepTransform) or part.n_steps == 1:
            continue
        if any(as_path(key)[-1] == "terminated" for key in part.done_keys):
            warnings.warn(
                f"MultiStepTransform with done_keys={part.done_keys} leaves 'terminated' where it "
                "was, while the next observation moves n steps on: targets are bootstrapped past "
                "the end of an episode. Set done_keys=['done']",
                stacklevel=4,
            )
