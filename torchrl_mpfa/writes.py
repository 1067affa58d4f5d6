"""Checked writes of a buffer: transitions are written whole, or rejected before any is."""

from __future__ import annotations

from typing import Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import RoundRobinWriter, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import check_finite
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.storages.storage import SignalStorageMixin
from torchrl_mpfa.transforms import TransformMemory


class CheckedReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer, whose transitions are checked where its storage keeps signals."""

    _memory: TransformMemory

    def _initialize_prioritized_sampler(self) -> None:
        # The last that is done when the parts are made.
        super()._initialize_prioritized_sampler()
        allowed = getattr(self._storage, "_allow_nonfinite", ())
        self._memory = TransformMemory(self._transform, allowed)

    @property
    def _checks(self) -> bool:
        return isinstance(self.storage, SignalStorageMixin) and not self._is_consuming()

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Write transitions, and return their slots.

        Args:
            tensordicts: Transitions, batch size ``[B]``, or ``[B, T]`` from ``B`` environments. In
                a storage of one dimension each of the latter is a row of its own, environment by
                environment; padding of split trajectories is left out.
            update_priority: As in TorchRL.

        Returns:
            Slots, shape ``[B]``; ``[B * T, 2]`` for a storage of two dimensions.

        Raises:
            KeyError: If an entry is missing or unknown; nothing is changed.
            ValueError: If an entry has another shape or dtype than in the storage, a number is not
                finite, a first priority cannot be, there is no batch size, or padding cannot be
                left out; nothing is changed, in the transforms neither.
        """
        if not self._checks or not isinstance(tensordicts, TensorDictBase):
            return super().extend(tensordicts, update_priority=update_priority)
        if tensordicts.ndim < self._storage.ndim:
            raise ValueError(
                f"tensordicts must have a batch size of {self._storage.ndim} or more dimensions, "
                f"got {[*tensordicts.shape]}: write a single step by add(...)"
            )
        tensordicts = self._without_padding(tensordicts)
        # What is made here must be of use where the caller has no inference mode.
        outside = torch.inference_mode(False), torch.no_grad()
        with outside[0], outside[1], self._memory.transformed(tensordicts) as data:
            return self._extend_checked(data, update_priority is not False)

    def _without_padding(self, data: TensorDictBase) -> TensorDictBase:
        """Leave out rows that a mask of padded trajectories marks, as ``split_trajs`` makes it."""
        for key in (("collector", "mask"), "mask"):
            mask = data.get(key, None)
            # A mask of one's own, as of actions, has a dimension more.
            pads = isinstance(mask, Tensor) and mask.dtype is torch.bool
            if pads and mask.shape == data.shape and not mask.all():
                if self._storage.ndim > 1 or self._memory.parts():
                    raise ValueError(
                        f"padding, which {key!r} marks, cannot be left out with several dimensions "
                        f"or a transform at the write: extend(rows[rows[{key!r}]]) for each row"
                    )
                data = data[mask]
        return data

    def _extend_checked(self, data: TensorDictBase | None, prioritizes: bool) -> Tensor:
        """Write transitions that the transforms made."""
        if data is None or data.shape.numel() == 0:
            shape = (0,) if self._storage.ndim == 1 else (0, self._storage.ndim)
            return torch.zeros(shape, dtype=torch.long)
        priority = data.get(self.priority_key, None)
        # The writer adds the slots to it, and the caller's is left as it is.
        taken = priority is not None and isinstance(self._sampler, SignalSampler)
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
        """Return priorities of new transitions in the order of their slots, once checked."""
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
            # It may hand on some of them only, and records them before the storage does.
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

    def add(self, data: TensorDictBase) -> Any:
        """Write one transition, and return its slot.

        In a storage of several dimensions, one of each environment, batch size ``[E]``, and return
        their places, ``[E, 2]``.

        Raises:
            KeyError: See :meth:`extend`.
            ValueError: See :meth:`extend`; or if ``data`` has no dimension of environments.
        """
        if not self._checks:
            return super().add(data)
        if data.ndim < self.dim_extend:
            raise ValueError(
                f"data must be one step of each environment, batch size [E], got {[*data.shape]}"
            )
        # TorchRL's add would ask the new transition for learned signals, which it cannot have.
        # Time comes after several environments.
        index = self.extend(data.unsqueeze(self.dim_extend))
        return int(index[0]) if index.shape == (1,) and index[0] >= 0 else index

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write whole transitions in slots, and none of their entries by its key."""
        if isinstance(index, str | tuple):
            self._write_in_place()
        super().__setitem__(index, value)

    def _write_in_place(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raise: signals are read when a transition is written, and would not follow."""
        raise NotImplementedError(
            "stored transitions cannot be changed in place, as their signals were read when they "
            "were written: write the changed transitions by extend(...)"
        )

    set_ = set_at_ = update_ = update_if_present = _write_in_place

    def empty(self, empty_write_count: bool = True) -> None:
        """Forget all transitions, and those that wait in a transform.

        Args:
            empty_write_count: As in TorchRL.
        """
        with self._replay_lock, self._write_lock:
            super().empty(empty_write_count)
        self._memory.empty()
