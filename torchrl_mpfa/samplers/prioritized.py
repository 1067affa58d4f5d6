"""TorchRL's prioritized sampler, made safe to save, to seed and to feed."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage

from torchrl_mpfa.checks import (
    NOT_NEGATIVE,
    bounds,
    check,
    check_counts,
    check_index,
    check_not_negative,
    generator_on,
    seeded_generator,
)
from torchrl_mpfa.priorities import importance_weights
from torchrl_mpfa.samplers.slots import as_slots, in_dimensions_of, last_of_each, random_shares
from torchrl_mpfa.samplers.states import SavedTrees
from torchrl_mpfa.samplers.trees import HasTrees, is_learned, make_trees

_LOG_LARGEST = math.log(torch.finfo(torch.double).max) - 1.0
_LOG_POSITIVE = math.log(1e-200)
"""A leaf with a logarithm above this is not rounded to zero by any sampler."""
_CPU = torch.device("cpu")
_ALPHA = NOT_NEGATIVE[0], "greater or equal to 0 and finite"  # As TorchRL says it.


class TreeSampler(HasTrees, SavedTrees):
    r"""Proportional sampling from segment trees, Eqs. (8) and (10).

    The batches and weights of :class:`~torchrl.data.replay_buffers.PrioritizedSampler`, with
    these differences: it samples in double precision, as single precision is not enough for
    a million slots; the highest priority in the buffer costs O(log N) instead of O(N); randomness
    comes from a generator that ``torch.manual_seed`` reaches and that is saved; a priority that is
    negative or not finite is rejected where it enters; a saved state holds tensors and numbers
    only, and a state that does not fit changes nothing.

    Args:
        max_capacity: Capacity of the storage ``N``; None: that of the storage that is used first.
        alpha: Priority exponent :math:`\alpha` of Eq. (8); 0 samples uniformly.
        beta: Importance exponent :math:`\beta` of Eq. (10).
        eps: :math:`\epsilon` of Eq. (9).
        dtype: Type of the importance weights, single or double precision. The trees are in double
            precision.
        reduction: As in TorchRL.
        max_priority_within_buffer: True to give a fresh transition the highest priority that an
            update gave to a transition *in the buffer*; false to give it the highest ever.
        device: Device of priorities and sampled slots; by default that of the storage. On devices
            other than the CPU, passes over all priorities take the place of segment trees.
        stratified: True to sample one slot from each of ``B`` equal parts of the total priority, as
            the PER paper does, in place of ``B`` independent ones.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = TreeSampler(1000, 0.6, 0.4)
        >>> sampler.default_priority
        1.0
    """

    _rng: torch.Generator | None
    _device: torch.device | None

    @torch.inference_mode(False)
    def __init__(
        self,
        max_capacity: int | None,
        alpha: float,
        beta: float,
        eps: float = 1e-8,
        dtype: torch.dtype = torch.float,
        reduction: str = "max",
        max_priority_within_buffer: bool = False,
        device: torch.device | str | None = None,
        *,
        stratified: bool = False,
    ) -> None:
        # Until a storage is known there is one slot.
        self._takes_capacity = max_capacity is None
        capacity = 1 if max_capacity is None else max_capacity
        capacity = check_counts(max_capacity=capacity)
        alpha = check(_ALPHA, alpha=alpha)
        beta, eps = check(NOT_NEGATIVE, beta=beta, eps=eps)
        if dtype not in (torch.float, torch.double):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.stratified = stratified
        self._weight_dtype = dtype
        self._follows = device is None
        # With its number, as storages have it.
        where = None if device is None else torch.empty(0, device=device).device
        rest = dtype, reduction, max_priority_within_buffer, where
        super().__init__(capacity, float(alpha), float(beta), float(eps), *rest)

    def _init(self) -> None:
        # TorchRL finds the highest priority in the buffer by reading every leaf; here it is at a
        # root. It leaves out fresh transitions: they would hand on the highest priority that they
        # were given, and one outlier would stay.
        self.trees = make_trees(self._max_capacity, self.device)
        self._highest: float | None = None
        self._highest_slot: int | None = None
        # True on a GPU while all priorities are surely positive, so that sampling need not wait.
        self._positive = False

    @property
    def device(self) -> torch.device:
        """Device of priorities and sampled slots."""
        return self._device or torch.device("cpu")

    def _maybe_init_from_storage(self, storage: Storage | None) -> None:
        """Take the capacity of a storage and move to its device, once they are known."""
        if self._takes_capacity and storage is not None:
            self._takes_capacity = False
            self._resize(storage.max_size)
        device = getattr(storage, "device", None)
        if device == (self._device or _CPU) or not isinstance(device, torch.device):
            return
        if not self._follows:
            raise ValueError(
                f"device must be that of the storage, {device}, or None, got {self.device}"
            )
        state, self._device = self.state_dict(), device
        self.load_state_dict(state)

    @torch.inference_mode(False)
    def _resize(self, capacity: int) -> None:
        """Begin with empty trees of another capacity."""
        self._max_capacity = capacity
        self._init()

    @property
    def alpha(self) -> float:
        r"""Priority exponent :math:`\alpha` of Eq. (8); a new value changes all leaves.

        A value that is negative or not finite, or by which priorities vanish or overflow, is
        rejected, and changes nothing.
        """
        return self._alpha

    @alpha.setter
    def alpha(self, value: float) -> None:
        value = float(check(_ALPHA, alpha=value))
        self._check_alpha(value)
        before, self._alpha = self._alpha, value
        if value != before:
            self._retransform_priority_trees(before, value)

    def _check_alpha(self, value: float) -> None:
        """Reject an exponent by which priorities vanish or overflow."""
        written = self.priorities()
        written = written[written > 0]
        before, self._alpha = self._alpha, value
        leaf = self._leaf(written)
        self._alpha = before
        if not (leaf.sum() < math.inf and leaf.reciprocal().sum() < math.inf):
            raise ValueError(
                f"alpha must leave the priorities, from {written.min():g} to {written.max():g}, "
                f"positive and of a finite sum, got {value}"
            )

    @property
    def beta(self) -> float:
        r"""Importance exponent :math:`\beta` of Eq. (10), finite and not negative."""
        return self._beta

    @beta.setter
    def beta(self, value: float) -> None:
        self._beta = float(check(NOT_NEGATIVE, beta=value))

    @property
    def _max_priority(self) -> tuple[float | None, int | None]:
        """Return the highest priority without eps and its slot, as TorchRL's sampler has them."""
        highest = self._highest_priority()
        if highest is None:
            return None, None
        if not self._max_priority_within_buffer or self._alpha == 0:
            return max(highest - self._eps, 0.0), self._highest_slot
        return max(highest - self._eps, 0.0), int(self.trees.priorities.nan_to_num(-1.0).argmax())

    @_max_priority.setter
    def _max_priority(self, value: tuple[float | None, int | None] | None) -> None:
        highest, slot = (None, None) if value is None else value
        self._highest = None if highest is None else float(highest) + self._eps
        self._highest_slot = slot

    def _highest_priority(self) -> float | None:
        """Return the highest priority, eps included; None before the first update."""
        # With alpha = 0 all slots are sampled alike, and TorchRL keeps the highest ever seen.
        if self._max_priority_within_buffer and self._alpha > 0:
            highest = float(self.trees.highest())
            return None if highest < 0 else highest
        return self._highest

    @property
    def default_priority(self) -> float:
        """Priority of a fresh transition before eps and alpha: the highest one, 1 at first."""
        highest = self._highest_priority()
        return 1.0 if highest is None else max(highest - self._eps, 0.0)

    def priorities(self, index: Tensor | None = None) -> Tensor:
        """Return priorities of slots, by default all, in double precision, shape ``[B]``.

        They include eps and precede alpha, and are NaN where nothing was written.
        """
        kept = self.trees.priorities
        return (kept if index is None else kept[as_slots(index)]).abs()

    @property
    def divisible(self) -> bool:
        """True if ``U * B`` slots, sampled at once, are as good as ``U`` batches of ``B``."""
        return not self.stratified

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict[str, Tensor]]:
        """Sample slots by Eq. (8), with the weights of Eq. (10).

        Args:
            storage: The storage to sample from.
            batch_size: ``B``.

        Returns:
            Slots ``[B]``, or a tuple of places for several dimensions; and
            ``{"priority_weight": ...}``, shape ``[B]``.

        Raises:
            RuntimeError: If the storage is empty.
            ValueError: If ``batch_size`` is not positive.
        """
        slots, weight = self._sampled(storage, batch_size)
        return in_dimensions_of(storage, slots), {"priority_weight": weight}

    def _sampled(self, storage: Storage, batch_size: int) -> tuple[Tensor, Tensor]:
        """Sample slots of the flattened storage and their weights, both of shape ``[B]``."""
        slots, weight = self._sample_slots(self._filled(storage, batch_size), batch_size)
        return slots, weight.to(self.dtype)

    def _filled(self, storage: Storage, batch_size: int) -> int:
        """Return the number of slots that a batch can be sampled from."""
        self._maybe_init_from_storage(storage)
        if self._rng is None:
            # TorchRL would fall back on NumPy's global generator, which torch.manual_seed
            # does not reach.
            self._rng = seeded_generator()
        if type(batch_size) is not int or batch_size < 1:
            check_counts(batch_size=batch_size)
        size = len(storage)
        if size == 0:
            raise RuntimeError("cannot sample from an empty buffer: len(storage) is 0")
        return size

    def _sample_slots(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        """Sample out of the first ``size`` slots: slots and weights, both of shape ``[B]``."""
        lowest = self.trees.lowest(size)
        if not self._positive:
            self._check_positive(self.trees.sum(size), lowest)
            # A GPU is waited for once, and again after a priority that may be too low.
            self._positive = self.trees.waits
        index, leaf = self._proportional(self.trees, size, batch_size)
        return index, importance_weights(leaf, beta=self._beta, lowest=lowest)

    @staticmethod
    def _check_positive(total: Any, lowest: Any) -> None:
        """Reject slots of which none can be sampled, or one has no priority."""
        if not bool((total > 0) & (lowest > 0)):
            raise RuntimeError(
                f"every priority must be positive to sample, got a sum of {total} and a lowest "
                f"of {lowest}: raise eps, or give the buffer its sampler before its data"
            )

    def batch_weights(self, size: int) -> Tensor:
        """Return the weight of Eq. (10) that each of the first slots would have in a batch.

        Args:
            size: Number of slots ``N``, all of them filled.

        Returns:
            Weights, in double precision, shape ``[N]``; NaN where a slot cannot be sampled.

        Examples:
            >>> sampler = TreeSampler(2, 1.0, 1.0, eps=0.0)
            >>> sampler.update_priority([0, 1], torch.tensor([1.0, 2.0]))
            >>> sampler.batch_weights(2).tolist()
            [1.0, 0.5]
        """
        leaf = self.trees.leaves(torch.arange(size, device=self.device))
        weight = importance_weights(leaf, beta=self._beta, lowest=self.trees.lowest(size))
        return torch.where(leaf > 0, weight, torch.nan)

    def _uniform(self, size: int, batch_size: int) -> Tensor:
        """Sample slots uniformly, shape ``[B]``."""
        if self.stratified:
            return self._mass(batch_size).mul_(size).long().clamp_max_(size - 1)
        return torch.randint(size, (batch_size,), **self._random())

    def _proportional(self, trees: Any, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        """Sample slots in proportion to the leaves of trees; slots and leaves, both ``[B]``."""
        slots, leaf = trees.find(self._mass(batch_size), size)
        return slots, leaf

    def _mass(self, batch_size: int) -> Tensor:
        """Sample shares of the total priority to look up, in [0, 1), shape ``[B]``."""
        return random_shares(batch_size, stratified=self.stratified, **self._random())

    def _random(self) -> dict[str, Any]:
        """Return the device, and a generator on it for the random numbers of one call."""
        return {"device": self.device, "generator": generator_on(self.device, self._rng)}

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Give fresh transitions the highest priority, or raise as :meth:`update_priority`."""
        self._maybe_init_from_storage(storage)
        slots = check_index(as_slots(index, storage), self._max_capacity)
        if slots.numel():
            self._mark(slots.to(self.device))

    def _mark(self, slots: Tensor) -> None:
        """Give the transitions in slots the highest priority."""
        priority = self._fresh_priority()
        if self._highest is None:
            self._keep_highest(float(priority), int(slots[0]))
        fresh = slots.new_empty(slots.shape, dtype=torch.double).fill_(priority)
        self._write(slots, fresh, learned=False)

    def _fresh_priority(self) -> float | Tensor:
        """Return the priority of a fresh transition, eps included; a GPU is not waited for."""
        first = 1.0 + self._eps
        within = self._max_priority_within_buffer and self._alpha
        if self.trees.waits and within:
            highest = self.trees.highest()
            return highest.where(highest >= 0, first)
        priority = self._highest_priority()
        return first if priority is None else priority

    def extend(self, index: Any) -> None:
        """Nothing to do: the tree of highest priorities forgets an overwritten slot by itself."""

    add = extend

    @torch.no_grad()
    def update_priority(
        self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None
    ) -> None:
        """Set priorities directly, as TorchRL's sampler does: neither fused nor adjusted.

        Args:
            index: Slots ``[B]``, or places in ``D`` dimensions ``[B, D]``; -1 is skipped.
            priority: Priorities before eps and alpha, shape ``[B]``, ``[B, 1]`` or ``[]``.
            storage: The storage, for places in several dimensions.

        Raises:
            IndexError: If a slot is outside the buffer.
            TypeError: If the index holds anything but integers.
            RuntimeError: If ``priority`` has not one number a slot.
            ValueError: If a priority is negative or not finite, or so high that sums overflow.
        """
        self._maybe_init_from_storage(storage)
        slots = as_slots(index, storage).to(self.device)
        value = torch.as_tensor(priority, device=self.device).detach().resolve_neg()
        if value.numel() not in (1, slots.numel()):
            raise RuntimeError(
                "priority should be a number or an iterable of the same length as index. Got "
                f"priority of shape {value.shape} and index {slots.shape}."
            )
        value = value.to(torch.double).reshape(-1).expand(slots.shape)
        stored = check_index(slots, self._max_capacity)
        if len(stored) == 0:
            return
        value = value if len(stored) == len(slots) else value[slots >= 0]
        check_not_negative("priority", value)
        highest = self._checked(value + self._eps)
        if (last := last_of_each(stored)) is not None:
            stored, value = stored[last], value[last]
        inherited, value = self._inherited(stored, value), value + self._eps
        if bool(inherited.any()):
            self._write(stored[inherited], value[inherited], learned=False)
            stored, value = stored[~inherited], value[~inherited]
        if len(stored):
            self._set(stored, value, highest)

    def check_priority(self, priority: Tensor) -> None:
        """Reject priorities of new transitions, before eps, as :meth:`update_priority`."""
        check_not_negative("priority", priority)
        self._checked(priority.to(torch.double) + self._eps)

    def _inherited(self, slots: Tensor, value: Tensor) -> Tensor:
        """Mask of rows that only get the highest priority, as fresh ones have, shape ``[B]``.

        TorchRL's buffers read ``default_priority``, and hand it on in single precision, for
        transitions that they find in a storage, and for batches without a priority.
        """
        fresh = ~is_learned(self.trees.priorities[slots])
        return fresh & (value.float() == torch.tensor(self.default_priority, device="cpu").float())

    def _checked(self, priority: Tensor, name: str = "priority") -> float:
        """Return the highest of priorities, eps included; reject those that poison a tree."""
        low, high = bounds(priority)
        if not (low >= 0 and high < math.inf):
            check_not_negative(name, priority)
        self._positive &= low > 0 and self._alpha * math.log(low) > _LOG_POSITIVE
        if high > 0 and self._alpha * math.log(high) + math.log(self._max_capacity) > _LOG_LARGEST:
            raise ValueError(f"priority must not be so high that sums overflow, got {high}")
        return high

    def _set(self, slots: Tensor, priority: Tensor, highest: float) -> None:
        """Write priorities that an update gave, eps included, of which this is the highest."""
        self._write(slots, priority, learned=True)
        if self._highest is None or highest > self._highest:
            stored = self.priorities(slots)  # Of a slot that is named twice the last one.
            self._keep_highest(float(stored.max()), int(slots[stored.argmax()]))

    def _keep_highest(self, highest: float, slot: int) -> None:
        """Keep a priority and its slot if none was as high so far."""
        if self._highest is None or highest > self._highest:
            self._highest, self._highest_slot = highest, slot

    def _write(self, slots: Tensor, priority: Tensor, *, learned: bool) -> None:
        """Write priorities, eps included, to the trees; slots as by :func:`last_of_each`."""
        leaf = self._leaf(priority)
        self.trees.put(slots, leaf, priority if learned else -priority)
        self._follow(slots, leaf)

    def _write_leaves(self, slots: Tensor, leaf: Tensor) -> None:
        """Write leaves, to which slots are sampled in proportion, shape ``[B]``."""
        self.trees.put(slots, leaf)
        self._follow(slots, leaf)

    def _follow(self, slots: Tensor, leaf: Tensor) -> None:
        """Change what depends on leaves that were written: nothing here."""

    def _leaf(self, priority: Tensor) -> Tensor:
        """Return leaves, priorities to the power of alpha, shape ``[B]``."""
        return priority.pow(self._alpha)

    def _retransform_priority_trees(self, old_alpha: float, new_alpha: float) -> None:
        """Follow a new alpha; unlike TorchRL's, exact, and from 0 as well."""
        slots = self._known()
        if len(slots):
            self._write_leaves(slots, self._leaf(self.priorities(slots)))

    def _known(self) -> Tensor:
        """Return the slots that have a priority, shape ``[B]``."""
        return self.trees.priorities.isfinite().nonzero().squeeze(1)
