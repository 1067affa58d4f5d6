"""Compiled trees are TorchRL's to the last bit."""

import pickle
from copy import deepcopy

import pytest
import torch

from tests.mpfa.transitions import seeded
from torchrl_mpfa import native
from torchrl_mpfa.samplers.trees import CompiledTrees, PlainTrees

pytestmark = pytest.mark.skipif(native.find_loops() is None, reason="there is no C compiler")
CPU = torch.device("cpu")
ONE = torch.ones(1, dtype=torch.double)
"""Of the sum: rounding can carry a mass past the last slot."""


@pytest.mark.parametrize("capacity", [1, 15, 16, 17, 32, 33, 64, 100, 256, 257, 1000, 4097])
def test_compiled_trees_are_torchrls_to_the_last_bit(capacity):
    trees = CompiledTrees(capacity), PlainTrees(capacity, CPU)
    generator, slots = seeded(1), torch.arange(capacity)
    for count in (1, 7, 300):
        places = torch.randint(capacity, (count,), generator=generator)
        leaf = torch.rand(count, dtype=torch.double, generator=generator)
        excluded = torch.rand(count, generator=generator) < 0.2
        learned = torch.rand(count, generator=generator) < 0.5
        for tree in trees:
            tree.put(places, leaf.where(~excluded, -0.0), leaf.where(learned, -leaf))
            tree.put(places[:1], leaf[:1])  # Leaves alone.
        ours, theirs = trees
        assert ours.leaves(slots).equal(theirs.leaves(slots))
        assert ours.highest() == theirs.highest()
        for end in {*range(1, capacity, 1 + capacity // 97), capacity}:
            assert ours.sum(end) == theirs.sum(end)
            assert ours.lowest(end) == theirs.lowest(end)
        for size in (capacity, 1 + capacity // 2):
            shares = torch.cat([torch.rand(50, dtype=torch.double, generator=generator), ONE])
            (found, leaves), (expected, _) = (tree.find(shares, size) for tree in trees)
            assert found.equal(expected) and leaves.equal(theirs.leaves(found))


def test_compiled_trees_reject_slots_outside_of_them_and_take_any_precision():
    trees = CompiledTrees(3)
    for slots in ([0, 3], [-1, 0]):
        with pytest.raises(IndexError, match=r"slots must be in \[0, 3\)"):
            trees.put(torch.tensor(slots), torch.ones(2))
    assert trees.sum(3) == 0.0
    trees.put(torch.tensor([0, 2]), torch.tensor([1.5, 2.0]))
    assert trees.leaves(torch.arange(3)).tolist() == [1.5, 0.0, 2.0]
    assert trees.sum(3) == 3.5


@pytest.mark.parametrize("again", [deepcopy, lambda trees: pickle.loads(pickle.dumps(trees))])
def test_a_copy_of_compiled_trees_has_leaves_and_priorities_of_its_own(again):
    trees = CompiledTrees(20)
    trees.put(torch.arange(20), torch.rand(20), torch.rand(20))
    copied = again(trees)
    before = trees.sum(20), trees.priorities.clone()
    copied.put(torch.tensor([3]), torch.tensor([9.0]), torch.tensor([9.0]))
    assert copied.highest() == copied.priorities[3] == 9.0
    assert (trees.sum(20), trees.priorities.tolist()) == (before[0], before[1].tolist())
