"""Eqs. (22)-(24) against hand numbers, the oracle and what they degenerate to."""

import math
from dataclasses import replace

import pytest
import torch

from tests import oracles
from tests.mpfa.transitions import seeded
from torchrl_mpfa import Adjustment, PositiveBoost, PositiveDecay
from torchrl_mpfa.adjustment import BatchFacts, boost_positive, decay_factor


def facts(rewards, counts=None):
    rewards = torch.as_tensor(rewards, dtype=torch.float32)
    counts = torch.ones(len(rewards)) if counts is None else torch.as_tensor(counts)
    return BatchFacts(reward=rewards, replay_count=counts, index=torch.arange(len(rewards)))


@pytest.mark.parametrize(
    ("bound", "expected"),
    [("floor", [1.0, 1.5, 6.0]), ("cap", [0.3, 1.0, 1.0]), ("none", [0.3, 1.5, 6.0])],
)
def test_boost_of_hand_numbers_under_each_bound(bound, expected):
    found = boost_positive(torch.tensor([0.1, 0.5, 2.0]), boost=3.0, bound=bound)
    assert found.tolist() == pytest.approx(expected)


def test_boost_equals_the_oracle():
    priority = torch.rand(64, generator=seeded())
    rewards = torch.randn(64, generator=seeded(1))
    pairs = zip(priority.tolist(), rewards.tolist(), strict=True)
    expected = [oracles.boosted(p, r, 2.5) for p, r in pairs]
    assert PositiveBoost(boost=2.5)(priority, facts(rewards)).tolist() == pytest.approx(expected)


def test_decay_factor_of_hand_numbers():
    # 1 / (1 + e^-1) and 1 / (1 + e^-2)
    found = decay_factor(torch.tensor([0.0, 10.0, 20.0]), sharpness=0.1)
    assert found.tolist() == pytest.approx([0.5, 0.7310586, 0.8807971])


def test_decay_of_a_hand_example_counts_places_from_one():
    # The mean is 3. The first and the third lie above it; the third is not positive.
    found = PositiveDecay(sharpness=1.0)(torch.tensor([5.0, 1.0, 4.0, 2.0]), facts([1, 1, -1, 1]))
    assert found.tolist() == pytest.approx([5.0 * 0.7310586, 1.0, 4.0, 2.0])


@pytest.mark.parametrize("sharpness", [0.01, 0.3, 2.0, 1e6])
def test_decay_equals_the_oracle(sharpness):
    priority = torch.rand(64, generator=seeded(2)) * 5
    rewards = torch.randn(64, generator=seeded(3))
    expected = oracles.decayed(priority.tolist(), rewards.tolist(), sharpness)
    found = PositiveDecay(sharpness=sharpness)(priority, facts(rewards))
    assert found.tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float, torch.double])
def test_equal_priorities_do_not_decay_by_a_rounded_mean(dtype):
    values = torch.rand(40, generator=seeded(5), dtype=dtype) * 5
    below = 0
    for count in range(1, 31):
        for value in values:
            priority = value.expand(count).contiguous()
            below += bool(priority.mean() < value)
            assert PositiveDecay()(priority, facts(torch.ones(count))).equal(priority)
            assert oracles.decayed(priority.tolist(), [1.0] * count, 0.01) == priority.tolist()
    assert below > 50


def test_a_priority_just_above_the_mean_decays():
    found = PositiveDecay()(torch.tensor([1.0001, 1.0, 1.0]), facts(torch.ones(3)))
    assert found.tolist() == pytest.approx([1.0001 / (1 + math.exp(-0.01)), 1.0, 1.0])


def test_positions_by_rank_decay_the_highest_most_in_any_order():
    priority = torch.tensor([4.0, 9.0, 1.0, 8.0])
    decay = PositiveDecay(sharpness=1.0, position="rank")
    factors = decay.factors(priority, facts([1, 1, 1, 1]))
    sigmoid = [1 / (1 + math.exp(-j)) for j in (3, 1, 4, 2)]
    assert factors.tolist() == pytest.approx(sigmoid)
    order = torch.tensor([2, 0, 3, 1])
    shuffled = decay(priority[order], facts([1, 1, 1, 1]))
    torch.testing.assert_close(shuffled, decay(priority, facts([1, 1, 1, 1]))[order])


def test_positions_by_count_decay_by_how_often_a_transition_was_replayed():
    decay = PositiveDecay(sharpness=1.0, position="count")
    found = decay(torch.tensor([6.0, 6.0, 0.0]), facts([1, 1, 1], counts=[1.0, 5.0, 2.0]))
    expected = [6 / (1 + math.exp(-1)), 6 / (1 + math.exp(-5)), 0.0]
    assert found.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("adjust", [PositiveBoost(), PositiveDecay()])
def test_positive_means_above_the_level_of_the_sampler_and_not_at_it(adjust):
    """Rewards of one sign: those of -1 are positive above -2, those of -2 and -3 are not."""
    facts = BatchFacts(torch.tensor([-1.0, -2.0, -3.0]), torch.ones(3), torch.arange(3))
    priority = torch.tensor([4.0, 4.0, 1.0])
    assert adjust(priority, facts).tolist() == [4.0, 4.0, 1.0]
    found = adjust(priority, replace(facts, level=-2.0))
    assert found[0] != 4.0
    assert found[1:].tolist() == [4.0, 1.0]


def test_decay_keeps_the_type_it_was_given_for_every_batch_size():
    for dtype in (torch.float32, torch.float64):
        for count in (1, 5, 5, 3):
            found = PositiveDecay()(torch.ones(count, dtype=dtype), facts(torch.ones(count)))
            assert found.dtype == dtype
            assert found.shape == (count,)


def test_a_subclass_takes_several_batches_only_if_it_says_so_itself():
    class Own(PositiveBoost):
        """A boost whose method may look at one batch alone."""

    class Several(PositiveBoost):
        takes_batches = True

    assert [kind.takes_batches for kind in (PositiveBoost, Own, Several)] == [True, False, True]
    assert (Adjustment().counts, Own(target_share=0.5).counts) == (False, True)


def test_of_equal_priorities_the_earlier_place_decays_more():
    decay = PositiveDecay(sharpness=1e-3, position="rank")
    found = decay.factors(torch.ones(5000), facts(torch.ones(5000)))
    assert (found.diff() > 0).all()
