"""A replay buffer that hands several signals, not one number, from batch to sampler."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer, RoundRobinWriter, Storage, Transition, Writer
from torchrl.data.replay_buffers import PrioritizedSampler, Sampler
from torchrl.envs.transforms import Transform

from torchrl_mpfa.checks import COUNT_OR_ZERO, check, check_counts, seeded_generator
from torchrl_mpfa.native import opaque
from torchrl_mpfa.samplers.composition import distributions
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.states import SavedSampler
from torchrl_mpfa.saving import check_saved, dump, open_dump
from torchrl_mpfa.storages.schema import as_integers, as_path
from torchrl_mpfa.storages.states import load_part, state_of
from torchrl_mpfa.storages.tensor import rows_with
from torchrl_mpfa.writes import REWARD_KEY, CheckedReplayBuffer

_MISSING = (
    "signal {name!r} is missing: the batch has no {key!r}. An update of ActorCritic writes "
    "td_error and action_gradient, and write_signals(batch, loss) those of TorchRL's own losses; "
    "with another loss, or a signal of your own, write batch[{key!r}] = ..., one number per "
    "transition"
)
_PARTS = ("storage", "sampler", "writer")
"""Parts with a state of their own."""
_CLOCK, _TIME = "_clock", "_time"
"""Entries of a state: the count of writes as it is now, and as it was."""
_UNRETURNED = 100
"""Batches in a row without an update of priorities after which a warning is given."""


class SignalReplayBuffer(CheckedReplayBuffer):
    """:class:`~torchrl.data.TensorDictReplayBuffer` for samplers that fuse several signals.

    TorchRL's buffer reduces the signals of a batch to one number per transition. This buffer reads
    each signal that the sampler fuses, drops the rows whose slot was overwritten since they were
    sampled, and hands the rest on. Transitions that do not fit the stored ones are rejected before
    any of them is written. With TorchRL's storage and sampler it is TorchRL's buffer.

    Signals are read when a transition is written. Entries of stored transitions cannot be changed
    in place (``set_``, ``set_at_``, ``update_``, ``update_if_present``, ``buffer[key] = ...``).

    Args:
        storage: Where the transitions are; any storage of TorchRL's.
        sampler: How batches are sampled; any sampler of TorchRL's.
        writer: Where the next transition is written; any writer of TorchRL's.
        transform: Transform of what is written and sampled.
        batch_size: ``B``, for :meth:`sample` without one.
        priority_key: Where a first priority is given with a transition.
        allow_nonfinite: Entries that may hold NaN and infinities; none by default.
        generator: Source of all randomness of the buffer; by default a new one, seeded by
            ``torch.manual_seed``. Its state is saved with the buffer.
        **kwargs: Further arguments of :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        TypeError: If ``generator`` is no generator.
        ValueError: If ``batch_size`` is no positive integer, the capacities of sampler and storage
            differ, or ``prefetch`` meets priorities; or, where signals are fused, if
            ``priority_key`` is where one is read, or ``sample_unit`` makes sequences.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import MPFASampler, SignalTensorStorage
        >>> buffer = SignalReplayBuffer(
        ...     storage=SignalTensorStorage(100), sampler=MPFASampler(100), batch_size=4
        ... )
        >>> index = buffer.extend(TensorDict({"next": {"reward": torch.rand(10, 1)}}, [10]))
        >>> batch = buffer.sample()
        >>> batch["signals"] = TensorDict(
        ...     {"td_error": torch.rand(4), "action_gradient": torch.rand(4)}, [4]
        ... )
        >>> buffer.update_tensordict_priority(batch)
        >>> sorted(buffer.sampler.weights)
        ['action_gradient', 'reward', 'td_error']
    """

    takes_signals = True
    """Priorities come back as signals, of several batches in one call."""

    def __init__(
        self,
        *,
        storage: Storage | Callable[[], Storage] | None = None,
        sampler: Sampler | Callable[[], Sampler] | None = None,
        writer: Writer | Callable[[], Writer] | None = None,
        transform: Transform | Callable[[Any], Any] | None = None,
        batch_size: int | None = None,
        priority_key: str = "td_error",
        allow_nonfinite: Sequence[NestedKey] = (),
        generator: torch.Generator | None = None,
        **kwargs: Any,
    ) -> None:
        self._allow_nonfinite = tuple(allow_nonfinite)
        self._clock = [0]
        self.stale_updates = 0
        self._unreturned, self._warned = 0, False
        if batch_size is not None:
            batch_size = check_counts(batch_size=batch_size)
        if not isinstance(generator, torch.Generator | None):
            raise TypeError(f"generator must be a torch.Generator, got {generator!r}")
        # TorchRL sets it once the parts are made, which have to agree with it.
        self.priority_key = priority_key
        super().__init__(
            storage=storage,
            sampler=sampler,
            writer=writer,
            transform=transform,
            batch_size=batch_size,
            priority_key=priority_key,
            generator=generator or seeded_generator(),
            **kwargs,
        )

    def _initialize_prioritized_sampler(self) -> None:
        # Here an error leaves the buffer uninitialized, also where delayed_init put the parts off.
        if self._prefetch and isinstance(self._sampler, PrioritizedSampler | SavedSampler):
            raise ValueError(
                f"prefetch must be None with {type(self._sampler).__name__}, got "
                f"{self._prefetch_cap}: a batch that is sampled ahead knows nothing of the update "
                "and the write before"
            )
        if self._fuses:
            self._check_fusing_parts()
        super()._initialize_prioritized_sampler()
        if self._fuses and len(self._storage):
            slots = torch.arange(len(self._storage), device="cpu")
            self._sampler.mark_update(slots, storage=self._storage)

    def _check_fusing_parts(self) -> None:
        """Reject parts that do not go together with a sampler that fuses signals."""
        sampler, size = self._sampler, self._storage.max_size
        table = sampler.attach(self._storage)
        if sampler.max_size != size:
            raise ValueError(
                f"max_capacity of the sampler is {sampler.max_size}, max_size of the storage {size}"
            )
        if as_path(self.priority_key) in map(as_path, table.read_keys):
            raise ValueError(
                f"priority_key must not be the key of a reward or a signal, got "
                f"{self.priority_key!r}: first priorities are not stored with the transitions"
            )
        if not isinstance(self._sample_unit, Transition | None):
            raise ValueError(
                "sample_unit must be None with a sampler that fuses signals, got "
                f"{type(self._sample_unit).__name__}: signals belong to single transitions, "
                "and SignalSliceSampler samples slices of them"
            )
        if self._batch_size is not None:
            sampler.check_batch_size(self._batch_size)

    @property
    def _fuses(self) -> bool:
        # The property, not the attribute: with delayed_init the parts are made at their first use.
        return isinstance(self.sampler, SignalSampler)

    def _sample(self, batch_size: int) -> tuple[Any, dict[str, Any]]:
        more = self._transform or self._sample_unit or self._pin_memory
        if more or self._writer.tracks_generations or not self._fuses:
            data, info = super()._sample(batch_size)
            rest = info if self._fuses else {}
        else:
            with self._replay_lock, self._write_lock:
                index, info = self._sampler.sample(self._storage, batch_size)
                info["index"] = index
                data, rest = rows_with(self._storage, index, info)
                data = self._collate_fn(data)
        # Written here, where the batch is made: afterwards TorchRL's buffer would move each
        # entry to the device that it is on already, at a tenth of the cost of the whole call.
        if rest:
            with data.unlock_() if data.is_locked else nullcontext():
                for key, value in rest.items():
                    data.set(key, torch.stack(value, -1) if isinstance(value, tuple) else value)
        return data, info

    @opaque
    def sample(
        self,
        batch_size: int | None = None,
        return_info: bool = False,
        include_info: bool | None = None,
    ) -> Any:
        """Sample a batch, with ``index``, ``priority_weight`` and ``written_at`` in it.

        Args:
            batch_size: ``B``; by default that of the constructor.
            return_info: True to return the sampler's information as well.
            include_info: As in TorchRL, where it is deprecated.

        Returns:
            The batch, or the batch and the information.

        Raises:
            ValueError: If ``batch_size`` is not a positive integer.

        Warns:
            UserWarning: Once, if a hundred batches in a row were sampled by priority and none was
                updated.
        """
        if batch_size is not None:
            batch_size = check_counts(batch_size=batch_size)
        if isinstance(self.sampler, PrioritizedSampler):
            self._count_batch()
        if return_info or include_info is not None or not self._fuses:
            return super().sample(batch_size, return_info, include_info)
        return ReplayBuffer.sample(self, batch_size)

    def _count_batch(self) -> None:
        """Warn of a training loop that never updates priorities."""
        self._unreturned += 1
        if self._unreturned <= _UNRETURNED or self._warned or not self._sampler.alpha:
            return
        self._warned = True
        warnings.warn(
            f"{_UNRETURNED} batches in a row were sampled and no priority was updated: call "
            "update_tensordict_priority(batch) after the loss. TorchRL's trainers with an "
            "optimization stepper do not call it: use "
            "torchrl_mpfa.integrations.trainer.PriorityStepper",
            stacklevel=3,
        )

    @opaque
    def update_priority(self, index: Any, priority: Any) -> None:
        """Set priorities directly, as in TorchRL."""
        # TorchRL would move the numbers to the default device.
        with torch.device(getattr(priority, "device", "cpu")):
            super().update_priority(index, priority)
        self._unreturned = 0

    @opaque
    def update_tensordict_priority(self, data: TensorDictBase, *, batches: int = 1) -> None:
        """Update signals and priorities of a sampled batch.

        Args:
            data: A batch from :meth:`sample` in which the loss wrote the learned signals, each of
                shape ``[B]`` or ``[B, 1]``, under the keys that the sampler's signals name.
            batches: Number of batches of one size in ``data``, one after the other: each has
                positions and a mean of its own in Eqs. (23)-(24).

        Raises:
            KeyError: If a signal or the index is missing; nothing is changed.
            ValueError: If a signal is negative, not finite or out of shape, or ``data`` is not so
                many equal batches; nothing is changed.
        """
        if not self._fuses:
            super().update_tensordict_priority(data)
            return
        index = data.get("index", None)
        if index is None:
            raise KeyError(f"'index' is missing in the batch, got {sorted(data.keys())}")
        if self._storage.ndim == 1 and (index := as_integers(index)).ndim != 1:
            index = index.reshape(-1)
        signals: dict[str, Tensor] = {}
        for signal in self._sampler.signals:
            if signal.known_at == "update":
                value = data.get(signal.key, None)
                if value is None:
                    raise KeyError(_MISSING.format(name=signal.name, key=signal.key))
                signals[signal.name] = value
        with self._replay_lock, self._write_lock:
            stale = self._sampler.update_signals(
                index,
                signals,
                storage=self._storage,
                written_at=data.get("written_at", None),
                batches=batches,
            )
            self.stale_updates += stale
        self._unreturned = 0

    def anneal(self, beta: float, fraction: float) -> None:
        """Set beta, and the weights of a fusion that changes; no effect without priorities.

        Args:
            beta: Exponent of the importance weights, Eq. (10).
            fraction: Share of the training that is done, from 0 to 1.
        """
        if self._fuses:
            with self._replay_lock:
                self._sampler.beta = beta
                self._sampler.anneal(fraction)

    def rewards(self) -> Tensor:
        """Return the rewards of all transitions, shape ``[N]``."""
        if self._fuses:
            with self._replay_lock, self._write_lock:
                rewards: Tensor = self._sampler.table.rewards
            return rewards
        return self[:][REWARD_KEY].reshape(len(self)).double()

    def distributions(self) -> dict[str, Tensor]:
        """Return numbers of all transitions by name, each of shape ``[N]``.

        Each signal as it was last written (NaN where it never was), ``"priority"``, and
        ``"weight"``, the importance weight of Eq. (10) that the transition would have in a batch
        (NaN where it cannot be sampled); nothing without priorities.
        """
        with self._replay_lock, self._write_lock:
            return distributions(self.sampler, len(self))

    def stats(self) -> dict[str, Any]:
        """Return TorchRL's counters, and the sampler's statistics of signals and batch."""
        with self._replay_lock, self._write_lock:
            numbers: dict[str, Any] = {**super().stats(), "stale_updates": self.stale_updates}
            if self.initialized and self._fuses:
                numbers |= {"compiled": self._sampler.compiled, **self._sampler.stats()}
        return numbers

    def state_dict(self) -> dict[str, Any]:
        """Return the state of all parts as in TorchRL.

        As in TorchRL the data are not copied: save or copy the state before more is written, after
        which the state is rejected. Batches that were sampled ahead are forgotten.
        """
        self._settle()
        with self._replay_lock, self._write_lock:
            return self._state(lambda part: part.state_dict())

    def _state(self, state_of: Callable[[Any], Any]) -> dict[str, Any]:
        # The properties, not the attributes: with delayed_init the parts are made here.
        parts = {f"_{name}": state_of(getattr(self, name)) for name in _PARTS}
        source = self._rng
        return {
            **parts,
            "_transforms": self._transform.state_dict(),
            "_batch_size": self._batch_size,
            "_consume_after_n_samples": self._consume_after_n_samples,
            "_rng": None if source is None else (source.get_state(), str(source.device)),
            # By which the data, no copies, are seen to be no longer those of the state.
            _CLOCK: self._clock,
            _TIME: self._clock[0],
        }

    @torch.inference_mode(False)
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore storage, signals, priorities, writer, transforms and generator.

        Steps that wait in a transform that does not save them are lost, as in TorchRL's of n steps.

        Raises:
            KeyError: If an entry is missing; nothing is changed, but if the storage lacks it the
                buffer is empty.
            ValueError: If the state of a part does not fit the part; nothing is changed, but if
                the part is the storage the buffer is empty.
        """
        sampler = self.sampler  # With delayed_init the parts are made here.
        self._check_state(state_dict)
        generator = None
        if state_dict["_rng"] is not None:
            numbers, device = state_dict["_rng"]
            generator = torch.Generator(device=device)
            generator.set_state(numbers)
        self._settle()
        with self._replay_lock, self._write_lock:
            with self._memory.kept():
                before = deepcopy(self._transform.state_dict())
                try:
                    # No step that waits may join those of the state.
                    self._memory.empty()
                    self._transform.load_state_dict(state_dict["_transforms"])
                    self._memory.check_finite()
                    load_part(sampler, state_dict["_sampler"])
                except BaseException:
                    self._transform.load_state_dict(before)
                    raise
            if state_dict.get(_CLOCK) is not self._clock:
                # States that share the clock are no longer of these data.
                self._clock[0] = -1
                self._clock = [state_dict.get(_TIME, 0)]
            try:
                # Last, as it may be too large to be set back.
                load_part(self._storage, state_dict["_storage"])
                self._check_loaded()
                load_part(self._writer, state_dict["_writer"])
                self._record_cursor()
            except BaseException:
                self.empty()
                raise
            self._batch_size = state_dict["_batch_size"]
            self._consume_after_n_samples = state_dict.get("_consume_after_n_samples")
            if generator is not None:
                self.set_rng(generator)

    def _check_state(self, state: Any) -> None:
        """Reject a state that lacks an entry, or is of another sampler, writer or time."""
        names = *(f"_{name}" for name in _PARTS), "_transforms", "_batch_size", "_rng"
        check_saved("buffer", state, names)
        kind = state["_sampler"].get("_kind")
        if kind is not None and not hasattr(self._sampler, "KIND"):
            # TorchRL's own would leave out what it does not know.
            raise ValueError(
                f"the saved sampler is {kind!r}, this one a {type(self._sampler).__name__}"
            )
        if state.get(_CLOCK) not in (None, [state.get(_TIME)]):
            raise ValueError(
                "the buffer was written to since this state of it was made, whose data are the "
                "buffer's own: save or copy a state before more is written"
            )
        # Other writers have no cursor, nor has their state.
        if isinstance(self._writer, RoundRobinWriter):
            check_saved("writer", state["_writer"], ("_cursor",))
            check(COUNT_OR_ZERO, cursor=(cursor := state["_writer"]["_cursor"]))
            if self._storage.ndim == 1 and cursor >= self._storage.max_size:
                raise ValueError(
                    f"cursor of the saved writer must be below {self._storage.max_size}, got "
                    f"{cursor}"
                )
        if state["_batch_size"] is not None:
            check_counts(batch_size=state["_batch_size"])

    def dumps(self, path: str | Path) -> None:
        """Save the state in a folder, whole or not at all, with a checksum.

        Raises:
            pickle.UnpicklingError: If the data hold anything but tensors and plain values; nothing
                is written.
        """
        # Before the locks, which a batch that is sampled ahead waits for.
        self._settle()
        with self._replay_lock, self._write_lock:
            dump(self._state(state_of), path)

    @torch.inference_mode(False)
    def loads(self, path: str | Path) -> None:
        """Restore from a folder that :meth:`dumps` wrote, without executing anything in it.

        Raises:
            FileNotFoundError: If there is no such folder.
            KeyError: As :meth:`load_state_dict`.
            ValueError: As :meth:`load_state_dict`; or if the file is damaged; nothing is changed.
        """
        self.load_state_dict(open_dump(path))
