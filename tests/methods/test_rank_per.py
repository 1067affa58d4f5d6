"""Rank-based PER: the place counts, not the size."""

import pytest
import torch

from tests.methods.replays import assert_shares, make_buffer
from tests.mpfa.transitions import seeded, set_signals
from torchrl_mpfa.methods.rank_per import RankPERSampler, rank_share

ALPHA = 0.7


def make_sampler(capacity, **kwargs):
    return RankPERSampler(capacity, ALPHA, 0.5, 0.01, signals=["td_error"], **kwargs)


def shares_by_hand(errors):
    """Probabilities by a plain sort."""
    order = sorted(range(len(errors)), key=lambda slot: -errors[slot])
    leaf = [0.0] * len(errors)
    for place, slot in enumerate(order):
        leaf[slot] = (1.0 / (place + 1)) ** ALPHA
    return torch.tensor([value / sum(leaf) for value in leaf], dtype=torch.double)


def test_share_of_a_rank_is_its_formula():
    found = rank_share(torch.tensor([1.0, 2.0, 10.0]), alpha=ALPHA)
    assert found.tolist() == pytest.approx([1.0, 2.0**-ALPHA, 10.0**-ALPHA])


def test_transitions_are_sampled_by_their_rank():
    errors = torch.rand(20, generator=seeded(1)) * 5
    buffer = make_buffer(make_sampler(20, rank_refresh=0), 20, 50_000)
    set_signals(buffer, td_error=errors)
    expected = shares_by_hand(errors.tolist())
    assert_shares(buffer.sample()["index"], expected, samples=50_000)


def test_equal_priorities_have_one_share_that_of_their_mean_rank():
    sampler = make_sampler(1000)
    sampler.mark_update(torch.arange(1000))
    assert len(sampler.trees.leaves(torch.arange(1000)).unique()) == 1
    buffer = make_buffer(make_sampler(6, rank_refresh=0), 6, 4)
    set_signals(buffer, td_error=torch.tensor([2.0, 5.0, 1.0, 2.0, 9.0, 2.0]))
    leaves = buffer.sampler.trees.leaves(torch.arange(6))
    ranks = torch.tensor([4.0, 2.0, 6.0, 4.0, 1.0, 4.0], dtype=torch.double)
    torch.testing.assert_close(leaves, ranks.pow(-ALPHA))


def test_between_two_sortings_a_priority_gets_the_rank_that_it_would_have_had():
    sampler = make_sampler(10, rank_refresh=100.0)
    buffer = make_buffer(sampler, 10, 4)
    set_signals(buffer, td_error=torch.arange(10.0, 0.0, -1.0))
    sampler._sort()
    # Slot 9 had the lowest priority; now it would stand third.
    sampler.update_signals(
        torch.tensor([9]), {"td_error": torch.tensor([8.5])}, storage=buffer._storage
    )
    leaves = sampler.trees.leaves(torch.arange(10))
    expected = torch.arange(1.0, 11.0).double().pow(-ALPHA)
    expected[9] = 3.0**-ALPHA
    torch.testing.assert_close(leaves, expected)


def test_all_are_sorted_when_enough_priorities_are_new():
    sampler = make_sampler(10, rank_refresh=0.5)
    buffer = make_buffer(sampler, 10, 4)
    set_signals(buffer, td_error=torch.arange(10.0, 0.0, -1.0))
    ranks = [sampler.trees.leaves(torch.arange(10)).sort().values]
    for slot in range(6):
        sampler.update_signals(
            torch.tensor([slot]),
            {"td_error": torch.tensor([0.1 - 0.01 * slot])},
            storage=buffer._storage,
        )
        ranks.append(sampler.trees.leaves(torch.arange(10)).sort().values)
    whole = torch.arange(10.0, 0.0, -1.0).double().pow(-ALPHA)
    torch.testing.assert_close(ranks[0], whole)
    assert not torch.allclose(ranks[4], whole)
    torch.testing.assert_close(ranks[6], whole)


def test_weights_are_those_of_the_shares():
    errors = torch.arange(1.0, 11.0)
    buffer = make_buffer(make_sampler(10, rank_refresh=0), 10, 200)
    set_signals(buffer, td_error=errors)
    batch = buffer.sample()
    shares = shares_by_hand(errors.tolist())
    expected = (shares[batch["index"]] / shares.min()).pow(-0.5)
    torch.testing.assert_close(batch["priority_weight"].double(), expected)
