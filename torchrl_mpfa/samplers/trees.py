"""Leaves and priorities of all slots, and the sums, lowest and highest of them.

A leaf is a priority to the power of alpha: its slot is sampled in proportion to it. A leaf of -0.0
cannot be sampled, and is no lowest one. A priority has a negative sign until it was learned, and
then is no highest one. Three kinds of trees do the same: in C, TorchRL's, and on a GPU none.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers.prioritized import MinSegmentTreeFp64, SumSegmentTreeFp64

from torchrl_mpfa.native import address, find_loops, is_plain, loops, opaque

_WIDE = 16
"""Children of a node of compiled trees, also in ``replay.c``."""
_MOST = torch.finfo(torch.double).max
"""The lowest of no leaves, as in TorchRL."""
_SUM, _LOWEST, _HIGHEST = range(3)


def make_trees(capacity: int, device: torch.device) -> CompiledTrees | PlainTrees:
    """Return trees without leaves: compiled ones on the CPU, where a compiler was found."""
    if device.type == "cpu" and find_loops() is not None:
        return CompiledTrees(capacity)
    return PlainTrees(capacity, device)


class CompiledTrees:
    """Trees whose loops are compiled, equal to TorchRL's to the last bit.

    Args:
        capacity: Number of slots ``N``.

    Examples:
        >>> trees = CompiledTrees(3) if find_loops() else PlainTrees(3, torch.device("cpu"))
        >>> leaf = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> trees.put(torch.tensor([0, 2]), leaf, priority=leaf)
        >>> float(trees.sum(3)), float(trees.lowest(3)), float(trees.highest())
        (3.0, 1.0, 2.0)
        >>> trees.find(torch.tensor([0.3, 0.4], dtype=torch.double), 3)[0].tolist()
        [0, 2]
    """

    compiled = True
    waits = False

    @torch.inference_mode(False)
    def __init__(self, capacity: int) -> None:
        self._size = capacity
        self._leaf = _filled(-0.0, capacity)
        self._priority = _filled(torch.nan, capacity)
        # Of each level the sums, then the lowest and the highest, until one node is left.
        levels: list[Tensor] = []
        count = capacity
        while not levels or count > 1:
            count = -(-count // _WIDE)
            levels += [_filled(0.0, count), _filled(_MOST, count), _filled(_MOST, count)]
        self._nodes = torch.cat(levels)

    @property
    def priorities(self) -> Tensor:
        """Priorities, negative if never learned, NaN if never written, shape ``[N]``."""
        return self._priority[: self._size]

    def leaves(self, slots: Tensor) -> Tensor:
        """Return leaves of slots, shape ``[B]``."""
        return self._leaf.index_select(0, slots)

    @opaque
    def put(self, slots: Tensor, leaf: Tensor, priority: Tensor | None = None) -> None:
        """Set leaves of slots, and their priorities where these are given, each ``[B]``."""
        count, slots, leaf = slots.numel(), slots.contiguous(), _numbers(leaf)
        priority = None if priority is None else _numbers(priority)
        given = leaf.data_ptr(), None if priority is None else priority.data_ptr()
        if loops().put(*self._memory(), self._size, address(slots, torch.long), *given, count):
            raise IndexError(f"slots must be in [0, {self._size}), got {slots.tolist()}")

    @opaque
    def find(self, shares: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """Return the slots at shares of the sum of the first leaves, and their leaves, ``[B]``."""
        slots = torch.empty(shares.shape, dtype=torch.long, device="cpu")
        leaves = torch.empty_like(shares)
        leaf, _, nodes = self._memory()
        asked = min(size, self._size), address(shares, torch.double), shares.numel()
        loops().find(leaf, nodes, self._size, *asked, slots.data_ptr(), leaves.data_ptr())
        return slots, leaves

    def sum(self, size: int) -> float:
        """Return the sum of the first leaves."""
        return self._query(_SUM, size)

    def lowest(self, size: int) -> float:
        """Return the lowest of the first leaves."""
        return self._query(_LOWEST, size)

    def highest(self) -> float:
        """Return the highest priority that was learned; negative if none was."""
        return -self._query(_HIGHEST, self._size)

    @opaque
    def _query(self, kind: int, size: int) -> float:
        """Return what the root has of the first leaves."""
        return loops().query(*self._memory(), kind, self._size, size)

    def _memory(self) -> tuple[int, int, int]:
        """Return addresses, which change where memory becomes shared."""
        return self._leaf.data_ptr(), self._priority.data_ptr(), self._nodes.data_ptr()


def _numbers(values: Tensor) -> Tensor:
    """Return values as C reads them."""
    fits = values.dtype is torch.double and is_plain(values)
    return values if fits else values.to("cpu", torch.double).resolve_neg().contiguous()


def _filled(number: float, count: int) -> Tensor:
    """Return so many times a number, and more up to whole nodes."""
    size = -(-count // _WIDE) * _WIDE
    return torch.full((size,), number, dtype=torch.double, device="cpu")


class PlainTrees:
    """TorchRL's trees on the CPU; on other devices leaves, which are passed over.

    A GPU takes as long to start a kernel as to pass over some hundred thousand numbers, and a tree
    over a million slots asks for several kernels on each of its twenty levels.

    Args:
        capacity: Number of slots ``N``.
        device: Where they are.
    """

    compiled = False

    @torch.inference_mode(False)
    def __init__(self, capacity: int, device: torch.device) -> None:
        self._size = capacity
        self.waits = device.type != "cpu"
        """True if the host waits for a device that it asks for a number."""
        self.priorities = torch.full((capacity,), torch.nan, dtype=torch.double, device=device)
        """Priorities, negative if never learned, NaN if never written, shape ``[N]``."""
        if self.waits:
            self._sums: Any = SumLeaves(capacity, device)
            self._lows, self._highs = (MinLeaves(capacity, device) for _ in range(2))
        else:
            self._sums = SumSegmentTreeFp64(capacity)
            self._lows, self._highs = (MinSegmentTreeFp64(capacity) for _ in range(2))

    def leaves(self, slots: Tensor) -> Tensor:
        """Return leaves of slots, shape ``[B]``."""
        if self.waits:
            return self._sums[slots]
        # Given a tensor, the binding first tries it as a number, and spends ten times as long on
        # the error as on the leaves. Of an array it reads the memory from the start.
        return torch.from_numpy(self._sums[slots.contiguous().numpy()])

    def put(self, slots: Tensor, leaf: Tensor, priority: Tensor | None = None) -> None:
        """Set leaves of slots, and their priorities where these are given, each ``[B]``."""
        leaf = leaf.double()
        self._set(self._sums, slots, leaf)
        self._set(self._lows, slots, leaf.where(~leaf.signbit(), _MOST))
        if priority is not None:
            priority = priority.double()
            self.priorities.index_copy_(0, slots, priority)
            learned = is_learned(priority)
            self._set(self._highs, slots, -priority.where(learned, -_MOST))

    def _set(self, tree: Any, slots: Tensor, leaf: Tensor) -> None:
        """Set leaves of one tree; of a repeated slot the last one counts."""
        if self.waits:
            tree[slots] = leaf
        else:
            tree[slots.contiguous().numpy()] = leaf.contiguous().numpy()

    def find(self, shares: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """Return the slots at shares of the sum of the first leaves, and their leaves, ``[B]``."""
        slots = self._sums.scan_lower_bound(shares * self._sums.query(0, size))
        # Rounding can carry the last bit of mass past the last slot.
        slots = slots.clamp_max_(min(size, self._size) - 1)
        return slots, self.leaves(slots)

    def sum(self, size: int) -> Any:
        """Return the sum of the first leaves; on a GPU of shape ``[]``."""
        return self._sums.query(0, size)

    def lowest(self, size: int) -> Any:
        """Return the lowest of the first leaves; on a GPU of shape ``[]``."""
        return self._lows.query(0, size)

    def highest(self) -> Any:
        """Return the highest priority that was learned, negative if none was."""
        return -self._highs.query(0, self._size)


class ReadTree:
    """The tree of sums or of minima, as far as TorchRL reads it.

    Args:
        trees: Trees of all kinds.
        minimum: True for that of minima.
    """

    def __init__(self, trees: CompiledTrees | PlainTrees, *, minimum: bool) -> None:
        self._trees, self._minimum = trees, minimum

    def __getitem__(self, slots: Any) -> Tensor:
        slots = torch.as_tensor(slots).reshape(-1)
        leaves = self._trees.leaves(slots)
        if not self._minimum:
            return leaves
        # TorchRL's tree of sums has 0.0 where nothing was written.
        empty = leaves.signbit() | self._trees.priorities[slots].isnan()
        return leaves.masked_fill(empty, _MOST)

    def query(self, start: int, end: int) -> Any:
        """Return the sum or minimum of the leaves from ``start``, which is 0, to before ``end``."""
        if start:
            raise ValueError(f"start must be 0, got {start}: sum up the leaves of the slots")
        return self._trees.lowest(end) if self._minimum else self._trees.sum(end)


class HasTrees:
    """A sampler whose trees scripts read by TorchRL's own names."""

    trees: Any

    @property
    def _sum_tree(self) -> ReadTree:
        return ReadTree(self.trees, minimum=False)

    @property
    def _min_tree(self) -> ReadTree:
        return ReadTree(self.trees, minimum=True)


