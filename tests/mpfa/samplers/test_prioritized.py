"""TreeSampler beside TorchRL's own sampler, against Eqs. (8) and (10), and its fresh priorities."""

import math

import pytest
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler

from tests import oracles
from tests.mpfa.transitions import (
    make_buffer,
    make_transitions,
    rejected,
    same,
    seeded,
    set_signals,
)
from torchrl_mpfa import FixedFusion
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.samplers import TreeSampler

pytestmark = pytest.mark.usefixtures("path")


def filled(sampler, count, capacity):
    """A storage with so many rows, marked in the sampler as TorchRL's buffer does."""
    storage = LazyTensorStorage(capacity)
    storage.set(torch.arange(count), torch.zeros(count))
    sampler.mark_update(torch.arange(count), storage=storage)
    return storage


def leaves(sampler, count):
    return sampler.trees.leaves(torch.arange(count))


@pytest.mark.parametrize("capacity", [1, 7, 32, 50])
def test_priorities_are_those_of_torchrl_after_the_same_updates(capacity):
    ours, theirs = (
        TreeSampler(capacity, 0.7, 0.5, 0.01),
        PrioritizedSampler(capacity, 0.7, 0.5, 0.01),
    )
    for sampler in (ours, theirs):
        filled(sampler, capacity, capacity)
    generator = seeded(capacity)
    for _ in range(20):
        index = torch.randint(capacity, (8,), generator=generator).unique()
        priority = torch.rand(len(index), generator=generator) * 3
        ours.update_priority(index, priority)
        theirs.update_priority(index, priority)
    slots = torch.arange(capacity)
    found, expected = ours.trees.leaves(slots), torch.as_tensor(theirs._sum_tree[slots])
    # TorchRL's trees are in single precision, and of one slot it gives a number.
    torch.testing.assert_close(found.float(), expected.reshape(-1))
    assert ours.trees.lowest(capacity) == pytest.approx(theirs._min_tree.query(0, capacity))


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0])
def test_a_histogram_of_50000_samples_has_the_probabilities_of_eq_8(alpha):
    sampler = TreeSampler(20, alpha, 0.4)
    storage = filled(sampler, 20, 20)
    priority = torch.rand(20, generator=seeded(1)) + 0.05
    sampler.update_priority(torch.arange(20), priority)
    sampler._rng = seeded(2)
    sampled = torch.cat([sampler.sample(storage, 1000)[0] for _ in range(50)])
    found = torch.bincount(sampled, minlength=20) / 50_000
    expected = torch.tensor(oracles.probabilities(priority.tolist(), alpha))
    # Five standard deviations of a binomial share.
    tolerance = 5 * (expected * (1 - expected) / 50_000).sqrt()
    assert ((found - expected).abs() < tolerance).all()


def test_slots_of_minus_one_are_skipped():
    sampler = TreeSampler(4, 1.0, 0.4, 0.0)
    filled(sampler, 4, 4)
    sampler.update_priority(torch.tensor([-1, 2]), torch.tensor([9.0, 3.0]))
    assert leaves(sampler, 4).tolist() == [1.0, 1.0, 3.0, 1.0]
    sampler.update_priority(torch.tensor([-1]), torch.tensor([9.0]))
    sampler.update_priority(torch.tensor([-1, 0]), torch.tensor([9.0, 4.0]))
    assert leaves(sampler, 4).tolist() == [4.0, 1.0, 3.0, 1.0]


def test_one_number_may_serve_for_all_slots_and_a_column_for_a_row():
    sampler = TreeSampler(4, 1.0, 0.4, 0.0)
    sampler.update_priority(torch.arange(4), 2.0)
    assert leaves(sampler, 4).tolist() == [2.0] * 4
    sampler.update_priority(torch.tensor([0, 1]), torch.tensor([[3.0], [4.0]]))
    sampler.update_priority(2, 5.0)
    assert leaves(sampler, 4).tolist() == [3.0, 4.0, 5.0, 2.0]


OUTSIDE = r"index must be in \[0, 4\), got"
WRONG = [
    *(([0, 1], [1.0, v], f"priority .* not negative, got {v}") for v in (math.nan, math.inf, -0.5)),
    *(([0, slot], [1.0, 2.0], f"{OUTSIDE} {slot}") for slot in (4, 7, -2)),
    (torch.arange(3), torch.ones(2), "priority should be a number or an iterable"),
    (torch.zeros(2, 2, dtype=torch.long), torch.ones(2), "index must have one dimension"),
]


