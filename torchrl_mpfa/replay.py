"""A replay buffer that hands several signals, not one number, from batch to sampler."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer, Transition
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import check_counts, seeded_generator
from torchrl_mpfa.files import load_safely, new_dump, open_dump, save_atomically
from torchrl_mpfa.replay_writes import FollowedReplayBuffer
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.samplers.tree import TreeSampler
from torchrl_mpfa.saved import Entry, check_entries, count, generator
from torchrl_mpfa.storages.base import SignalStorageMixin
from torchrl_mpfa.storages.schema import as_path
from torchrl_mpfa.storages.table import SignalTable

_MISSING = (
    "signal {name!r} is missing: the batch has no {key!r}. SignalDDPGLoss, SignalTD3Loss and "
    "SignalSACLoss write td_error and action_gradient; with another loss, or a signal of your own, "
    "write batch[{key!r}] = ..., one number per transition"
)
_KEPT, _TRANSFORMS = "_kept", "transforms.pt"
"""Where a saved buffer has what waits in its transforms, and the file of a dump with that."""
_UNRETURNED = 100
"""Batches in a row without an update of priorities after which a warning is given."""


class SignalReplayBuffer(FollowedReplayBuffer):
    """:class:`~torchrl.data.TensorDictReplayBuffer` for samplers that fuse several signals.

    TorchRL's buffer reduces whatever a batch brings to one number per transition. This one reads
    each signal that the sampler fuses, drops the rows whose slot was overwritten since they were
    sampled, and hands the rest on. With any other sampler it is TorchRL's buffer.

    A reward that is written in place (``set_``, ``set_at_``, ``update_``, ``update_if_present``,
    ``buffer["next", "reward"] = ...``) counts in the next update of its transition's priority.

    Args:
        generator: Source of all randomness of the buffer; by default a new one, seeded by
            ``torch.manual_seed``. Its state is saved with the buffer.
        **kwargs: Passed to :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        TypeError: If the sampler fuses signals and the storage keeps none, or ``generator`` is no
            generator.
        ValueError: If ``batch_size`` is not a positive integer, ``prefetch`` is not None or 0, or
            capacity or signals of sampler and storage differ; or, where signals are fused, if
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

    def __init__(self, *, generator: torch.Generator | None = None, **kwargs: Any) -> None:
        self.stale_updates = 0
        self._unreturned, self._warned = 0, False
        if (batch_size := kwargs.get("batch_size")) is not None:
            check_counts(batch_size=batch_size)
        if (prefetch := kwargs.get("prefetch")) not in (None, 0):
            raise ValueError(
                f"prefetch must be None, got {prefetch!r}: a batch that is sampled ahead knows "
                "nothing of the priorities of the update before"
            )
        if not isinstance(generator, torch.Generator | None):
            raise TypeError(f"generator must be a torch.Generator, got {generator!r}")
        # TorchRL sets it once the parts are made, which have to agree with it.
        self.priority_key = kwargs.get("priority_key", "td_error")
        super().__init__(generator=generator or seeded_generator(), **kwargs)

    def _initialize_prioritized_sampler(self) -> None:
        # As long as TorchRL can still undo what it has made: it may have put that off to this use.
        super()._initialize_prioritized_sampler()
        if self._fuses:
            self._check_priority_key(self._sampler.bind(self._storage))
            if not isinstance(self._sample_unit, Transition | None):
                raise ValueError(
                    "sample_unit must be None with a sampler that fuses signals, got "
                    f"{type(self._sample_unit).__name__}: signals belong to single transitions, "
                    "and SignalSliceSampler samples slices of them"
                )
            if self._batch_size is not None:
                self._sampler.check_batch_size(self._batch_size)
            self._storage.needs_signals = True
            self._storage.needed_keys = self._sampler.needed_keys
            self._storage.mask_keys = self._sampler.mask_keys
        if self._checks:
            self._storage.strict = True

    def _check_priority_key(self, table: SignalTable) -> None:
        if as_path(self.priority_key) in map(as_path, table.read_keys):
            raise ValueError(
                f"priority_key must not be where a reward or a signal is read, got "
                f"{self.priority_key!r}: first priorities are not stored with the transitions"
            )

    @property
    def _fuses(self) -> bool:
        # Not the attribute: the property has the parts made, where that was put off to their use.
        return isinstance(self.sampler, SignalSampler)

    @property
    def _checks(self) -> bool:
        return isinstance(self.storage, SignalStorageMixin) and not self._is_consuming()

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Write transitions, and return their slots.

        Args:
            tensordicts: Transitions, batch size ``[B]``, or ``[B, T]`` from ``B`` environments. In
                a storage of one dimension each of the latter is a row of its own, environment by
                environment.
            update_priority: As in TorchRL.

        Returns:
            Slots, shape ``[B]``; ``[B * T, 2]`` for a storage of two dimensions.

        Raises:
            KeyError: If an entry is missing or unknown; nothing is changed.
            ValueError: If an entry has another shape or dtype than in the storage, a number is not
                finite, a first priority cannot be, or there is no batch size; nothing is changed,
                in the transforms neither.
        """
        if not self._checks or not isinstance(tensordicts, TensorDictBase):
            with self._memory.at_a_write(tensordicts) as (given, _):
                return super().extend(given, update_priority=update_priority)
        if tensordicts.ndim < self._storage.ndim:
            raise ValueError(
                f"tensordicts must have a batch size of {self._storage.ndim} or more dimensions, "
                f"got {[*tensordicts.shape]}: write a single step by add(...)"
            )
        # What is made here must be of use where the caller has no inference mode.
        outside = torch.inference_mode(False), torch.no_grad()
        with outside[0], outside[1], self._memory.at_a_write(tensordicts) as (given, check):
            data = self._transform.inv(given)
            check()
            return self._extend_checked(data, update_priority is not False)

    def add(self, data: TensorDictBase) -> Any:
        """Write one transition, and return its slot.

        In a storage of several dimensions, one of each environment, batch size ``[E]``, and return
        their places, ``[E, 2]``.

        Raises:
            KeyError: See :meth:`extend`.
            ValueError: See :meth:`extend`; or if ``data`` has no dimension of environments.
        """
        if not self._checks:
            with self._memory.at_a_write(data) as (given, _):
                return super().add(given)
        if data.ndim < self.dim_extend:
            raise ValueError(
                f"data must be one step of each environment, batch size [E], got {[*data.shape]}"
            )
        # TorchRL's add would ask the new transition for learned signals, which it cannot have.
        # Where there are several environments, time comes after them.
        index = self.extend(data.unsqueeze(self.dim_extend))
        return int(index[0]) if index.shape == (1,) and index[0] >= 0 else index

    def _sample(self, batch_size: int) -> tuple[Any, dict[str, Any]]:
        data, info = super()._sample(batch_size)
        # Written here, where the batch is made: on its way out TorchRL's buffer would move each
        # entry to the device that it is on already, at a tenth of the cost of the whole call.
        if self._fuses:
            with data.unlock_() if data.is_locked else nullcontext():
                for key, value in info.items():
                    data.set(key, torch.stack(value, -1) if isinstance(value, tuple) else value)
        return data, info

    def sample(
        self,
        batch_size: int | None = None,
        return_info: bool = False,
        include_info: bool | None = None,
    ) -> Any:
        """Sample a batch, with ``index``, ``priority_weight`` and ``written_at`` in it.

        Args:
            batch_size: ``B``; by default that of the constructor.
            return_info: Whether to return the sampler's information as well.
            include_info: As in TorchRL, where it is about to go.

        Returns:
            The batch, or the batch and the information.

        Raises:
            ValueError: If ``batch_size`` is not a positive integer.

        Warns:
            UserWarning: Once, if a hundred batches in a row were sampled by priority and none was
                updated.
        """
        if batch_size is not None:
            check_counts(batch_size=batch_size)
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
            "optimization stepper do not call it; use torchrl_mpfa.trainer.PriorityStepper",
            stacklevel=3,
        )

    def update_priority(self, index: Any, priority: Any) -> None:
        """Set priorities directly, as in TorchRL."""
        super().update_priority(index, priority)
        self._unreturned = 0

    def update_tensordict_priority(self, data: TensorDictBase, *, batches: int = 1) -> None:
        """Update signals and priorities of a sampled batch.

        Args:
            data: A batch from :meth:`sample` in which the loss wrote the learned signals, each of
                shape ``[B]`` or ``[B, 1]``, under the keys that the sampler's signals name.
            batches: How many batches of one size ``data`` is, one after the other: of each, the
                positions and the mean in Eqs. (23)-(24) are its own.

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
        if self._storage.ndim == 1:
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
            fraction: How much of the training is done, from 0 to 1.
        """
        if self._fuses:
            with self._replay_lock:
                self._sampler.beta = beta
                self._sampler.anneal(fraction)

    def rewards(self) -> Tensor:
        """Rewards of all transitions, shape ``[N]``."""
        found: Tensor = self.storage.signal_table.rewards
        return found

    def distributions(self) -> dict[str, Tensor]:
        """Numbers of all transitions by name, each of shape ``[N]``.

        Each signal as it was last written (NaN where it never was), ``"priority"``, and
        ``"weight"``, the importance weight of Eq. (10) that the transition would have in a batch
        (NaN where it cannot be sampled); nothing without priorities.
        """
        sampler, size = self.sampler, len(self)
        if not isinstance(sampler, TreeSampler) or not size:
            return {}
        found = {"priority": sampler.priorities()[:size], "weight": sampler.batch_weights(size)}
        table = getattr(self.storage, "signal_table", None)
        if table is not None:
            found |= {name: table.rows[:size, column] for name, column in table.column.items()}
        return found

    def stats(self) -> dict[str, Any]:
        """TorchRL's counters, and the sampler's statistics of signals and batch."""
        with self._replay_lock:
            found: dict[str, Any] = {**super().stats(), "stale_updates": self.stale_updates}
            if self.initialized and self._fuses:
                found.update(self._sampler.stats(self._storage))
        return found

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Reject a state that does not fit, before anything changes.

        Raises:
            KeyError: If the state of a part or an entry of it is missing.
            ValueError: If a part cannot be restored from its state.
        """
        own = ("_storage", "_sampler", "_writer", "_transforms")
        batch_size = Entry(
            "_batch_size",
            lambda size: size is None or (type(size) is int and size >= 1),
            "positive or None",
        )
        check_entries("buffer", state_dict, [*map(Entry, own), batch_size, generator("_rng")])
        found = state_dict["_sampler"]
        if hasattr(self.sampler, "check_state"):
            self.sampler.check_state(found)
        elif isinstance(found, Mapping) and "_kind" in found:
            # One of TorchRL's own has no check, and would leave out what it lacks.
            raise ValueError(
                f"the saved sampler is {found['_kind']!r}, this one a {type(self.sampler).__name__}"
            )
        self._storage.check_state(state_dict["_storage"])
        # A writer of data that no one may write has no cursor, nor has its state.
        self._memory.check_state(state_dict.get(_KEPT, {}))
        if hasattr(self._writer, "_cursor"):
            slots = self._storage._max_size_along_dim0() if self._storage.ndim == 1 else None
            last = None if slots is None else slots - 1
            check_entries("writer", state_dict["_writer"], [count("_cursor", high=last)])
            if "_write_count" in state_dict["_writer"]:
                check_entries("writer", state_dict["_writer"], [count("_write_count")])

    def state_dict(self) -> dict[str, Any]:
        """All parts as TorchRL has them, and what waits in the transforms."""
        with self._replay_lock:
            return {**super().state_dict(), _KEPT: self._memory.state_dict()}

    @torch.inference_mode(False)
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore storage, signals, priorities, writer, generator, and what waits in transforms.

        Raises:
            KeyError: See :meth:`check_state`.
            ValueError: See :meth:`check_state`.
        """
        if self._checks:
            self.check_state(state_dict)
        super().load_state_dict(state_dict)
        # A state of an earlier version has none: nothing waits.
        self._memory.load_state_dict(state_dict.get(_KEPT, {}))
        self._tell_last_cursor()

    def dumps(self, path: str | Path) -> None:
        """Save in a folder, whole or not at all, with a checksum of each file.

        Raises:
            ValueError: If the data hold anything but tensors and plain values.
        """
        with new_dump(path) as folder, self._replay_lock:
            super().dumps(folder)
            # TorchRL's would be unpickled, and execute anything.
            (folder / "transform.t").unlink(missing_ok=True)
            kept = {"_transforms": self._transform.state_dict(), _KEPT: self._memory.state_dict()}
            save_atomically(kept, folder / _TRANSFORMS)
            load_safely(folder / _TRANSFORMS)

    @torch.inference_mode(False)
    def loads(self, path: str | Path) -> None:
        """Restore from a folder that :meth:`dumps` wrote, without executing anything in it.

        Raises:
            FileNotFoundError: If there is no such folder.
            KeyError: If an entry is missing; nothing is changed.
            ValueError: If a file is damaged, missing, or one that could execute something, or
                anything does not fit this buffer; nothing is changed.
        """
        folder = open_dump(path)
        for part, name in ((self.sampler, "sampler"), (self.storage, "storage")):
            if hasattr(part, "check_dump"):
                part.check_dump(folder / name)
        file = folder / _TRANSFORMS
        saved = load_safely(file) if file.exists() else {}
        self._memory.check_state(saved.get(_KEPT, {}))
        super().loads(folder)
        if "_transforms" in saved:
            self._transform.load_state_dict(saved["_transforms"])
        self._memory.load_state_dict(saved.get(_KEPT, {}))
        self._tell_last_cursor()

    def _dump_prefetch_state(self, path: Path, prefetch_state: dict[str, Any]) -> None:
        """Write nothing: TorchRL would pickle it, and what is pickled can execute anything."""

    def _load_prefetch_state(self, path: Path) -> None:
        """Read nothing: TorchRL would unpickle it."""

    def _tell_last_cursor(self) -> None:
        """Tell the storage what was written last, which TorchRL keeps no record of."""
        cursor = getattr(self._writer, "_cursor", None)
        if self._checks and cursor is not None and len(self._storage):
            around = self._storage._len_along_dim0
            self._storage._set_last_cursor((cursor - 1) % around)
