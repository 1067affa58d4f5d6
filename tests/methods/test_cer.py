"""Combined experience replay: the newest transition is in every batch."""

import pytest
import torch

from tests.methods.replays import make_buffer
from tests.mpfa.transitions import make_transitions
from torchrl_mpfa.samplers.uniform import CERSampler


def make_combined(capacity, batch_size, filled):
    return make_buffer(CERSampler(), capacity, batch_size, filled=filled)


def test_newest_transition_is_in_every_batch_across_the_wrap():
    buffer = make_combined(7, 3, 5)
    for number in range(20):
        slot = int(buffer.extend(make_transitions(1, seed=number))[0])
        assert slot == (5 + number) % 7
        assert int(buffer.sample()["index"][0]) == slot


def test_transitions_but_the_newest_are_sampled_uniformly():
    buffer = make_combined(8, 4001, 8)
    others = torch.cat([buffer.sample()["index"][1:] for _ in range(5)])
    shares = torch.bincount(others, minlength=8) / len(others)
    assert (shares - 1 / 8).abs().max() < 0.012


def test_buffer_that_is_emptied_has_no_newest_transition():
    buffer = make_combined(5, 2, 5)
    buffer.empty()
    with pytest.raises(RuntimeError, match="empty"):
        buffer.sample()
    buffer.extend(make_transitions(1))
    assert buffer.sample()["index"].tolist() == [0, 0]