@pytest.mark.parametrize(("index", "priority", "message"), WRONG)
def test_a_slot_or_priority_that_cannot_be_is_rejected_and_changes_nothing(
    index, priority, message
):
    sampler = TreeSampler(4, 0.6, 0.4)
    filled(sampler, 4, 4)
    before = sampler.state_dict()
    with pytest.raises((IndexError, RuntimeError, TypeError, ValueError), match=message):
        sampler.update_priority(index, torch.as_tensor(priority))
    if message.startswith(OUTSIDE):
        with pytest.raises(IndexError, match=message):
            sampler.mark_update(index)
    assert same(before, sampler.state_dict())


@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_priorities_whose_sum_overflows_are_rejected(alpha):
    sampler = TreeSampler(1000, alpha, 0.4)
    sampler.mark_update(torch.arange(1000))
    with rejected(sampler, ValueError, r"priority must not be so high that sums overflow, got"):
        sampler.update_priority([3], torch.tensor([1e306], dtype=torch.double))
    sampler.update_priority([3], torch.tensor([2e38]))  # Would overflow in single precision.
    assert sampler.priorities(torch.tensor([3])).item() == pytest.approx(2e38)


def test_an_empty_buffer_and_priorities_of_zero_cannot_be_sampled():
    sampler = TreeSampler(4, 1.0, 0.4, 0.0)
    with pytest.raises(RuntimeError, match="cannot sample from an empty buffer"):
        sampler.sample(LazyTensorStorage(4), 2)
    storage = filled(sampler, 2, 4)
    for slot in range(2):
        sampler.update_priority(slot, 0.0)
        with pytest.raises(RuntimeError, match=r"every priority must be positive.* lowest of 0.0"):
            sampler.sample(storage, 2)


def test_a_batch_of_one_can_be_sampled_from_a_buffer_of_one():
    # The tree gives a bare number for one slot, which has no pow.
    sampler = TreeSampler(1, 0.6, 0.4)
    index, info = sampler.sample(filled(sampler, 1, 1), 1)
    assert index.tolist() == [0]
    assert info["priority_weight"].tolist() == [1.0]


def test_alpha_may_leave_zero_exactly():
    """TorchRL keeps but the powers, all 1 at an exponent of 0, and warns that it cannot go back."""
    sampler = TreeSampler(10, 0.0, 0.4, 0.0)
    filled(sampler, 8, 10)
    priority = torch.rand(8, generator=seeded(3)) + 0.1
    sampler.update_priority(torch.arange(8), priority)
    assert leaves(sampler, 10).tolist() == [1.0] * 8 + [0.0] * 2
    sampler.alpha = 0.5
    torch.testing.assert_close(leaves(sampler, 8), priority.double().sqrt())
    assert leaves(sampler, 10)[8:].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("kind", [TreeSampler, RankPERSampler, LA3PSampler])
@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("alpha", -1.0, ValueError),
        ("alpha", 300.0, ValueError),
        ("beta", math.nan, ValueError),
        ("beta", None, TypeError),
    ],
)
def test_an_exponent_that_cannot_be_is_rejected_and_changes_nothing(kind, name, value, error):
    sampler = kind(64, 0.6, 0.4, 0.01)
    sampler.update_priority(torch.arange(64), torch.logspace(-2, 5, 64))
    before = sampler.state_dict()
    with pytest.raises(error, match=f"{name} must"):
        setattr(sampler, name, value)
    assert same(sampler.state_dict(), before)
    setattr(sampler, name, 0.9)
    assert getattr(sampler, name) == 0.9


def test_the_highest_mass_that_there_is_does_not_leave_the_filled_slots(monkeypatch):
    # Of these priorities the sum is rounded up, beyond what the search adds up.
    priority = 10 ** (torch.rand(29, generator=seeded(7), dtype=torch.double) * 5)
    sampler = TreeSampler(64, 1.0, 0.4, 0.0)
    storage = filled(sampler, 29, 64)
    sampler.update_priority(torch.arange(29), priority)
    highest = torch.full((3,), 1.0 - 2.0**-53, dtype=torch.double)
    monkeypatch.setattr(sampler, "_mass", lambda count: highest.clone())
    assert sampler.sample(storage, 3)[0].tolist() == [28] * 3
    # The highest share of the last of equal parts is rounded up to one.
    sampler.stratified, highest = True, torch.ones_like(highest)
    assert sampler._uniform(29, 3).tolist() == [28] * 3


@pytest.mark.parametrize("count", [3, 40_000])
def test_of_a_slot_that_appears_twice_the_last_entry_counts(count):
    sampler = TreeSampler(50, 1.0, 0.4, 0.0)
    sampler.mark_update(torch.arange(50))
    slots = torch.randint(50 if count > 50 else 1, (count,), generator=seeded(3))
    priority = torch.rand(count, generator=seeded(4), dtype=torch.double) + 0.1
    sampler.update_priority(slots, priority)
    expected = [1.0] * 50
    for slot, value in zip(slots.tolist(), priority.tolist(), strict=True):
        expected[slot] = value
    assert sampler.priorities().tolist() == expected
    assert sampler.trees.leaves(torch.arange(50)).tolist() == expected
    assert sampler.trees.lowest(50) == min(expected)


