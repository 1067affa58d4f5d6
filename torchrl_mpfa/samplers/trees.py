"""Slots and leaves: slots in TorchRL's forms, and their leaves in segment trees or flat arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import is_tensor_collection
from torch import Tensor
from torchrl.data import Storage
from torchrl.data.replay_buffers.samplers.prioritized import MinSegmentTreeFp64, SumSegmentTreeFp64

from torchrl_mpfa.native import address, find_loops, loops, opaque
from torchrl_mpfa.storages.schema import as_integers

_ORDERED = 2048
"""Rows up to which writing by index keeps their order."""
_BLOCK = 16
"""Leaves that share the lowest node of a compiled tree, also in ``replay.c``."""


class CompiledTree:
    """A segment tree whose loops are compiled, with the interface of TorchRL's but for tensors.

    Sums and minima are the same as there to the last bit.

    Args:
        capacity: Number of slots ``N``.
        nodes: Where the nodes are, with those of other trees beside them; by default alone.
        column: Place among the other trees.
    """

    EMPTY: float
    """Leaf of a slot that was never written."""
    MINIMUM: bool

    @torch.inference_mode(False)
    def __init__(self, capacity: int, nodes: Tensor | None = None, column: int = 0) -> None:
        self.size, self.blocks = capacity, _blocks(capacity)
        self.nodes = _nodes(capacity, 1) if nodes is None else nodes
        self._column = column
        self.nodes[:, column] = self.EMPTY

    @property
    def _place(self) -> tuple[int, int, int]:
        """Address of the first node, numbers from node to node, and blocks of leaves."""
        start = address(self.nodes, torch.double) + 8 * self._column
        return start, self.nodes.shape[1], self.blocks

    @property
    def priorities(self) -> Tensor:
        """Priorities beside the leaves of three trees, a view, shape ``[N]``."""
        first = 2 * self.blocks
        return self.nodes[first : first + self.size, 3]

    def __getitem__(self, slots: Tensor) -> Tensor:
        return self.nodes.select(1, self._column)[slots + 2 * self.blocks]

    @opaque
    def __setitem__(self, slots: Tensor, leaf: Tensor) -> None:
        slots, leaf = slots.contiguous(), leaf.double().expand(slots.shape).contiguous()
        batch = address(slots, torch.long), address(leaf, torch.double), slots.numel()
        if loops().set_leaves(*self._place, self.MINIMUM, self.size, *batch):
            raise IndexError(f"slots must be in [0, {self.size}), got {slots.tolist()}")

    @opaque
    def query(self, start: int, end: int) -> float:
        """Return the sum or minimum of the leaves from ``start`` to before ``end``."""
        result: float = loops().query(*self._place, self.MINIMUM, self.size, start, end)
        return result


class SumTree(CompiledTree):
    """A segment tree of sums.

    Examples:
        >>> tree = SumTree(3) if find_loops() else SumLeaves(3)
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> float(tree.query(0, 3))
        3.0
    """

    EMPTY, MINIMUM = 0.0, False

    @opaque
    def put(self, slots: Tensor, leaf: Tensor, priority: Tensor, *, learned: bool) -> None:
        """Set leaves and priorities of slots in this and the two trees beside it, each ``[B]``."""
        nodes, slots = address(self.nodes, torch.double), slots.contiguous()
        leaf, priority = (v.double().expand(slots.shape).contiguous() for v in (leaf, priority))
        values = address(leaf, torch.double), address(priority, torch.double)
        place = nodes, self.blocks, self.size, address(slots, torch.long)
        if loops().put(*place, *values, learned, slots.numel()):
            raise IndexError(f"slots must be in [0, {self.size}), got {slots.tolist()}")

    @opaque
    def slots_at(self, shares: Tensor, size: int) -> Tensor:
        """Return the slots at shares of the sum of the first slots, shape ``[B]``."""
        slots = torch.empty(shares.shape, dtype=torch.long, device="cpu")
        batch = address(shares, torch.double), shares.numel(), address(slots, torch.long)
        loops().find(*self._place, self.size, size, *batch)
        return slots


class MinTree(CompiledTree):
    """A segment tree of minima."""

    EMPTY, MINIMUM = torch.finfo(torch.double).max, True


class Leaves:
    """Leaves of all slots, with the interface of TorchRL's segment trees but for an ``end``.

    They take the place of the trees on devices other than the CPU, and pass over all leaves. A GPU
    takes as long to start a kernel as to pass over some hundred thousand numbers, and a tree over
    a million slots asks for several kernels on each of its twenty levels.
    """

    EMPTY: float
    """Leaf of a slot that was never written."""

    def __init__(self, capacity: int, device: torch.device | str = "cpu") -> None:
        self._leaves = torch.full((capacity,), self.EMPTY, dtype=torch.double, device=device)

    def __getitem__(self, slots: Tensor) -> Tensor:
        return self._leaves.index_select(0, slots)

    def __setitem__(self, slots: Tensor, leaf: Tensor) -> None:
        self._leaves.index_copy_(0, slots, leaf)


class SumLeaves(Leaves):
    """Leaves in place of a tree of sums.

    Examples:
        >>> tree = SumLeaves(3)
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> tree.query(0, 3), tree.scan_lower_bound(torch.tensor([0.5, 1.5], dtype=torch.double))
        (tensor(3., dtype=torch.float64), tensor([0, 2]))
    """

    EMPTY = 0.0

    def query(self, start: int, end: int) -> Tensor:
        """Return the sum of the leaves from ``start`` to before ``end``, shape ``[]``."""
        return self._leaves[start:end].sum()

    def scan_lower_bound(self, mass: Tensor) -> Tensor:
        """Return the first slots up to which the leaves sum to more than a mass, shape ``[B]``."""
        sums = self._leaves.cumsum(0)
        # Rounded otherwise than query(), the mass may be past the last slot that has a leaf.
        most = torch.nextafter(sums[-1], sums.new_zeros(()))
        return torch.searchsorted(sums, mass.minimum(most), right=True)


class MinLeaves(Leaves):
    """Leaves in place of a tree of minima.

    Examples:
        >>> tree = MinLeaves(3)
        >>> tree[torch.tensor([0, 2])] = torch.tensor([1.0, 2.0], dtype=torch.double)
        >>> tree.query(1, 3)
        tensor(2., dtype=torch.float64)
    """

    EMPTY = torch.finfo(torch.double).max

    def query(self, start: int, end: int) -> Tensor:
        """Return the lowest leaf from ``start`` to before ``end``, shape ``[]``."""
        return self._leaves[start:end].amin()


def make_trees(capacity: int, device: torch.device) -> tuple[list[Any], Tensor | None]:
    """Return empty trees of sums, minima and minima, and priorities, NaN, shape ``[N]``.

    The priorities are None where compiled trees have them.
    """
    if device.type == "cpu" and find_loops() is not None:
        # Side by side: two children of a node are one line of the processor's cache.
        nodes, kinds = _nodes(capacity, 4), enumerate((SumTree, MinTree, MinTree))
        return [kind(capacity, nodes, n) for n, kind in kinds], None
    trees: list[Any]
    if device.type == "cpu":
        trees = [kind(capacity) for kind in (SumSegmentTreeFp64, *(MinSegmentTreeFp64,) * 2)]
    else:
        trees = [kind(capacity, device) for kind in (SumLeaves, MinLeaves, MinLeaves)]
    return trees, torch.full((capacity,), torch.nan, dtype=torch.double, device=device)


def _blocks(capacity: int) -> int:
    """Return the smallest power of two of blocks of leaves that hold so many slots."""
    return 1 << ((capacity - 1) // _BLOCK).bit_length()


def _nodes(capacity: int, trees: int) -> Tensor:
    """Return room for trees, NaN: for their nodes down to blocks, then for all leaves."""
    count = 2 * _blocks(capacity) + -(-capacity // _BLOCK) * _BLOCK
    return torch.full((count, trees), torch.nan, dtype=torch.double, device="cpu")


def empty_tree_like(tree: Any, capacity: int, device: torch.device) -> Any:
    """Return an empty tree of the same kind, with a leaf for each of ``capacity`` slots."""
    return type(tree)(capacity, *((device,) if isinstance(tree, Leaves) else ()))


def in_dimensions_of(storage: Storage, slots: Tensor) -> Any:
    """Unravel flat slots into TorchRL's index: a tuple for several dimensions, else the slots."""
    if getattr(storage, "ndim", 1) == 1:
        return slots
    return torch.unravel_index(slots, storage.shape)


