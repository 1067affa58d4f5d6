"""Trees in C, TorchRL's and leaves without trees find, add up and keep the same."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.paper.methods.mw import MWSampler
from tests.mpfa.second_device import DEVICE, SecondDevice, make_leaves, use_leaves
from tests.mpfa.transitions import make_buffer, make_transitions, train_rounds
from torchrl_mpfa import MPFASampler, SignalTensorStorage
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.samplers.slots import last_of_each
from torchrl_mpfa.samplers.trees import PlainTrees, SumLeaves

CPU = torch.device("cpu")

WRITES = st.lists(
    st.lists(
        st.tuples(
            st.floats(0, 1), st.sampled_from([-0.0, 0.0, 1e-9, 0.3, 1.0, 7.5, 1e9]), st.booleans()
        )
    ),
    max_size=6,
)


def written(trees, capacity, writes):
    """Write leaves, and priorities of which some were learned; slots may come twice."""
    for rows in filter(None, writes):
        slots = torch.tensor([min(int(place * capacity), capacity - 1) for place, *_ in rows])
        leaf = torch.tensor([leaf for _, leaf, _ in rows], dtype=torch.double)
        signs = torch.tensor([1.0 if learned else -1.0 for *_, learned in rows])
        trees.put(slots, leaf, (leaf.abs() + 0.5) * signs)
    return trees


@settings(max_examples=150, deadline=None)
@given(capacity=st.integers(1, 70), writes=WRITES)
def test_after_any_writes_leaves_alone_have_what_torchrls_trees_have(capacity, writes):
    ours = written(make_leaves(capacity), capacity, writes)
    theirs = written(PlainTrees(capacity, CPU), capacity, writes)
    slots = torch.arange(capacity)
    assert ours.leaves(slots).equal(theirs.leaves(slots))
    assert torch.equal(ours.priorities.nan_to_num(7.0), theirs.priorities.nan_to_num(7.0))
    assert float(ours.highest()) == theirs.highest()
    for end in range(1, capacity + 1):
        assert float(ours.sum(end)) == pytest.approx(theirs.sum(end), rel=2e-15, abs=0.0)
        assert float(ours.lowest(end)) == theirs.lowest(end)
    if not (total := theirs.sum(capacity)) > 0:
        return
    shares = torch.linspace(0.0, 1.0, 101, dtype=torch.double)[:-1]
    (found, leaves), (expected, _) = (t.find(shares, capacity) for t in (ours, theirs))
    # But where a mass is the sum up to a slot.
    tie = (ours.leaves(slots).cumsum(0)[:, None] - shares * total).abs().amin(0) <= 1e-12 * total
    assert bool(((found == expected) | tie | (shares == 0)).all())
    assert bool((leaves > 0).all()) and leaves.equal(ours.leaves(found))


@pytest.mark.parametrize("leaf", [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.1, 0.2, 0.0, 0.7, 0.0]])
def test_a_slot_without_a_leaf_is_not_found_even_from_both_ends(leaf):
    tree = SumLeaves(len(leaf), CPU)
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


@pytest.mark.usefixtures("path")
@pytest.mark.parametrize("kind", MADE)
def test_training_samples_the_same_batches_from_leaves_as_from_trees(kind, monkeypatch):
    sampled = []
    for leaves in (False, True):
        with monkeypatch.context() as patched:
            if leaves:
                use_leaves(patched)
            storage = SignalTensorStorage(37)
            buffer = make_buffer(37, 8, storage=storage, sampler=MADE[kind](37))
            assert buffer.sampler.trees.waits == leaves
            for count in (20, 17, 9):
                buffer.extend(make_transitions(count, seed=count))
                sampled.append(train_rounds(buffer, 20, seed=count))
    first, second = torch.stack(sampled[:3]), torch.stack(sampled[3:])
    assert torch.equal(first[..., :8], second[..., :8])
    torch.testing.assert_close(first, second, rtol=1e-6, atol=0.0)