def test_torchrl_reads_the_trees_by_its_own_names():
    sampler = TreeSampler(4, 1.0, 0.4, 0.0)
    sampler.mark_update(torch.arange(3))
    sampler.update_priority(torch.tensor([1, 2]), torch.tensor([0.5, 3.0]))
    assert sampler._tree_argmax()[1] == 2
    assert sampler._sum_tree[[0, 1, 3]].tolist() == [1.0, 0.5, 0.0]
    assert sampler._min_tree[1] == sampler._min_tree.query(0, 4) == 0.5
    assert sampler._min_tree[3] == torch.finfo(torch.double).max  # Nothing was written there.
    assert sampler.batch_weights(4).isnan().tolist() == [False] * 3 + [True]
    assert sampler._sum_tree.query(0, 3) == 4.5
    with pytest.raises(ValueError, match="start must be 0, got 1"):
        sampler._sum_tree.query(1, 3)


# Fresh transitions get the highest priority that an update gave.


def make_plain(capacity, **kwargs):
    """Priorities are the TD error."""
    settings = {"adjustments": [], "fusion": FixedFusion({"td_error": 1.0}), "eps": 0.0, **kwargs}
    return make_buffer(capacity, 4, **settings)


def update(buffer, index, values):
    set_signals(buffer, index, td_error=values, action_gradient=torch.ones(len(index)))


def test_fresh_rows_do_not_hand_on_their_priority():
    buffer = make_plain(8)
    buffer.extend(make_transitions(4))
    update(buffer, [0, 1], [20.0, 0.4])
    update(buffer, [1], [0.3])  # A lower one leaves it as it is.
    buffer.extend(make_transitions(3))
    assert buffer.sampler.priorities()[4:7].tolist() == [20.0] * 3
    update(buffer, [0], [0.5])  # Its slot was sampled again.
    assert buffer.sampler.default_priority == 0.5
    buffer.extend(make_transitions(1))
    assert buffer.sampler.priorities()[7] == 0.5


@pytest.mark.parametrize("slot", range(8))
def test_fresh_rows_have_the_highest_priority_whatever_its_slot(slot):
    buffer = make_plain(8)
    buffer.extend(make_transitions(8))
    update(buffer, list(range(8)), [9.0 if row == slot else 0.4 for row in range(8)])
    assert buffer.sampler.default_priority == 9.0


@pytest.mark.parametrize("settings", [{"max_priority_within_buffer": False}, {"alpha": 0.0}])
def test_the_highest_ever_is_an_option_and_stays(settings):
    """TorchRL keeps it where all slots are sampled alike, too."""
    buffer = make_plain(4, **settings)
    buffer.extend(make_transitions(4))
    update(buffer, [0], [20.0])
    update(buffer, [0, 1], [0.5, 3.0])
    assert buffer.sampler.default_priority == 20.0
    buffer.extend(make_transitions(4))
    assert buffer.sampler.priorities().tolist() == [20.0] * 4


def test_priority_of_zero_that_was_learned_is_the_highest_where_all_are_zero():
    sampler = TreeSampler(2, 1.0, 0.4, 0.0, max_priority_within_buffer=True)
    sampler.update_priority(torch.arange(2), 0.0)
    assert sampler.default_priority == 0.0


@pytest.mark.parametrize("within", [True, False])
def test_highest_priority_is_saved_with_learned_slots(within):
    first, second = (make_plain(8, max_priority_within_buffer=within) for _ in range(2))
    first.extend(make_transitions(4))
    update(first, [0, 1], [9.0, 3.0])
    first.extend(make_transitions(2))
    second.load_state_dict(first.state_dict())
    for buffer in (first, second):
        update(buffer, [0], [0.1])
        assert buffer.sampler.default_priority == (3.0 if within else 9.0)
        assert buffer.sampler.priorities()[4:6].tolist() == [9.0, 9.0]


def test_priority_from_torchrls_buffer_does_not_count_as_learned():
    """It reads the default priority, and writes it for batches without one."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(8),
        sampler=TreeSampler(8, 0.6, 0.4, 0.0, max_priority_within_buffer=True),
        batch_size=2,
    )
    buffer.extend(torch.arange(4))
    for _ in range(2):  # A priority that was learned stays so, whatever it is.
        buffer.update_priority(torch.tensor([0]), torch.tensor([0.37]))
    buffer.extend(torch.arange(2))
    buffer.update_priority(torch.tensor([4, 5]), torch.tensor([0.37, 0.37]))
    buffer.update_priority(torch.tensor([0]), torch.tensor([0.2]))
    assert buffer.sampler.default_priority == pytest.approx(0.2)