def as_slots(index: Any, storage: Any = None) -> Tensor:
    """Return flat slots ``[B]`` of slots, of places ``[B, D]``, or of a tuple of ``D`` places."""
    if isinstance(index, tuple):
        index = torch.stack([as_integers(places).reshape(-1) for places in index], -1)
    if isinstance(index, Tensor) and index.dtype is torch.long and index.ndim == 1:
        return index.resolve_neg()
    slots = as_integers(index)
    if slots.ndim <= 1 or len(slots) == 0:
        return slots.reshape(-1)
    # Not the filled part of it: a batch may be from before the storage was emptied.
    shape = getattr(storage, "_total_shape", None)
    if shape is None or len(shape) < 2 or len(shape) != slots.shape[-1]:
        raise RuntimeError(
            f"index must have one dimension, or one place for each dimension of a storage, got "
            f"shape {[*slots.shape]} for a storage of shape {None if shape is None else [*shape]}"
        )
    places = slots.reshape(-1, len(shape))
    # TorchRL's writers mark with -1 what was not stored.
    skipped = (places == -1).all(-1)
    wrong = ((places < 0) | (places >= places.new_tensor(shape))).any(-1) & ~skipped
    if bool(wrong.any()):
        raise IndexError(
            f"index must be within the storage's shape {[*shape]}, got {places[wrong][0].tolist()}"
        )
    slots = places[:, 0]
    for dimension in range(1, len(shape)):
        slots = slots * shape[dimension] + places[:, dimension]
    return torch.where(skipped, -1, slots)


