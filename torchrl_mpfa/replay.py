"""A replay buffer that hands several signals, not one number, from batch to sampler."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer

from torchrl_mpfa.checks import seeded_generator
from torchrl_mpfa.sampler import SignalSampler

_UNRETURNED = 100
"""Batches in a row with signals that were not handed back, after which sampling is refused."""


class SignalReplayBuffer(TensorDictReplayBuffer):
    """:class:`~torchrl.data.TensorDictReplayBuffer` for samplers that fuse several signals.

    TorchRL's buffer reduces whatever a batch brings to one number per transition. This one reads
    each signal that the sampler fuses, drops the rows whose slot was overwritten since they were
    sampled, and hands the rest on. With any other sampler it is TorchRL's buffer.

    Args:
        generator: Source of all randomness of the buffer; by default a new one, seeded by
            ``torch.manual_seed``. Its state is saved with the buffer.
        **kwargs: Passed to :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        TypeError: If the sampler fuses signals and the storage keeps none.
        ValueError: If capacity or signals of sampler and storage differ.

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

    def __init__(self, *, generator: torch.Generator | None = None, **kwargs: Any) -> None:
        super().__init__(generator=generator or seeded_generator(), **kwargs)
        self.stale_updates = 0
        self._unreturned = 0
        self._handed_out: TensorDictBase | None = None
        if self._fuses:
            self._sampler.bind(self._storage)
            self._storage.strict = True

    @property
    def _fuses(self) -> bool:
        return isinstance(self._sampler, SignalSampler)

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Write transitions, and return their slots.

        Args:
            tensordicts: Transitions, batch size ``[B]``.
            update_priority: As in TorchRL.

        Returns:
            Slots, shape ``[B]``.

        Raises:
            KeyError: If the transitions lack a reward or signal; nothing is changed.
            ValueError: If a reward or signal is not finite or out of shape; nothing is changed.
        """
        if not self._fuses:
            return super().extend(tensordicts, update_priority=update_priority)
        writer, table = self._writer, self._storage.signal_table
        with self._replay_lock:
            place = {key: getattr(writer, key, None) for key in ("_cursor", "_write_count")}
            writes = table.writes
            try:
                return super().extend(tensordicts, update_priority=update_priority)
            except BaseException:
                # TorchRL's writer moves on before the storage can refuse, and would leave slots
                # that were never written among the filled ones.
                if table.writes == writes and place["_cursor"] is not None:
                    for key, value in place.items():
                        setattr(writer, key, value)
                raise

    def add(self, data: TensorDictBase) -> int | None:
        """Write one transition, and return its slot."""
        if not self._fuses:
            return super().add(data)
        # TorchRL's add would ask the new transition for learned signals, which it cannot have.
        index = self.extend(data.unsqueeze(0))
        return int(index[0]) if len(index) else None

    def _sample(self, batch_size: int) -> tuple[Any, dict[str, Any]]:
        data, info = super()._sample(batch_size)
        # Written here, where the batch is made: on its way out TorchRL's buffer would move each
        # entry to the device that it is on already, at a tenth of the cost of the whole call.
        if self._fuses:
            with data.unlock_():
                for key, value in info.items():
                    data.set(key, value)
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
            RuntimeError: If a loss wrote signals in the last hundred batches and none of them came
                back to :meth:`update_tensordict_priority`.
        """
        if return_info or include_info is not None or not self._fuses:
            return super().sample(batch_size, return_info, include_info)
        self._check_returned()
        self._handed_out = batch = ReplayBuffer.sample(self, batch_size)
        return batch

    def _check_returned(self) -> None:
        """Refuse to go on where a training loop keeps the signals to itself."""
        batch = self._handed_out
        learned = [s for s in self._sampler.signals if s.known_at == "update"]
        if batch is None or all(batch.get(s.key, None) is None for s in learned):
            return
        self._unreturned += 1
        if self._unreturned >= _UNRETURNED:
            raise RuntimeError(
                f"the signals of {self._unreturned} batches in a row were computed and no priority "
                "was updated: call update_tensordict_priority(batch) after the loss. A trainer of "
                "TorchRL skips it once it has an optimization stepper whose step() does not; "
                "torchrl_mpfa.trainer.PriorityStepper does"
            )

    def update_tensordict_priority(self, data: TensorDictBase) -> None:
        """Update signals and priorities of a sampled batch.

        Args:
            data: A batch from :meth:`sample` in which the loss wrote the learned signals, each of
                shape ``[B]`` or ``[B, 1]``, under the keys that the sampler's signals name.

        Raises:
            KeyError: If a signal or the index is missing; nothing is changed.
            ValueError: If a signal is negative, not finite or out of shape; nothing is changed.
        """
        if not self._fuses:
            super().update_tensordict_priority(data)
            return
        self._unreturned, self._handed_out = 0, None
        index = data.get("index", None)
        if index is None:
            raise KeyError(f"'index' is missing in the batch, got {sorted(data.keys())}")
        index = index.reshape(-1)
        signals: dict[str, Tensor] = {}
        for signal in self._sampler.signals:
            if signal.known_at == "update":
                value = data.get(signal.key, None)
                if value is None:
                    raise KeyError(
                        f"signal {signal.name!r} is missing: the batch has no {signal.key!r}"
                    )
                signals[signal.name] = value
        with self._replay_lock, self._write_lock:
            stale = self._sampler.update_signals(
                index, signals, storage=self._storage, written_at=data.get("written_at", None)
            )
        self.stale_updates += stale

    def stats(self) -> dict[str, Any]:
        """TorchRL's counters, and the sampler's statistics of signals and batch."""
        found: dict[str, Any] = {**super().stats(), "stale_updates": self.stale_updates}
        if self._fuses:
            found.update(self._sampler.stats(self._storage))
        return found

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_handed_out": None}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore storage, signals, priorities, writer and generator.

        Raises:
            KeyError: If the state has no signals; nothing is changed.
            ValueError: If format, capacity or signals differ; nothing is changed.
        """
        if self._fuses:
            self._sampler.check_state(state_dict["_sampler"])
            self._storage.check_state(state_dict["_storage"])
        super().load_state_dict(state_dict)

    def loads(self, path: str | Path) -> None:
        """Restore from a folder that :meth:`dumps` wrote.

        Raises:
            KeyError: If it has no signals; nothing is changed.
            ValueError: If format, capacity or signals differ; nothing is changed.
        """
        if self._fuses:
            self._sampler.check_dump(Path(path) / "sampler")
            self._storage.check_dump(Path(path) / "storage")
        super().loads(path)
