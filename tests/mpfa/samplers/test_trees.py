"""Passes over all leaves give what TorchRL's segment trees give."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data.replay_buffers.samplers.prioritized import MinSegmentTreeFp64, SumSegmentTreeFp64

from benchmarks.paper.methods.mw import MWSampler
from tests.mpfa.second_device import DEVICE, SecondDevice, use_leaves
from tests.mpfa.transitions import make_buffer, make_transitions, train_rounds
from torchrl_mpfa import MPFASampler, SignalTensorStorage
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.samplers.trees import MinLeaves, SumLeaves, last_of_each, leaves_of, set_leaves

MASSES = torch.linspace(0.0, 1.0, 101, dtype=torch.double)[:-1]


def assert_found_alike(tree, leaves, capacity):
    """The same slots for the same masses, but where a mass is the sum up to a slot."""
    total = tree.query(0, capacity)
    mass = MASSES * total
    found, expected = leaves.scan_lower_bound(mass), tree.scan_lower_bound(mass)
    sums = leaves_of(leaves, torch.arange(capacity)).cumsum(0)
    tie = (sums[:, None] - mass).abs().amin(0) <= 1e-12 * total
    assert bool(((found == expected) | tie | (mass == 0)).all())
    assert bool((leaves_of(leaves, found) > 0).all())


WRITES = st.lists(
    st.lists(st.tuples(st.floats(0, 1), st.sampled_from([0.0, 1e-9, 0.3, 1.0, 7.5, 1e9]))),
    max_size=6,
)


@settings(max_examples=150, deadline=None)
@given(capacity=st.integers(1, 70), writes=WRITES)
def test_after_any_writes_sums_minima_and_slots_are_those_of_the_trees(capacity, writes):
    trees = SumSegmentTreeFp64(capacity), MinSegmentTreeFp64(capacity)
    flat = SumLeaves(capacity), MinLeaves(capacity)
    for rows in filter(None, writes):
        # Slots that come twice, too.
        slots = torch.tensor([min(int(place * capacity), capacity - 1) for place, _ in rows])
        leaf = torch.tensor([leaf for _, leaf in rows], dtype=torch.double)
        set_leaves(slots, leaf, *trees)
        set_leaves(slots, leaf, *flat)
    for tree, leaves in zip(trees, flat, strict=True):
        slots = torch.arange(capacity)
        assert torch.equal(leaves_of(tree, slots), leaves_of(leaves, slots))
        for end in range(1, capacity + 1):
            found, expected = leaves.query(0, end), tree.query(0, end)
            assert float(found) == pytest.approx(expected, rel=2e-15, abs=0.0)
    if trees[0].query(0, capacity) > 0:
        assert_found_alike(trees[0], flat[0], capacity)


@pytest.mark.parametrize("leaf", [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.1, 0.2, 0.0, 0.7, 0.0]])
def test_a_slot_without_a_leaf_is_not_found_even_from_both_ends(leaf):
    tree = SumLeaves(len(leaf))
    tree[torch.arange(len(leaf))] = torch.tensor(leaf, dtype=torch.double)
    total = float(tree.query(0, len(leaf)))
    ends = torch.tensor([0.0, total, total * (1 + 1e-15)], dtype=torch.double)
    assert bool((tree[tree.scan_lower_bound(ends)] > 0).all())


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 6), min_size=1, max_size=40))
def test_of_a_slot_that_is_written_twice_the_last_position_counts(places):
    slots = torch.tensor(places)
    expected = [max(p for p, each in enumerate(slots) if each == slot) for slot in slots]
    with SecondDevice():
        assert last_of_each(slots.to(DEVICE)).tolist() == expected


MADE = {
    "mpfa": MPFASampler,
    "stratified": lambda capacity: MPFASampler(capacity, stratified=True),
    "rank": lambda capacity: RankPERSampler(capacity, 0.7, 0.5, signals=["td_error"]),
    "la3p": lambda capacity: LA3PSampler(capacity, 0.4, 0.0, 0.1, signals=["td_error"]),
    "mw": lambda capacity: MWSampler(capacity, 0.6, 0.4, signals=["td_error"], replay_cap=6),
}


@pytest.mark.parametrize("kind", MADE)
def test_training_samples_the_same_batches_from_leaves_as_from_trees(kind, monkeypatch):
    sampled = []
    for leaves in (False, True):
        with monkeypatch.context() as patched:
            if leaves:
                use_leaves(patched)
            storage = SignalTensorStorage(37)
            buffer = make_buffer(37, 8, storage=storage, sampler=MADE[kind](37))
            assert isinstance(buffer.sampler._sum_tree, SumLeaves) == leaves
            for count in (20, 17, 9):
                buffer.extend(make_transitions(count, seed=count))
                sampled.append(train_rounds(buffer, 20, seed=count))
    first, second = torch.stack(sampled[:3]), torch.stack(sampled[3:])
    assert torch.equal(first[..., :8], second[..., :8])
    torch.testing.assert_close(first, second, rtol=1e-6, atol=0.0)