def is_learned(priorities: Tensor) -> Tensor:
    """Return True where a priority was learned, shape ``[B]``."""
    return (priorities >= 0) & ~priorities.signbit()


class SumLeaves:
    """Leaves on a GPU in place of TorchRL's tree of sums, with its interface.

    Examples:
        >>> tree = SumLeaves(3, torch.device("cpu"))
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> tree.query(0, 3), tree.scan_lower_bound(torch.tensor([0.5, 1.5], dtype=torch.double))
        (tensor(3., dtype=torch.float64), tensor([0, 2]))
    """

    EMPTY = -0.0

    def __init__(self, capacity: int, device: torch.device) -> None:
        self._leaves = torch.full((capacity,), self.EMPTY, dtype=torch.double, device=device)

    def __getitem__(self, slots: Tensor) -> Tensor:
        return self._leaves.index_select(0, slots)

    def __setitem__(self, slots: Tensor, leaf: Tensor) -> None:
        self._leaves.index_copy_(0, slots, leaf)

    def query(self, start: int, end: int) -> Tensor:
        """Return the sum of the leaves from ``start`` to before ``end``, shape ``[]``."""
        return self._leaves[start:end].sum()

    def scan_lower_bound(self, mass: Tensor) -> Tensor:
        """Return the first slots up to which the leaves sum to more than a mass, shape ``[B]``."""
        sums = self._leaves.cumsum(0)
        # Rounded otherwise than query(), the mass may be past the last slot that has a leaf.
        most = torch.nextafter(sums[-1], sums.new_zeros(()))
        return torch.searchsorted(sums, mass.minimum(most), right=True)


class MinLeaves(SumLeaves):
    """Leaves on a GPU in place of TorchRL's tree of minima, with its interface.

    Examples:
        >>> tree = MinLeaves(3, torch.device("cpu"))
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> tree.query(1, 3)
        tensor(2., dtype=torch.float64)
    """

    EMPTY = _MOST

    def query(self, start: int, end: int) -> Tensor:
        """Return the lowest leaf from ``start`` to before ``end``, shape ``[]``."""
        return self._leaves[start:end].amin()
