"""Replay by age: frequencies of ages against the law written out."""

import math

import pytest
import torch

from tests.methods.replays import assert_shares, make_buffer
from tests.mpfa.transitions import make_transitions, seeded
from torchrl_mpfa import SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.methods.geometric import GeometricSampler, geometric_age

SAMPLES = 40_000


def law_by_hand(rate, count):
    """Probability of each age, newest first, in plain loops."""
    weights = [(1 - rate) ** age for age in range(count)]
    return [weight / sum(weights) for weight in weights]


def shares_of_slots(recency, order):
    """Probability of each slot, given the slots from the newest to the oldest."""
    shares = torch.zeros(len(order), dtype=torch.double)
    rate = 1 - math.exp(-recency / len(order))
    for slot, share in zip(order, law_by_hand(rate, len(order)), strict=True):
        shares[slot] = share
    return shares


@pytest.mark.parametrize("recency", [0.0, 0.2, 3.0])
@pytest.mark.parametrize(
    ("capacity", "written", "order"),
    [
        (20, (9,), [8, 7, 6, 5, 4, 3, 2, 1, 0]),
        (7, (7,), [6, 5, 4, 3, 2, 1, 0]),
        (7, (5, 5), [2, 1, 0, 6, 5, 4, 3]),
    ],
)
def test_frequencies_are_those_of_the_law_across_the_wrap(recency, capacity, written, order):
    buffer = make_buffer(GeometricSampler(recency=recency), capacity, SAMPLES, filled=0)
    for count in written:
        buffer.extend(make_transitions(count))
    assert_shares(buffer.sample()["index"], shares_of_slots(recency, order), samples=SAMPLES)


def test_no_share_leads_beyond_the_oldest_transition():
    share = torch.tensor([0.0, 1.0 - 2**-53], dtype=torch.double)
    for rate in (0.0, 1e-12, 0.5):
        age = geometric_age(share, rate=rate, count=3)
        assert age[0] == 0
        assert 0 <= age[1] <= 2


def test_in_two_dimensions_age_goes_along_time_and_the_robots_are_alike():
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(12, ndim=2),
        sampler=GeometricSampler(recency=3.0),
        batch_size=SAMPLES,
        generator=seeded(0),
    )
    for number in range(5):  # Six rows of two robots, the next to be written is the last.
        buffer.extend(make_transitions(2, seed=number).reshape(2, 1))
    time, robot = buffer.sample()["index"].unbind(-1)
    assert_shares(time, shares_of_slots(3.0, [4, 3, 2, 1, 0]), samples=SAMPLES)
    assert (robot.double().mean() - 0.5).abs() < 0.02


def test_row_that_was_not_stored_is_not_the_newest():
    sampler = GeometricSampler(recency=0.5)
    sampler.extend(torch.tensor([3, 4, -1]))  # TorchRL's writers mark it so.
    sampler.add(torch.tensor(-1))
    assert sampler.newest == [4]
