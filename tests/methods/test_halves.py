"""Uniform halves: as many updates as LA3P, and no priorities."""

import pytest
import torch

from tests.methods.replays import make_buffer, make_transitions, set_signals
from tests.mpfa.test_updates import make_learner, make_rows
from torchrl_mpfa import run_updates
from torchrl_mpfa.methods import loss_options, make_replay
from torchrl_mpfa.methods.la3p import uniform_halves


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


def test_both_halves_are_uniform():
    replay = make_replay("uniform_halves", capacity=10, batch_size=40_000)
    replay.buffer.extend(make_transitions(10))
    draws = list(replay.select(replay.buffer))
    assert [draw.trains for draw in draws] == ["both", "both"]
    assert [draw.new_step for draw in draws] == [True, False]
    for draw in draws:
        shares = torch.bincount(draw.batch["index"], minlength=10) / len(draw.batch)
        assert (shares - 0.1).abs().max() < 0.01


def test_an_odd_batch_is_split_and_a_single_transition_is_rejected():
    buffer = make_buffer(make_replay("ddpg").buffer.sampler, 9, 5)
    assert [len(draw.batch) for draw in uniform_halves(buffer)] == [2, 3]
    alone = make_buffer(make_replay("ddpg").buffer.sampler, 9, 1)
    with pytest.raises(ValueError, match="batch_size must be at least 2 for two halves, got 1"):
        next(uniform_halves(alone))


def test_la3p_without_an_exponent_samples_all_its_parts_uniformly():
    """The other control: everything of LA3P, losses and order, but the priorities."""
    replay = make_replay("la3p", capacity=10, batch_size=80_000, alpha=0.0)
    replay.buffer.extend(make_transitions(10))
    set_signals(replay.buffer, td_error=torch.arange(10.0) ** 3)
    for draw in replay.select(replay.buffer):
        shares = torch.bincount(draw.batch["index"], minlength=10) / len(draw.batch)
        assert (shares - 0.1).abs().max() < 0.01
