"""Buffers and transitions that the tests of the methods share."""

import torch

from tests.mpfa.transitions import make_buffer as make_any_buffer
from tests.mpfa.transitions import make_transitions
from torchrl_mpfa import SignalTensorStorage

SPREAD = 4.5
"""Standard deviations by which a frequency may miss its probability."""


def make_buffer(sampler, capacity, batch_size, *, filled=None, seed=0):
    """A buffer with this many random transitions."""
    storage = SignalTensorStorage(capacity)
    buffer = make_any_buffer(capacity, batch_size, storage=storage, sampler=sampler, seed=seed)
    if filled is None:
        filled = capacity
    if filled:
        buffer.extend(make_transitions(filled, seed=seed))
    return buffer


def assert_shares(indices, expected, *, samples):
    """The frequencies of slots are their probabilities, as far as chance allows."""
    found = torch.bincount(indices, minlength=len(expected)).double() / len(indices)
    sigma = (expected * (1 - expected) / samples).sqrt()
    assert ((found - expected).abs() <= SPREAD * sigma + 1e-9).all(), (found, expected)
