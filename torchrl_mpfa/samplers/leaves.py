"""What samplers ask of segment trees, by passes over all leaves: for devices other than the CPU.

A GPU takes as long to start a kernel as to pass over some hundred thousand numbers, and a tree over
a million slots asks for several kernels on each of its twenty levels.
"""

from __future__ import annotations

import torch
from torch import Tensor


class Leaves:
    """Leaves of all slots, with the interface of TorchRL's segment trees but for an ``end``.

    Args:
        capacity: Number of slots.
        device: Device of the leaves, and of all that goes in and comes out.
    """

    EMPTY: float
    """Leaf of a slot that nothing was written to."""

    def __init__(self, capacity: int, device: torch.device | str = "cpu") -> None:
        self._leaves = torch.full((capacity,), self.EMPTY, dtype=torch.double, device=device)

    def __getitem__(self, slots: Tensor) -> Tensor:
        return self._leaves.index_select(0, slots)

    def __setitem__(self, slots: Tensor, leaf: Tensor) -> None:
        self._leaves.index_copy_(0, slots, leaf)


class SumLeaves(Leaves):
    """In place of a tree of sums.

    Examples:
        >>> tree = SumLeaves(3)
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> tree.query(0, 3), tree.scan_lower_bound(torch.tensor([0.5, 1.5], dtype=torch.double))
        (tensor(3., dtype=torch.float64), tensor([0, 2]))
    """

    EMPTY = 0.0

    def query(self, start: int, end: int) -> Tensor:
        """Sum of the leaves from ``start`` to before ``end``, shape ``[]``."""
        return self._leaves[start:end].sum()

    def scan_lower_bound(self, mass: Tensor) -> Tensor:
        """First slot of which the leaves up to it sum to more than a mass, shape ``[B]``."""
        sums = self._leaves.cumsum(0)
        # Rounded otherwise than query(), the mass may be past the last slot that has a leaf.
        most = torch.nextafter(sums[-1], sums.new_zeros(()))
        return torch.searchsorted(sums, mass.minimum(most), right=True)


class MinLeaves(Leaves):
    """In place of a tree of minima.

    Examples:
        >>> tree = MinLeaves(3)
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> tree.query(1, 3)
        tensor(2., dtype=torch.float64)
    """

    EMPTY = torch.finfo(torch.double).max

    def query(self, start: int, end: int) -> Tensor:
        """Lowest of the leaves from ``start`` to before ``end``, shape ``[]``."""
        return self._leaves[start:end].amin()
