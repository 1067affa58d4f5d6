"""TorchRL's prioritized sampler, made safe to save, to seed and to feed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage
from torchrl.data.replay_buffers import PrioritizedSampler

from torchrl_mpfa.checks import check_finite, check_index, check_range, seeded_generator
from torchrl_mpfa.priorities import importance_weights
from torchrl_mpfa.saving import load_safely, save_atomically

_FORMAT = 1


class TreeSampler(PrioritizedSampler):
    r"""Proportional sampling from segment trees, Eqs. (8) and (10).

    The same draws and weights as :class:`~torchrl.data.replay_buffers.PrioritizedSampler`, with
    its sharp edges taken off: the highest priority in the buffer costs O(log N) in place of
    O(N); draws come from a generator that ``torch.manual_seed`` reaches and that is saved;
    a negative or infinite priority is refused where it enters; a saved state holds tensors and
    numbers only, and one that does not fit is refused before anything changes.

    Args:
        max_capacity: Capacity of the storage ``N``.
        alpha: Priority exponent :math:`\alpha` of Eq. (8); 0 samples uniformly.
        beta: Importance exponent :math:`\beta` of Eq. (10).
        eps: :math:`\epsilon` of Eq. (9).
        dtype: Type of the tree, as in TorchRL; only single precision works there.
        reduction: As in TorchRL.
        max_priority_within_buffer: Whether a fresh transition gets the highest priority *in the
            buffer*; if false, the highest ever seen.
        device: Device of the trees; TorchRL's published wheels have those of the CPU alone.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> sampler = TreeSampler(1000, 0.6, 0.4)
        >>> sampler.default_priority
        1.0
    """

    _rng: torch.Generator | None

    def __init__(
        self,
        max_capacity: int,
        alpha: float,
        beta: float,
        eps: float = 1e-8,
        dtype: torch.dtype = torch.float,
        reduction: str = "max",
        max_priority_within_buffer: bool = False,
        device: torch.device | str | None = "cpu",
    ) -> None:
        check_range("max_capacity", max_capacity, low=1)
        for name, value in (("alpha", alpha), ("beta", beta), ("eps", eps)):
            check_range(name, value, low=0)
        super().__init__(
            max_capacity, alpha, beta, eps, dtype, reduction, max_priority_within_buffer, device
        )

    def _init(self) -> None:
        super()._init()
        # TorchRL finds the highest priority in the buffer by reading every leaf. A minimum tree
        # over the negated priorities has it at its root.
        self._max_tree = type(self._min_tree)(self._max_capacity)
        self._highest: float | None = None
        self._highest_slot: int | None = None

    @property
    def _max_priority(self) -> tuple[float | None, int | None]:
        """Highest priority without eps, and the slot that has or had it: TorchRL's bookkeeping."""
        highest = self._highest_priority()
        if highest is None:
            return None, None
        if not self._max_priority_within_buffer:
            return max(highest - self._eps, 0.0), self._highest_slot
        leaves = -self._max_tree[torch.arange(self._max_capacity)]
        slot = int((leaves == highest).long().argmax()) if bool((leaves == highest).any()) else None
        return max(highest - self._eps, 0.0), slot

    @_max_priority.setter
    def _max_priority(self, value: tuple[float | None, int | None] | None) -> None:
        highest, slot = (None, None) if value is None else value
        self._highest = None if highest is None else float(highest) + self._eps
        self._highest_slot = slot

    def _highest_priority(self) -> float | None:
        """Highest priority, eps included; None if nothing was written."""
        # With alpha = 0 all leaves are alike, and TorchRL keeps the highest ever seen.
        if self._max_priority_within_buffer and self._alpha > 0:
            highest = -self._max_tree.query(0, self._max_capacity)
            return None if highest < 0 else float(highest)
        return self._highest

    @property
    def default_priority(self) -> float:
        """Priority of a fresh transition before eps and alpha: the highest one, 1 at first."""
        highest = self._highest_priority()
        return 1.0 if highest is None else max(highest - self._eps, 0.0)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Draw slots by Eq. (8), with the weights of Eq. (10).

        Args:
            storage: The storage to sample from.
            batch_size: ``B``.

        Returns:
            Slots, shape ``[B]``, and ``{"priority_weight": ...}``, shape ``[B]``.

        Raises:
            RuntimeError: If the storage is empty.
        """
        if self._rng is None:
            # TorchRL would fall back on NumPy's global generator, which torch.manual_seed
            # does not reach.
            self._rng = seeded_generator()
        size = len(storage)
        if size == 0:
            raise RuntimeError("cannot sample from an empty buffer: len(storage) is 0")
        index, weight = self._draw(size, batch_size)
        return index, {"priority_weight": weight}

    def _draw(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        """Slots and their weights, each of shape ``[B]``, out of the first ``size`` slots."""
        total, lowest = self._sum_tree.query(0, size), self._min_tree.query(0, size)
        if not (total > 0 and lowest > 0):
            raise RuntimeError(
                f"every priority must be positive to sample, got a sum of {total} and a lowest "
                f"of {lowest}: raise eps, or give the buffer its sampler before its data"
            )
        index = self._proportional(self._sum_tree, size, batch_size)
        # Of one slot the tree gives a bare number, of several a tensor.
        leaf = torch.as_tensor(self._sum_tree[index]).reshape(-1)
        return index, importance_weights(leaf, beta=self._beta, lowest=lowest)

    def _proportional(self, tree: Any, size: int, batch_size: int) -> Tensor:
        """Slots drawn in proportion to the leaves of a tree of sums, shape ``[B]``."""
        mass = torch.rand(batch_size, generator=self._rng) * tree.query(0, size)
        index = torch.as_tensor(tree.scan_lower_bound(mass)).reshape(-1)
        # Rounding can carry the last bit of mass past the last slot.
        return index.clamp_max_(size - 1)

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Give fresh transitions the highest priority."""
        highest = self._highest_priority()
        priority = 1.0 + self._eps if highest is None else highest
        slots = torch.as_tensor(index, dtype=torch.long).reshape(-1)
        slots = check_index(slots, self._max_capacity)
        if len(slots):
            self._write(slots, torch.full(slots.shape, priority))

    def add(self, index: Tensor | int) -> None:
        """Nothing to do: the tree of highest priorities forgets an overwritten slot by itself."""

    def extend(self, index: Tensor | tuple[Any, ...]) -> None:
        """Nothing to do, as for :meth:`add`."""

    @torch.no_grad()
    def update_priority(
        self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None
    ) -> None:
        """Set priorities directly, as TorchRL's sampler does: neither fused nor adjusted.

        Args:
            index: Slots, shape ``[B]``; -1 is skipped.
            priority: Priorities before eps and alpha, shape ``[B]``, ``[B, 1]`` or ``[]``.
            storage: Not used.

        Raises:
            IndexError: If a slot is outside the buffer.
            RuntimeError: If ``priority`` has not one number a slot.
            ValueError: If a priority is negative or not finite.
        """
        slots = torch.as_tensor(index, dtype=torch.long, device="cpu")
        if slots.ndim > 1:
            raise RuntimeError(f"index must have one dimension, got shape {[*slots.shape]}")
        slots = slots.reshape(-1)
        value = torch.as_tensor(priority, device="cpu").detach()
        if value.numel() not in (1, slots.numel()):
            raise RuntimeError(
                "priority should be a number or an iterable of the same length as index. Got "
                f"priority of shape {value.shape} and index {slots.shape}."
            )
        value = value.to(self.dtype).reshape(-1).expand(slots.shape)
        check_finite("priority", value)
        kept = check_index(slots, self._max_capacity)
        if len(kept) == 0:
            return
        self._write(kept, (value if len(kept) == len(slots) else value[slots >= 0]) + self._eps)

    def _write(self, index: Tensor, priority: Tensor) -> None:
        """Write priorities, eps included, to the trees."""
        leaf = self._leaf(priority)
        self._sum_tree[index] = leaf
        self._min_tree[index] = leaf
        self._max_tree[index] = -priority
        highest = -self._max_tree.query(0, self._max_capacity)
        if self._highest is None or highest > self._highest:
            self._highest, self._highest_slot = highest, int(index[priority.argmax()])

    def _leaf(self, priority: Tensor) -> Tensor:
        """What slots are drawn in proportion to, priorities to the power of alpha, ``[B]``."""
        return priority.pow(self._alpha)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batches depend on; tensors and plain values only."""
        slots = torch.arange(self._max_capacity)
        return {
            "_schema_version": self._STATE_SCHEMA_VERSION,
            "_format": _FORMAT,
            "_max_capacity": self._max_capacity,
            "_alpha": float(self._alpha),
            "_beta": float(self._beta),
            "_eps": float(self._eps),
            "_max_priority": self._max_priority,
            "_highest": self._highest,
            "_highest_slot": self._highest_slot,
            "_sum_tree": torch.as_tensor(self._sum_tree[slots]).clone(),
            "_min_tree": torch.as_tensor(self._min_tree[slots]).clone(),
            "_max_tree": torch.as_tensor(self._max_tree[slots]).clone(),
        }

    def check_state(self, state_dict: dict[str, Any]) -> None:
        """Refuse a state that does not fit, before anything changes.

        Raises:
            ValueError: If format or capacity differ.
        """
        if (found := state_dict.get("_format")) != _FORMAT:
            raise ValueError(f"format of the saved sampler is {found}, this version has {_FORMAT}")
        if (found := state_dict["_max_capacity"]) != self._max_capacity:
            raise ValueError(
                f"max_capacity of the saved sampler is {found}, of this one {self._max_capacity}"
            )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        self.check_state(state_dict)
        self._init()
        self._alpha = state_dict["_alpha"]
        self._beta = state_dict["_beta"]
        self._eps = state_dict["_eps"]
        self._highest = state_dict["_highest"]
        self._highest_slot = state_dict["_highest_slot"]
        # Leaves that were never written hold what the tree takes for nothing; only the others
        # are written back, and inner nodes follow from the leaves alone.
        written = (state_dict["_max_tree"] <= 0).nonzero().squeeze(1)
        if len(written):
            for name in ("_sum_tree", "_min_tree", "_max_tree"):
                getattr(self, name)[written] = state_dict[name][written]

    def dumps(self, path: str | Path) -> None:
        """Save in a folder: everything in one file, and beside it what a person can read."""
        path = Path(path).absolute()
        path.mkdir(exist_ok=True)
        state = self.state_dict()
        save_atomically(state, path / "sampler.pt")
        plain = {key: value for key, value in state.items() if not isinstance(value, Tensor)}
        text = json.dumps(plain, indent=2)
        (path / "sampler_metadata.json").write_text(text, encoding="utf-8")

    def check_dump(self, path: str | Path) -> dict[str, Any]:
        """Read a saved sampler and refuse it as :meth:`check_state` does."""
        state: dict[str, Any] = load_safely(Path(path) / "sampler.pt")
        self.check_state(state)
        return state

    def loads(self, path: str | Path) -> None:
        """Restore from a folder.

        Raises:
            ValueError: See :meth:`check_state`.
        """
        self.load_state_dict(self.check_dump(path))
