"""Replay by age: frequencies of ages against the law written out."""

import pytest
import torch

from tests.methods.replays import assert_shares, make_buffer, make_transitions, seeded
from torchrl_mpfa import SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.methods import GeometricSampler, geometric_age, make_replay

SAMPLES = 40_000


def law_by_hand(rate, count):
    """Probability of each age, newest first, in plain loops."""
    weights = [(1 - rate) ** age for age in range(count)]
    return [weight / sum(weights) for weight in weights]


def shares_of_slots(rate, order):
    """Probability of each slot, given the slots from the newest to the oldest."""
    shares = torch.zeros(len(order), dtype=torch.double)
    for slot, share in zip(order, law_by_hand(rate, len(order)), strict=True):
        shares[slot] = share
    return shares


@pytest.mark.parametrize("rate", [0.0, 0.02, 0.4])
@pytest.mark.parametrize(
    ("capacity", "written", "order"),
    [
        (20, (9,), [8, 7, 6, 5, 4, 3, 2, 1, 0]),
        (7, (7,), [6, 5, 4, 3, 2, 1, 0]),
        (7, (5, 5), [2, 1, 0, 6, 5, 4, 3]),
    ],
)
def test_frequencies_are_those_of_the_law_across_the_wrap(rate, capacity, written, order):
    buffer = make_buffer(GeometricSampler(rate=rate), capacity, SAMPLES, filled=0)
    for count in written:
        buffer.extend(make_transitions(count))
    assert_shares(buffer.sample()["index"], shares_of_slots(rate, order), samples=SAMPLES)


@pytest.mark.parametrize("rate", [0.0, 1e-9, 3e-5, 0.3, 0.999])
def test_an_age_is_the_first_whose_cumulative_probability_exceeds_the_share(rate):
    law = law_by_hand(rate, 50)
    shares = torch.rand(200, generator=seeded(1), dtype=torch.double)
    for share, found in zip(
        shares.tolist(), geometric_age(shares, rate=rate, count=50).tolist(), strict=True
    ):
        below = sum(law[:found])
        assert below - 1e-6 <= share < below + law[found] + 1e-6


def test_no_share_leads_beyond_the_oldest_transition():
    share = torch.tensor([0.0, 1.0 - 2**-53], dtype=torch.double)
    for rate in (0.0, 1e-12, 0.5):
        age = geometric_age(share, rate=rate, count=3)
        assert age[0] == 0
        assert 0 <= age[1] <= 2


def test_in_two_dimensions_age_goes_along_time_and_the_robots_are_alike():
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(12, signals=["td_error"], ndim=2),
        sampler=GeometricSampler(rate=0.5),
        batch_size=SAMPLES,
        generator=seeded(0),
    )
    for number in range(5):  # Six rows of two robots, the next to be written is the last.
        buffer.extend(make_transitions(2, seed=number).reshape(2, 1))
    time, robot = buffer.sample()["index"].unbind(-1)
    assert_shares(time, shares_of_slots(0.5, [4, 3, 2, 1, 0]), samples=SAMPLES)
    assert (robot.double().mean() - 0.5).abs() < 0.02


def test_what_is_learned_from_is_younger_than_by_uniform_replay():
    """Of a buffer of 1,000, the mean age is that of the law, not 500."""
    replay = make_replay("geometric", capacity=1000, batch_size=SAMPLES, recency=0.01)
    replay.buffer.extend(make_transitions(1500))  # Slot 499 is the newest.
    (draw,) = replay.select(replay.buffer)
    age = (499 - draw.batch["index"]) % 1000
    expected = sum(age * share for age, share in enumerate(law_by_hand(0.01, 1000)))
    assert age.double().mean() == pytest.approx(expected, rel=0.03)
    assert expected < 100


@pytest.mark.parametrize("rate", [-0.1, 1.0, float("nan")])
def test_a_rate_that_is_no_share_is_refused(rate):
    with pytest.raises(ValueError, match="rate must be"):
        GeometricSampler(rate=rate)


def test_what_was_not_stored_is_not_the_newest():
    sampler = GeometricSampler(rate=0.5)
    sampler.extend(torch.tensor([3, 4, -1]))  # TorchRL's writers mark it so.
    sampler.add(torch.tensor(-1))
    assert sampler.newest == [4]
