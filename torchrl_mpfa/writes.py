"""Checked writes of a buffer: transitions are written whole, or rejected before any is."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from multiprocessing.context import get_spawning_popen
from typing import Any, NoReturn, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import RoundRobinWriter, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.data.replay_buffers import ConsumingSampler, PrioritizedSampler

from torchrl_mpfa.checks import check_not_negative
from torchrl_mpfa.native import opaque
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.states import SavedSampler
from torchrl_mpfa.sharing import SharedWrites, WriterSampler, check_shared
from torchrl_mpfa.storages.entries import as_path, check_finite_entries
from torchrl_mpfa.storages.plan import NewRows, RowPlan
from torchrl_mpfa.storages.tensor import SignalMemmapStorage, SignalTensorStorage, slots_of
from torchrl_mpfa.transforms import TransformMemory

_Buffer = TypeVar("_Buffer", bound="CheckedReplayBuffer")
REWARD_KEY = ("next", "reward")
"""Where TorchRL's collectors put the reward."""


class CheckedReplayBuffer(TensorDictReplayBuffer):
    """TorchRL's buffer, whose transitions are checked before any of them is written."""

    _memory: TransformMemory
    _allow_nonfinite: Sequence[NestedKey] = ()
    _plan: RowPlan | None = None
    _clock: list[int]
    """Count of writes, which the states of the buffer share and see change."""

    def _initialize_prioritized_sampler(self) -> None:
        # The last that is done when the parts are made.
        super()._initialize_prioritized_sampler()
        self._memory = TransformMemory(self._transform, self._allow_nonfinite)

    def share(self: _Buffer, shared: bool = True) -> _Buffer:
        """Let other processes write, or no longer; signals and priorities stay in this one."""
        before = getattr(self, "_write_lock", None)
        super().share(shared)
        if isinstance(before, SharedWrites):
            with before:  # Reads what was written so far.
                pass
        if shared:
            self._write_lock = before if isinstance(before, SharedWrites) else SharedWrites(self)
        return self

    def __getstate__(self) -> Any:
        if get_spawning_popen() is None:
            # The copy describes its own data.
            return {**super().__getstate__(), "_plan": None}
        # The property, not the attribute: with delayed_init the parts are made at their first use.
        keeps = isinstance(self.sampler, SavedSampler)
        if keeps:
            check_shared(self)
        # A copy of the generator's state would be gone before the process reads it.
        state = {**super().__getstate__(), "_plan": None, "_rng": None}
        by_priority = isinstance(self._sampler, PrioritizedSampler)
        return {**state, "_sampler": WriterSampler(by_priority=by_priority)} if keeps else state

    def _is_checked(self, data: Any) -> bool:
        # The property, not the attribute: with delayed_init the parts are made at their first use.
        sampler = self.sampler
        signals = isinstance(sampler, SignalSampler | WriterSampler)
        ours = signals or isinstance(self._storage, SignalTensorStorage)
        consumes = isinstance(sampler, ConsumingSampler)
        return ours and not consumes and isinstance(data, TensorDictBase)

    @opaque
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
                finite, a first priority cannot be or comes in another process, there is no batch
                size, or padding cannot be left out; nothing is changed, in the transforms neither.
        """
        if not self._is_checked(tensordicts):
            return super().extend(tensordicts, update_priority=update_priority)
        if tensordicts.ndim < self._storage.ndim:
            raise ValueError(
                f"tensordicts must have a batch size of {self._storage.ndim} or more dimensions, "
                f"got {[*tensordicts.shape]}: write a single step by add(...)"
            )
        tensordicts = self._without_padding(tensordicts)
        # Outside of inference mode: a caller without it must be able to use what is stored.
        with (
            torch.inference_mode(False),
            torch.no_grad(),
            # Asked first, as even an empty list of transforms takes its time.
            self._memory.transformed(tensordicts)
            if len(self._transform)
            else nullcontext(tensordicts) as data,
        ):
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
            return torch.zeros(shape, dtype=torch.long, device="cpu")
        priority = data.get(self.priority_key, None)
        if priority is not None and isinstance(self._sampler, SignalSampler):
            data = data.exclude(self.priority_key)
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
        if isinstance(self._sampler, WriterSampler) and self._sampler.by_priority:
            raise ValueError(
                f"{name} must not be given in another process than that of the sampler: leave the "
                "entry out, and the transitions get the highest priority"
            )
        # A reward that is no priority may be negative.
        by_priority = isinstance(self._sampler, PrioritizedSampler)
        if not by_priority and as_path(self.priority_key) == REWARD_KEY:
            return priority
        real = isinstance(priority, Tensor) and not priority.is_complex()
        if by_priority and prioritizes and not (real and priority.numel() == shape.numel()):
            form = f"{priority.dtype} of shape {[*priority.shape]}" if real else type(priority)
            raise ValueError(f"{name} must be one real number for each of {[*shape]}, got {form}")
        check_not_negative(name, priority)
        if prioritizes and hasattr(self._sampler, "check_priority"):
            self._sampler.check_priority(priority)
        if not by_priority:
            return priority
        # In the order of the slots, which is that of the data as they were written.
        priority = priority.reshape(shape)
        return (self._transpose(priority) if self.dim_extend > 0 else priority).reshape(-1)

    def _write(self, data: TensorDictBase) -> Tensor:
        if self.dim_extend > 0:
            data = self._transpose(data)
        new, of_table = self._prepare(data)
        writer = self._writer
        in_a_ring = isinstance(writer, RoundRobinWriter)
        place = (writer._cursor, writer._write_count) if in_a_ring else None
        # The sampler gets the rows that were checked. Another writer may keep some of them only.
        if in_a_ring and of_table is not None and self._storage.ndim == 1:
            self._sampler.take_rows(of_table)
        try:
            # A writer calls mark_update of this buffer, which calls that of the sampler. It adds
            # the slots, which the caller's data shall not get.
            index = self._write_in_turn(new) if new is not None else writer.extend(data.copy())
        except BaseException:
            if of_table is not None:
                self._sampler.take_rows(None)
            if place is not None:
                # The writer advances before the storage has the data.
                writer._cursor, writer._write_count = place
            raise
        self._clock[0] += 1
        self._sampler.extend(index)
        return index

    def _write_in_turn(self, rows: NewRows) -> Tensor:
        """Write rows that fit the storage in the next slots, as TorchRL's writer does."""
        storage, writer, count = self._storage, self._writer, len(rows)
        index = rows.slots
        rows.write(index, storage.max_size)
        writer._cursor = (writer._cursor + count) % storage.max_size
        writer._write_count += count
        storage.note_written(index)
        self._sampler.mark_update(index, storage=storage)
        return index

    def _next_slots(self, count: int) -> Tensor:
        """Return the slots in which so many rows come in turn, shape ``[B]``."""
        start, size = self._writer._cursor, self._storage.max_size
        slots = torch.arange(start, start + count, device="cpu")
        return slots if start + count <= size else slots % size

    def _prepare(self, data: TensorDictBase) -> tuple[NewRows | None, Tensor | None]:
        """Check transitions in the order of their slots.

        Returns:
            The rows if they are written by the plan, and those of the table if there is one.

        Raises:
            KeyError: If an entry is missing or unknown, or one that the sampler reads is missing.
            ValueError: If shape or dtype of an entry are not those in the storage, or a number is
                not finite.
        """
        lead = min(self._storage.ndim, data.ndim)
        self._check_width(data)
        plan, new = self._row_plan(), None
        if plan is None:
            check_finite_entries(data, lead, self._allow_nonfinite)
        else:
            if self._writes_in_turn():
                new = plan.match(data, self._next_slots(len(data)))
            if new is None:
                plan.check(data, lead)
        fuses = isinstance(self._sampler, SignalSampler)
        return new, self._sampler.check_new(data, data.shape[:lead].numel()) if fuses else None

    def _row_plan(self) -> RowPlan | None:
        """Return the plan of the stored rows; None before the first write."""
        stored = getattr(self._storage, "_storage", None)
        # What an empty storage was restored from is a tensordict without entries.
        if not (getattr(self._storage, "initialized", False) and isinstance(stored, TensorDict)):
            return None
        if len(stored.keys()) == 0:
            return None
        if self._plan is None or not self._plan.describes(stored):
            self._plan = RowPlan(stored, self._storage.ndim, self._allow_nonfinite)
        return self._plan

    def _writes_in_turn(self) -> bool:
        """Return True if a write is that of rows in the next slots, which nobody else is told."""
        return (
            type(self._storage) in (SignalTensorStorage, SignalMemmapStorage)
            and type(self._writer) is TensorDictRoundRobinWriter
            and not self._writer.tracks_generations
            and isinstance(self._sampler, SignalSampler)
            and all(other is self for other in self._storage._attached_entities_iter())
        )

    def _check_width(self, data: TensorDictBase) -> None:
        """Reject rows of another width than those of a storage of several dimensions."""
        storage = self._storage
        if storage.ndim == 1 or data.ndim < storage.ndim:
            return
        across = data.shape[1 : storage.ndim]
        if storage.initialized:
            expected = storage._total_shape[1:]
            if across != expected:
                raise ValueError(
                    f"transitions must come {[*expected]} at a time, as the first ones did, got "
                    f"{[*across]}"
                )
        elif isinstance(self._sampler, SignalSampler) and storage.max_size % across.numel():
            # TorchRL rounds up; the sampler that fuses could not.
            raise ValueError(
                f"max_size must be a multiple of the {across.numel()} transitions that come at a "
                f"time, got {storage.max_size}"
            )

    def add(self, data: TensorDictBase) -> Any:
        """Write one transition, and return its slot.

        In a storage of several dimensions, one of each environment, batch size ``[E]``, and return
        their places, ``[E, 2]``.

        Raises:
            KeyError: See :meth:`extend`.
            ValueError: See :meth:`extend`; or if ``data`` has no dimension of environments.
        """
        if not self._is_checked(data):
            return super().add(data)
        if data.ndim < self.dim_extend:
            raise ValueError(
                f"data must be one step of each environment, batch size [E], got {[*data.shape]}"
            )
        # TorchRL's add would ask the new transition for learned signals, which it cannot have.
        # Time comes after several environments.
        index = self.extend(data.unsqueeze(self.dim_extend))
        return int(index[0]) if index.shape == (1,) and index[0] >= 0 else index

    @opaque
    def __setitem__(self, index: Any, value: Any) -> None:
        """Write whole transitions in slots, and none of their entries by its key."""
        self._check_owned()
        if isinstance(index, str | tuple):
            self._write_in_place()
        if self._is_checked(value):
            self._prepare(value if value.ndim else value.unsqueeze(0))
        super().__setitem__(index, value)
        self._clock[0] += 1
        # A storage of this package says so itself, whoever writes in it.
        fuses = isinstance(self._sampler, SignalSampler)
        if fuses and not isinstance(self._storage, SignalTensorStorage):
            self.mark_update(slots_of(self._storage, index))

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
        self._check_owned()
        self._settle()
        with self._replay_lock, self._write_lock:
            super().empty(empty_write_count)
        self._memory.empty()

    def _check_loaded(self) -> None:
        """Reject loaded transitions that could not have been written."""
        length = len(self._storage)
        if isinstance(self._sampler, SignalSampler) and self._sampler.table.size != length:
            size = self._sampler.table.size
            raise ValueError(f"the saved storage has {length} rows, its signals {size}")
        if length and isinstance(data := self._storage[:], TensorDictBase):
            check_finite_entries(data, self._storage.ndim, self._allow_nonfinite)

    def _record_cursor(self) -> None:
        """Tell the storage what was written last, of which TorchRL keeps no record."""
        storage, cursor = self._storage, getattr(self._writer, "_cursor", None)
        if cursor is not None and len(storage) and not self._is_consuming():
            # A list has no dimension but its own.
            length = getattr(storage, "_len_along_dim0", None) or len(storage)
            storage._set_last_cursor((cursor - 1) % length)

    def _check_owned(self) -> None:
        """Reject in another process what would pass the sampler of this one by."""
        if isinstance(self.sampler, WriterSampler):
            self.sampler.reject()

    def _settle(self) -> None:
        """Forget batches that were sampled ahead, and read what other processes wrote."""
        with self._futures_lock:
            self._clear_prefetch_queue_locked()
        with self._write_lock:
            pass
