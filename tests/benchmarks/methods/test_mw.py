"""The cap on replays: what was replayed often enough is left out, and a batch is still sampled."""

import pytest
import torch

from benchmarks.paper.methods.mw import MWSampler
from tests.methods.replays import make_buffer
from tests.mpfa.transitions import make_transitions, set_signals
from torchrl_mpfa import Adjustment, FixedFusion, ScaledFusion

SIGNALS = ["reward", "td_error"]


def make_capped(capacity, batch_size, cap, *, filled=None):
    sampler = MWSampler(
        capacity,
        0.6,
        0.4,
        0.05,
        signals=SIGNALS,
        fusion=ScaledFusion(FixedFusion(dict.fromkeys(SIGNALS, 1.0))),
        replay_cap=cap,
        entropy_refresh=0,  # Means are those of the moment.
    )
    return make_buffer(sampler, capacity, batch_size, filled=filled)


def counts_of(buffer):
    table = buffer._storage.signal_table
    return table.rows[: table.size, table.count_column]


def train(buffer, td_error=1.0):
    batch = buffer.sample()
    batch["signals", "td_error"] = torch.full((len(batch),), td_error)
    buffer.update_tensordict_priority(batch)
    return batch


def test_transition_that_reached_the_cap_is_not_sampled_again():
    buffer = make_capped(40, 4, 3)
    for _ in range(400):
        spent = set((counts_of(buffer) >= 3).nonzero().squeeze(1).tolist())
        left = 40 - len(spent)
        sampled = set(train(buffer)["index"].tolist())
        if left < 4:
            break
        assert not sampled & spent
    else:
        pytest.fail("the cap was never reached")


def test_pool_that_is_used_up_is_sampled_from_uniformly():
    buffer = make_capped(10, 8, 1)
    for _ in range(60):
        train(buffer)
    assert (counts_of(buffer) >= 1).all()
    found = torch.cat([train(buffer)["index"] for _ in range(500)])
    shares = torch.bincount(found, minlength=10) / len(found)
    assert (shares - 0.1).abs().max() < 0.02
    assert torch.equal(buffer.sample()["priority_weight"], torch.ones(8))


def test_transition_that_takes_the_place_of_a_spent_one_counts_again():
    buffer = make_capped(6, 4, 2, filled=6)
    for _ in range(20):
        train(buffer)
    buffer.extend(make_transitions(6, seed=5))
    assert not buffer.sampler._spent.any()
    spent = buffer.sampler._spent
    train(buffer)
    assert not spent.all()


def test_update_that_raises_uses_no_transition_up():
    class Broken(Adjustment):
        def __call__(self, priority, batch):
            return priority * torch.nan

    buffer = make_capped(6, 4, 1)
    buffer.sampler.adjustments = (Broken(),)
    with pytest.raises(ValueError, match="adjusted priorities must be finite"):
        train(buffer)
    assert not buffer.sampler._spent.any()


def test_both_terms_are_divided_by_their_means_and_count_the_same():
    buffer = make_capped(5, 2, 100)
    errors = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])
    set_signals(buffer, td_error=errors)
    rewards = buffer[:]["next", "reward"].squeeze(1).abs()
    set_signals(buffer, td_error=errors)  # Once more, now that all errors are known.
    expected = rewards / rewards.mean() + errors / errors.mean() + 0.05
    found = buffer.sampler.priorities(torch.arange(5))
    torch.testing.assert_close(found.float(), expected)
