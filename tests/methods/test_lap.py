"""LAP's floor of the priorities."""

import torch

from tests.methods.replays import assert_shares, make_buffer, seeded, set_signals
from torchrl_mpfa import SignalSampler
from torchrl_mpfa.methods.lap import LAPFloor

ALPHA = 0.4


def test_probabilities_are_those_of_the_larger_of_error_and_one():
    errors = torch.rand(12, generator=seeded(2)) * 4
    sampler = SignalSampler(12, ALPHA, 0.0, 0.0, signals=["td_error"], adjustments=[LAPFloor(1.0)])
    buffer = make_buffer(sampler, 12, 50_000)
    set_signals(buffer, td_error=errors)
    leaf = [max(error, 1.0) ** ALPHA for error in errors.tolist()]
    expected = torch.tensor([value / sum(leaf) for value in leaf], dtype=torch.double)
    assert (errors < 1).any()
    assert (errors > 1).any()
    assert_shares(buffer.sample()["index"], expected, samples=50_000)