def last_of_each(slots: Tensor) -> Tensor | None:
    """Return the last position of each slot, by slot, shape ``[U]``, or None if order is kept.

    A slot that is written twice keeps its last value, which index writes of many rows do not
    ensure. On devices other than the CPU the result is the last position of the slot at each
    position, ``[B]``: the host does not wait for the number of slots.
    """
    if not slots.is_cpu:
        ordered, position = slots.sort(stable=True)
        return position[torch.searchsorted(ordered, slots, right=True) - 1]
    count = slots.numel()
    if count <= _ORDERED:
        return None
    # One number for slot and position, as sorting numbers costs half of what unique() does.
    width = count.bit_length()
    both = (slots.numpy() << width) + np.arange(count)
    both.sort()
    slot = both >> width
    last = np.append(slot[1:] != slot[:-1], True)
    return None if last.all() else torch.from_numpy(both[last] & ((1 << width) - 1))


def leaves_of(tree: Any, slots: Tensor) -> Tensor:
    """Return the leaves of slots, shape ``[B]``."""
    if isinstance(tree, Leaves | CompiledTree):
        return tree[slots]
    # Given a tensor, the binding first tries it as a number, and spends ten times as long on the
    # error as on the leaves. Of an array it reads the memory from the start, without strides.
    return torch.from_numpy(tree[slots.contiguous().numpy()])


def put_leaves(
    trees: tuple[Any, Any, Any],
    apart: Tensor | None,
    slots: Tensor,
    leaf: Tensor,
    priority: Tensor,
    *,
    learned: bool,
) -> None:
    """Write leaves to trees of :func:`make_trees`, and their priorities, each ``[B]``."""
    if apart is None:
        trees[0].put(slots, leaf, priority, learned=learned)
        return
    apart.index_copy_(0, slots, priority)
    set_leaves(slots, leaf, *trees[:2])
    set_leaves(slots, -priority if learned else torch.full_like(priority, torch.inf), trees[2])


def set_leaves(slots: Tensor, leaf: Tensor, *trees: Any) -> None:
    """Write leaves of slots, shape ``[B]``; the last leaf of a repeated slot counts."""
    takes_tensors = isinstance(trees[0], Leaves | CompiledTree)
    places = slots if takes_tensors else slots.contiguous().numpy()
    values = leaf if takes_tensors else leaf.contiguous().numpy()
    for tree in trees:
        tree[places] = values


class Steps:
    """Stored transitions by their flat slots, an entry at a time."""

    def __init__(self, storage: Any, slots: Tensor) -> None:
        self._slots, self._ndim = slots, storage.ndim
        stored = storage._storage
        self._stored = stored if is_tensor_collection(stored) else {}

    def get(self, key: Any, default: Any = None) -> Any:
        """Return an entry of the transitions, shape ``[B, ...]``."""
        entry = self._stored.get(key, None)
        if entry is None:
            return default
        return entry.flatten(0, self._ndim - 1)[self._slots.to(entry.device)]


def random_shares(count: int, *, stratified: bool, **random: Any) -> Tensor:
    """Sample shares in [0, 1), from all of it or from each of so many equal parts, ``[B]``."""
    shares = torch.rand(count, dtype=torch.double, **random)
    if not stratified:
        return shares
    # In random order: in a batch sorted by slot, a place would depend on the age.
    return shares.add_(torch.randperm(count, **random)).div_(count)


def slots_at(shares: Tensor, tree: Any, size: int) -> Tensor:
    """Return the slots at shares of the sum of a tree, which become masses in place, ``[B]``."""
    if isinstance(tree, SumTree):
        return tree.slots_at(shares, size)
    slots: Tensor = tree.scan_lower_bound(shares.mul_(tree.query(0, size)))
    # Rounding can carry the last bit of mass past the last slot.
    return slots.clamp_max_(size - 1)
