"""LA3P, LAP and uniform halves: each part of a batch has its probabilities."""

import pytest
import torch

from tests.methods.replays import assert_shares, make_buffer
from tests.mpfa.test_updates import make_learner
from tests.mpfa.transitions import make_rows, make_transitions, rejected, seeded, set_signals
from torchrl_mpfa import SignalSampler, run_updates
from torchrl_mpfa.methods import loss_options, make_replay
from torchrl_mpfa.methods.la3p import LA3PSampler, la3p_batches, uniform_halves
from torchrl_mpfa.methods.lap import LAPFloor

ALPHA = 0.4


def make_la3p(capacity, batch_size, *, filled=None, **kwargs):
    sampler = LA3PSampler(
        capacity,
        ALPHA,
        0.0,
        0.0,
        signals=["td_error"],
        adjustments=[LAPFloor(1.0)],
        **kwargs,
    )
    return make_buffer(sampler, capacity, batch_size, filled=filled)


def shares_by_hand(errors):
    leaf = [max(error, 1.0) ** ALPHA for error in errors]
    inverse = [1.0 / value for value in leaf]
    return [
        torch.tensor([v / sum(each) for v in each], dtype=torch.double)
        for each in ([1.0] * len(leaf), leaf, inverse)
    ]


def assert_parts(buffer, errors, *, samples):
    indices = [draw.batch["index"] for draw in la3p_batches(buffer)]
    for index, expected in zip(indices, shares_by_hand(errors.tolist()), strict=True):
        assert len(index) == samples
        assert_shares(index, expected, samples=samples)


def test_parts_are_right_after_the_ring_buffer_has_wrapped():
    """The public code looks at the slots before the cursor alone, and misses all others."""
    buffer = make_la3p(15, 40_000)
    set_signals(buffer, td_error=torch.full((15,), 3.0))
    buffer.extend(make_transitions(4, seed=9))  # Wraps: slots 0 to 3 are new.
    errors = torch.rand(15, generator=seeded(4)) * 10
    set_signals(buffer, td_error=errors)
    assert_parts(buffer, errors, samples=20_000)


def test_batch_too_small_for_parts_and_other_sampler_are_rejected():
    with pytest.raises(ValueError, match="batch_size must leave no part empty, got 1"):
        make_la3p(30, 4).sampler.sizes(1)
    assert make_la3p(30, 4, uniform_fraction=0.25).sampler.sizes(8) == (2, 6)
    other = make_buffer(SignalSampler(4, 0.6, 0.4, 0.1), 4, 2)
    with pytest.raises(TypeError, match="buffer must have an LA3PSampler, got SignalSampler"):
        next(la3p_batches(other))


def test_priority_whose_inverse_would_overflow_a_sum_is_rejected():
    sampler = LA3PSampler(1000, 1.0, 0.0, 0.0)
    with rejected(sampler, ValueError, "priority must not be so low that its inverse overflows"):
        sampler.update_priority([3], torch.tensor([1e-306], dtype=torch.double))


def test_critics_part_finds_the_large_error_that_the_uniform_part_learned():
    buffer = make_la3p(2000, 400)
    set_signals(buffer, td_error=torch.zeros(2000))
    draws = la3p_batches(buffer)
    first = next(draws)
    slot = int(first.batch["index"][0])
    learned = (first.batch["index"] == slot).float() * 1e9  # To the power of 0.4: 4,000.
    first.batch["signals", "td_error"] = learned
    buffer.update_tensordict_priority(first.batch)
    assert (next(draws).batch["index"] == slot).sum() > 60
    assert (next(draws).batch["index"] != slot).all()


def test_actors_part_finds_the_small_errors_that_the_critics_part_learned():
    buffer = make_la3p(2000, 400)
    set_signals(buffer, td_error=torch.full((2000,), 1e9))
    draws = la3p_batches(buffer)
    next(draws)  # Its priorities stay.
    second = next(draws)
    second.batch["signals", "td_error"] = torch.zeros(len(second.batch))
    buffer.update_tensordict_priority(second.batch)
    small = torch.isin(next(draws).batch["index"], second.batch["index"])
    assert small.float().mean() > 0.95


def test_whole_batch_outside_of_a_training_step_is_by_priority():
    errors = torch.rand(15, generator=seeded(3)) * 10
    buffer = make_la3p(15, 20_000)
    set_signals(buffer, td_error=errors)
    assert_shares(buffer.sample()["index"], shares_by_hand(errors.tolist())[1], samples=20_000)


# LAP, whose priorities LA3P has, and the controls of LA3P.


def test_probabilities_of_lap_are_those_of_the_larger_of_error_and_one():
    errors = torch.rand(12, generator=seeded(2)) * 4
    sampler = SignalSampler(12, ALPHA, 0.0, 0.0, signals=["td_error"], adjustments=[LAPFloor(1.0)])
    buffer = make_buffer(sampler, 12, 50_000)
    set_signals(buffer, td_error=errors)
    leaf = [max(error, 1.0) ** ALPHA for error in errors.tolist()]
    expected = torch.tensor([value / sum(leaf) for value in leaf], dtype=torch.double)
    assert (errors < 1).any()
    assert (errors > 1).any()
    assert_shares(buffer.sample()["index"], expected, samples=50_000)


def steps_of(name, **settings):
    """Updates of critic and actor in a training step, and their numbers of transitions."""
    learner = make_learner(**loss_options(name))
    replay = make_replay(name, capacity=100, batch_size=32, **settings)
    replay.buffer.extend(make_rows(100))
    found = []
    step = learner._step

    def spy(batch, trains, loss_function):
        found.append((trains, len(batch)))
        return step(batch, trains, loss_function)

    learner._step = spy
    run_updates(replay.buffer, learner, replay.select)
    assert learner.updates == 1
    return {
        who: sum(size for trains, size in found if trains in (who, "both"))
        for who in ("critic", "actor")
    }, {who: sum(trains in (who, "both") for trains, _ in found) for who in ("critic", "actor")}


def test_halves_make_as_many_updates_on_as_many_transitions_as_la3p():
    halves, la3p = steps_of("uniform_halves"), steps_of("la3p")
    assert halves == la3p == ({"critic": 32, "actor": 32}, {"critic": 2, "actor": 2})
    assert steps_of("ddpg") == ({"critic": 32, "actor": 32}, {"critic": 1, "actor": 1})


def test_odd_batch_is_split_and_a_single_transition_is_rejected():
    buffer = make_buffer(make_replay("ddpg").buffer.sampler, 9, 5)
    assert [len(draw.batch) for draw in uniform_halves(buffer)] == [2, 3]
    alone = make_buffer(make_replay("ddpg").buffer.sampler, 9, 1)
    with pytest.raises(ValueError, match="batch_size must be at least 2 for two halves, got 1"):
        next(uniform_halves(alone))
