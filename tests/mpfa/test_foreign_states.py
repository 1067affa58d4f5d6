"""States that TorchRL's own storages saved, which have no signals."""

from copy import deepcopy

import pytest
import torch
from torchrl.data import LazyMemmapStorage, LazyTensorStorage

from tests.mpfa.transitions import (
    make_buffer,
    make_transitions,
    rejected,
    train_rounds,
)
from torchrl_mpfa import SignalMemmapStorage, SignalTensorStorage


def stock_state(kind=LazyTensorStorage, *, count=6, without=None):
    storage = kind(8)
    data = make_transitions(count).set("index", torch.arange(count))  # As a writer does.
    storage.set(torch.arange(count), data if without is None else data.exclude(without))
    return deepcopy(storage.state_dict())


@pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized:UserWarning")
@pytest.mark.parametrize("ours", [SignalTensorStorage, SignalMemmapStorage])
@pytest.mark.parametrize("theirs", [LazyTensorStorage, LazyMemmapStorage])
def test_the_transitions_count_as_written_now_and_nothing_is_learned_of_them(ours, theirs):
    storage = ours(8)
    storage.load_state_dict(stock_state(theirs))
    written = ours(8)
    written.set(torch.arange(6), make_transitions(6).set("index", torch.arange(6)))
    found, expected = storage.signal_table.state_dict(), written.signal_table.state_dict()
    assert found["rows"].nan_to_num(-1).equal(expected.pop("rows").nan_to_num(-1))
    assert {key: found[key] for key in expected} == expected
    assert (storage.get(torch.arange(6)) == written.get(torch.arange(6))).all()


def test_rewards_of_several_environments_find_their_slots():
    trajectories = make_transitions(12).reshape(4, 3)
    theirs, ours = LazyTensorStorage(24, ndim=2), SignalTensorStorage(24, ndim=2)
    theirs.set(range(4), trajectories)
    ours.load_state_dict(theirs.state_dict())
    rewards = trajectories["next", "reward"].flatten().double()
    assert ours.signal_table.rewards.equal(rewards)


def test_a_buffer_trains_on_what_was_loaded():
    storage = SignalTensorStorage(8)
    storage.load_state_dict(stock_state())
    buffer = make_buffer(8, storage=storage)
    train_rounds(buffer, 3)
    assert sorted(buffer.sampler.weights) == ["action_gradient", "reward", "td_error"]


def test_a_batch_from_before_is_known_to_be_old():
    buffer = make_buffer(8)
    buffer.extend(make_transitions(6, seed=3))
    batch = buffer.sample()
    buffer.storage.load_state_dict(stock_state())
    learned = {name: torch.ones(4) for name in ("td_error", "action_gradient")}
    stale = buffer.sampler.update_signals(
        batch["index"], learned, storage=buffer.storage, written_at=batch["written_at"]
    )
    assert stale == 4


def no_reward():
    return stock_state(without=("next", "reward"))


def reward_that_is_not_finite():
    state = stock_state()
    state["_storage"]["next.reward"][2] = torch.nan
    return state


def two_rewards():
    state = stock_state()
    state["_storage"]["next.reward"] = torch.ones(8, 2)
    return state


def too_many():
    return {**stock_state(), "_len": 9}


@pytest.mark.parametrize("filled", [0, 5])
@pytest.mark.parametrize(
    ("make_state", "error", "message"),
    [
        (no_reward, KeyError, "the transitions lack 'reward'|'next.reward' is missing"),
        (reward_that_is_not_finite, ValueError, "reward' .*must be finite"),
        (
            two_rewards,
            ValueError,
            r"one real number per transition, got|of shape \[8, 2\]",
        ),
        (too_many, ValueError, r"'_len' of the saved storage must be in \[0, 8\], got 9"),
    ],
)
def test_what_cannot_be_fused_is_rejected_and_nothing_changes(make_state, error, message, filled):
    buffer = make_buffer(8)
    if filled:
        buffer.extend(make_transitions(filled, seed=3))
        train_rounds(buffer, 2)
    with rejected(buffer, error, message):
        buffer.storage.load_state_dict(make_state())


@pytest.mark.parametrize("lost", ["_signals", "_signals_format"])
def test_half_of_the_signals_is_damage_and_not_a_state_of_torchrl(lost):
    storage = SignalTensorStorage(8)
    storage.set(torch.arange(6), make_transitions(6))
    state = storage.state_dict()
    del state[lost]
    with pytest.raises(
        (KeyError, ValueError), match=r"'_signals(_format)?' is missing in the saved storage"
    ):
        SignalTensorStorage(8).load_state_dict(state)
