"""Slices of trajectories, sampled by the fused priorities of their steps."""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.checks import as_mask, check_counts, check_index, unknown
from torchrl_mpfa.episodes import follows
from torchrl_mpfa.samplers.fused import SignalSampler
from torchrl_mpfa.samplers.slots import as_slots
from torchrl_mpfa.saving import check_saved
from torchrl_mpfa.storages.entries import as_path

SlicePriority = Literal["mean", "start"]
"""Priority of a slice: the mean over its steps, or that of its first step."""
_TRAJ_IDS = ("collector", "traj_ids")
_SETTINGS = ("slice_len", "slice_priority", "strict_length")
"""Arguments that a saved sampler must have been made with."""
_AT_ONCE = 65_536
"""Slices that are looked at in one pass, which bounds the memory that this takes."""


class SignalSliceSampler(SignalSampler):
    r"""Slices of trajectories, sampled in proportion to priorities that are fused from signals.

    :class:`SignalSampler` for recurrent networks, with the words of TorchRL's
    :class:`~torchrl.data.replay_buffers.PrioritizedSliceSampler`. Each step has its signals and
    its priority, as without slices: the loss writes signals for every step of a batch, and
    fusion and adjustments work on them. Eqs. (8) and (10) then hold for slices, whose priority is
    that of R2D2 without its maximum, or of TorchRL::

        mean     p_i = (p'_i + ... + p'_(i+L-1)) / L
        start    p_i = p'_i

    A slice of a storage ``[T, E]`` is of one environment. None has steps of two trajectories, and
    none joins the newest steps of a full buffer to the oldest: such a start has the probability 0.
    A step follows another one if it was written right after it, has the same number of a
    trajectory, and begins with what that one ended with: ``"observation"`` with ``("next",
    "observation")``, and so all that steps have before and after. Where they have nothing so, what
    is written after a load follows nothing of before.

    Kapturowski et al. (2019), https://openreview.net/forum?id=r1lyTjAqYX

    Args:
        *args: As :class:`SignalSampler`, in its order.
        slice_len: Steps ``L`` of a slice. A batch has ``batch_size / L`` slices.
        slice_priority: ``"mean"`` or ``"start"``, as above.
        strict_length: True to sample only slices of ``L`` steps; false to sample shorter ones, too,
            which begin closer than that to the end of a trajectory.
        end_key: Where the last step of a trajectory is marked.
        traj_key: Number of the trajectory of each step: a slice also ends where it changes. By
            default that of TorchRL's collectors, ``("collector", "traj_ids")``, where it is stored.
        truncated_key: Where the batch marks the last step of each slice, ``[B, 1]``, as well as
            under ``"done"`` next to it, for estimators of values; None: nowhere.
        **kwargs: As :class:`SignalSampler`.

    Raises:
        ValueError: If an argument is out of its range, or the storage is not on the CPU.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_mpfa import SignalReplayBuffer, SignalTensorStorage
        >>> buffer = SignalReplayBuffer(
        ...     storage=SignalTensorStorage(100, ndim=2),
        ...     sampler=SignalSliceSampler(100, 0.6, 0.4, slice_len=4),
        ...     batch_size=8,
        ... )
        >>> step = torch.arange(10.0).expand(2, 10).unsqueeze(-1)  # [environments, steps, 1]
        >>> after = {"reward": step, "done": step == 5}
        >>> index = buffer.extend(TensorDict({"step": step, "next": after}, [2, 10]))
        >>> slices = buffer.sample().reshape(2, 4)
        >>> slices["step"].diff(dim=1).unique().tolist()
        [1.0]
        >>> slices["next", "truncated"].squeeze(-1).tolist()[0]
        [False, False, False, True]
    """

    KIND = "slices"
    READS_ROWS = True
    SAVED = (*SignalSampler.SAVED, *_SETTINGS, "_joined", "_stride")

    def __init__(
        self,
        *args: Any,
        slice_len: int,
        slice_priority: SlicePriority = "mean",
        strict_length: bool = True,
        end_key: NestedKey = ("next", "done"),
        traj_key: NestedKey | None = None,
        truncated_key: NestedKey | None = ("next", "truncated"),
        **kwargs: Any,
    ) -> None:
        if slice_priority not in get_args(SlicePriority):
            raise ValueError(unknown("slice_priority", slice_priority, get_args(SlicePriority)))
        self.slice_len: int = check_counts(slice_len=slice_len)
        self.slice_priority: SlicePriority = slice_priority
        self.strict_length = strict_length
        self.end_key, self.traj_key = end_key, traj_key
        self.truncated_key = truncated_key
        super().__init__(*args, **kwargs)

    def _init(self) -> None:
        if self.slice_len > self._max_capacity and not self._takes_capacity:
            raise ValueError(
                f"slice_len must be at most max_capacity, {self._max_capacity}, got "
                f"{self.slice_len}"
            )
        if self.device.type != "cpu":
            raise ValueError(f"device must be that of a storage on the CPU, got {self.device}")
        super()._init()
        # True if the step one stride after a slot is the next of its trajectory.
        self._joined = torch.zeros(self._max_capacity, dtype=torch.bool, device="cpu")
        self._stride = 1
        self._lengths = torch.empty(0, dtype=torch.long, device="cpu")

    def check_new(self, data: Any, count: int) -> Tensor:
        """See :meth:`SignalSampler.check_new`; ends and numbers of trajectories must be there."""
        for key in (self.end_key, *([] if self.traj_key is None else [self.traj_key])):
            if data.get(key, None) is None:
                raise KeyError(f"the transitions lack {key!r}, which the sampler reads")
        for key in (self.end_key, *([] if self.truncated_key is None else [self._done_key])):
            if (mask := data.get(key, None)) is not None:
                as_mask(repr(key), mask)
        return super().check_new(data, count)

    @property
    def _done_key(self) -> NestedKey:
        """Key under which a batch marks the last step of each slice as an end of any kind."""
        return (*as_path(self.truncated_key or "")[:-1], "done")

    @property
    def divisible(self) -> bool:
        """See :attr:`TreeSampler.divisible`."""
        return super().divisible and self.strict_length

    def check_batch_size(self, batch_size: int) -> None:
        """Reject a batch that is not of whole slices."""
        super().check_batch_size(batch_size)
        if batch_size % self.slice_len:
            raise ValueError(
                f"batch_size must be a multiple of slice_len, {self.slice_len}, got {batch_size}"
            )

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[Any, Tensor]]:
        """Sample slices by Eq. (8), one after the other, and count a replay for each step.

        Args:
            storage: The storage to sample from.
            batch_size: ``B``, a multiple of the length of a slice.

        Returns:
            As :meth:`SignalSampler.sample`, with an entry for each step, ``B`` of them with
            ``strict_length``; the steps of a slice share its ``"priority_weight"``.

        Raises:
            RuntimeError: If no trajectory in the storage is as long as a slice.
            ValueError: If ``batch_size`` is not of whole slices.
        """
        index, info = super().sample(storage, batch_size)
        if self.truncated_key is None:
            return index, info
        last = torch.zeros(int(self._lengths.sum()), 1, dtype=torch.bool, device="cpu")
        last[self._lengths.cumsum(0) - 1] = True
        done = _column(storage, self._done_key, as_slots(index, storage), default=last).bool()
        return index, {**info, self.truncated_key: last, self._done_key: last | done}

    def _sampled(self, storage: Storage, batch_size: int) -> tuple[Tensor, Tensor]:
        self.check_batch_size(batch_size)
        size = len(storage)
        if size and self.trees.sum(size) == 0:
            raise RuntimeError(
                f"no trajectory in the buffer has {self.slice_len} steps that follow each other: "
                f"write longer ones, with {self.end_key!r} true only where one ends; those of "
                "several environments go to a storage with ndim=2"
            )
        starts, weight = super()._sampled(storage, batch_size // self.slice_len)
        slots, inside = self._windows(starts)
        self._lengths = inside.sum(1)
        return slots[inside], weight.repeat_interleave(self._lengths)

    def _proportional(self, trees: Any, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        starts, leaf = super()._proportional(trees, size, batch_size)
        # Rounding can end at a leaf of 0 next to the right one.
        while len(wrong := (leaf == 0).nonzero().squeeze(1)):
            starts[wrong], leaf[wrong] = super()._proportional(trees, size, len(wrong))
        return starts, leaf

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Give new steps the highest priority, and record where trajectories end.

        Raises:
            ValueError: If there is no storage, where the ends are read.
        """
        if storage is None:
            raise ValueError("storage must be given, as it says where trajectories end, got None")
        super().mark_update(index, storage=storage)
        if self.slice_priority == "start":  # Slices that begin before these steps have changed too.
            slots = check_index(as_slots(index, storage), self._max_capacity)
            self._refresh(self._starts_around(slots))

    def _record(self, slots: Tensor, storage: Storage | None) -> None:
        super()._record(slots, storage)
        for part in slots.split(_AT_ONCE):
            self._join(part, storage)

    def _join(self, slots: Tensor, storage: Any) -> None:
        """Find the slots, and those before them, that the next step of a trajectory follows."""
        table = self.table
        shape = getattr(storage, "_total_shape", None) if storage.ndim > 1 else None
        self._stride = 1 if shape is None else math.prod(shape[1:])
        slots = torch.cat([slots - self._stride, slots]) % self._max_capacity
        following = (slots + self._stride) % self._max_capacity
        # Of times of writing: what follows was written with or right after this, not a round ago.
        times = table.rows[:, table.time_column]
        joined = times[following] - times[slots] == self._stride
        joined &= ~_column(storage, self.end_key, slots).bool().squeeze(1)
        key = _TRAJ_IDS if self.traj_key is None else self.traj_key
        one = torch.zeros(len(slots), 1, dtype=torch.bool, device="cpu")
        ids = [_column(storage, key, places, default=one) for places in (slots, following)]
        joined &= (ids[0] == ids[1]).squeeze(1) & follows(storage, table, slots, following)
        self._joined[slots] = joined

    def _windows(self, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slots of slices and the mask of one trajectory, both ``[S, L]``."""
        slots = starts.unsqueeze(1) + self._stride * torch.arange(self.slice_len, device="cpu")
        slots %= self._max_capacity
        inside = torch.ones(slots.shape, dtype=torch.bool, device="cpu")
        inside[:, 1:] = self._joined[slots[:, :-1]].cumprod(1).bool()
        return slots, inside

    def _starts_around(self, slots: Tensor) -> Tensor:
        """Return the starts of all slices that can hold these slots, shape ``[S]``."""
        if len(slots) * self.slice_len >= self._max_capacity:
            return torch.arange(self._max_capacity, device="cpu")
        starts = slots.unsqueeze(1) - self._stride * torch.arange(self.slice_len, device="cpu")
        return (starts % self._max_capacity).unique()

    def _follow(self, slots: Tensor, leaf: Tensor) -> None:
        # In place of the leaves of steps those of the slices that the steps are in.
        self._refresh(self._starts_around(slots) if self.slice_priority == "mean" else slots)

    def _refresh(self, starts: Tensor) -> None:
        """Write the present leaves of slices, by their starts, shape ``[S]``."""
        priorities = self.priorities()
        starts = starts[priorities[starts].isfinite()]
        for part in starts.split(_AT_ONCE):
            slots, inside = self._windows(part)
            length = inside.sum(1)
            full = (length == self.slice_len) | (not self.strict_length)
            priority = priorities[part]
            if self.slice_priority == "mean":
                priority = priorities[slots].where(inside, 0.0).sum(1) / length
            # What cannot be sampled is not the lowest.
            self.trees.put(part, self._leaf(priority).where(full, -0.0))

    def _restore(self, state: dict[str, Any]) -> None:
        check_saved("sampler", state, **{name: getattr(self, name) for name in _SETTINGS})
        super()._restore(state)
        if type(self._stride) is not int or self._stride < 1 or self._max_capacity % self._stride:
            raise ValueError(
                f"'_stride' of the saved sampler must be a divisor of {self._max_capacity}, got "
                f"{self._stride!r}"
            )


def _column(
    storage: Any, key: NestedKey, slots: Tensor, *, default: Tensor | None = None
) -> Tensor:
    """Return an entry of stored steps on the CPU, ``[B, 1]``; of several numbers the highest."""
    entry = storage._storage.get(key, None)
    if entry is None:
        if default is None:
            raise KeyError(f"the transitions have no {key!r}, which says where trajectories end")
        return default
    chosen: Tensor = entry.flatten(0, storage.ndim - 1)[slots.to(entry.device)]
    return chosen.reshape(len(slots), -1).amax(1, keepdim=True).cpu()
