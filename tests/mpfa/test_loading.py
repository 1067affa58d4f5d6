"""States that do not fit are rejected before anything is loaded."""

from copy import deepcopy

import pytest
import torch
from torchrl.data import ImmutableDatasetWriter

from tests.mpfa.transitions import (
    MISSING,
    make_buffer,
    make_transitions,
    rejected,
    same,
    snapshot,
    spoil,
    train_rounds,
)
from torchrl_mpfa import SignalTensorStorage


@pytest.fixture
def pair():
    """The state of one buffer, and another buffer in the middle of its training."""
    first, second = make_buffer(8), make_buffer(8, seed=5)
    first.extend(make_transitions(8))
    train_rounds(first, 2)
    second.extend(make_transitions(6, seed=3))
    train_rounds(second, 2)
    return snapshot(first), second


NAN = float("nan")
SPOILS = [
    (("_storage",), MISSING, "'_storage' is missing in the saved buffer"),
    (("_sampler",), MISSING, "'_sampler' is missing in the saved buffer"),
    (("_writer",), MISSING, "'_writer' is missing in the saved buffer"),
    (("_rng",), MISSING, "'_rng' is missing in the saved buffer"),
    (("_rng",), (torch.zeros(3), "cpu"), "'_rng' of the saved buffer must be the state of a"),
    (("_batch_size",), 0, "'_batch_size' of the saved buffer must be positive or None, got 0"),
    (("_writer", "_cursor"), MISSING, "'_cursor' is missing in the saved writer"),
    (("_writer", "_cursor"), 8, r"'_cursor' of the saved writer must be in \[0, 7\], got 8"),
    (("_writer", "_cursor"), "1", r"'_cursor' of the saved writer must be in \[0, 7\], got '1'"),
    (
        ("_writer", "_write_count"),
        -1,
        "'_write_count' of the saved writer must be an integer of at least 0, got -1",
    ),
    (("_storage", "_len"), MISSING, "'_len' is missing in the saved storage"),
    (("_storage", "_len"), 10**18, r"'_len' of the saved storage must be in \[0, 8\], got 1000"),
    (("_storage", "_len"), 7, "the saved storage has 7 rows, its signals 8"),
    (("_storage", "initialized"), MISSING, "'initialized' is missing in the saved storage"),
    (
        ("_storage", "_storage", "observation"),
        MISSING,
        "'observation' is missing in the saved storage",
    ),
    (
        ("_storage", "_storage", "observation"),
        torch.ones(8, 2),
        r"'observation' of the saved storage must be .* of shape \[8, 1\], got .* \[8, 2\]",
    ),
    (
        ("_storage", "_storage", "observation"),
        torch.ones(8, 1, dtype=torch.double),
        r"'observation' of the saved storage must be torch.float32 .*, got 'torch.float64",
    ),
    (
        ("_storage", "_storage", "more"),
        torch.ones(8, 1),
        "'more' of the saved storage is not in this one",
    ),
    (
        ("_storage", "_storage", "observation"),
        torch.tensor([[NAN]] + [[1.0]] * 7),
        "'observation' of the saved storage must be finite, got nan",
    ),
    (("_storage", "_signals", "rows"), MISSING, "'rows' is missing in the saved signals"),
    (
        ("_storage", "_signals", "rows"),
        torch.ones(7, 6, dtype=torch.double),
        r"'rows' of the saved signals must be torch.float64 of shape \[8, 6\], got .* \[7, 6\]",
    ),
    (
        ("_storage", "_signals", "rows"),
        torch.ones(8, 6),
        "'rows' of the saved signals must be torch.float64 .*, got 'torch.float32",
    ),
    (
        ("_storage", "_signals", "size"),
        9,
        r"'size' of the saved signals must be in \[0, 8\], got 9",
    ),
    (
        ("_storage", "_signals", "writes"),
        -1,
        "'writes' of the saved signals must be an integer of at least 0, got -1",
    ),
    (
        ("_storage", "_signals", "writes"),
        2,
        r"'time of writing' of the saved signals must be in \[0, 2\), got",
    ),
    (
        ("_storage", "_signals", "writes"),
        7,
        r"'time of writing' of the saved signals must be in \[0, 7\), got",
    ),
    (("_storage", "initialized"), None, "'initialized' .* must be true with 8 rows, got None"),
    (("_storage", "initialized"), False, "'initialized' .* must be true with 8 rows, got False"),
    (("_sampler", "_eps"), MISSING, "_eps"),
    (("_sampler", "_alpha"), "0.6", "_alpha"),
    (("_sampler", "_sum_tree"), MISSING, "_sum_tree"),
    (("_sampler", "_sum_tree"), torch.full((8,), NAN), "_sum_tree"),
]


@pytest.mark.parametrize(("path", "value", "message"), SPOILS)
def test_a_state_that_does_not_fit_is_rejected_and_the_next_batches_are_the_same(
    pair, path, value, message
):
    state, buffer = pair
    spoil(state, path, value)
    before, twin = snapshot(buffer), deepcopy(buffer)
    with pytest.raises((KeyError, ValueError, TypeError), match=message):
        buffer.load_state_dict(state)
    assert same(before, snapshot(buffer))
    assert train_rounds(buffer, 3).equal(train_rounds(twin, 3))


def test_data_that_no_one_may_write_are_restored_without_a_cursor():
    buffers = []
    for seed in (0, 5):
        storage = SignalTensorStorage(8)
        storage.set(torch.arange(8), make_transitions(8, seed=seed))
        buffers.append(make_buffer(8, seed=seed, storage=storage))
        buffers[-1].set_writer(ImmutableDatasetWriter())
        train_rounds(buffers[-1], 2)
    first, second = buffers
    second.load_state_dict(snapshot(first))
    assert train_rounds(first, 2).equal(train_rounds(second, 2))


@pytest.mark.parametrize("way", ["extend", "write in place", "load another"])
def test_a_state_whose_data_were_overwritten_since_is_rejected(pair, way):
    other, buffer = pair
    buffer.extend(make_transitions(2))
    state, copy = buffer.state_dict(), snapshot(buffer)
    if way == "extend":
        buffer.extend(make_transitions(8, rewards=[50.0] * 8))
    elif way == "write in place":
        buffer.set_(("next", "reward"), torch.full((8, 1), 50.0))
    else:
        buffer.load_state_dict(other)
        written = copy["_storage"]["_signals"]["writes"]
        while buffer.storage.signal_table.writes < written:
            buffer.extend(make_transitions(1))
    before = snapshot(buffer)
    for reader in (buffer, make_buffer(8)):
        with pytest.raises(ValueError, match="was written to since this state of it was made"):
            reader.load_state_dict(state)
    assert same(before, snapshot(buffer))
    buffer.load_state_dict(copy)
    assert same(copy, snapshot(buffer))


def test_a_state_may_be_loaded_several_times_before_a_write(pair):
    _, buffer = pair
    state, other = buffer.state_dict(), make_buffer(8)
    train_rounds(buffer, 2)
    for _ in range(2):
        buffer.load_state_dict(state)
        other.load_state_dict(state)
        assert train_rounds(buffer, 2).equal(train_rounds(other, 2))


def test_a_state_that_was_saved_without_a_clock_is_restored(pair):
    state, buffer = pair
    del state["_storage"]["_signals_clock"]
    buffer.load_state_dict(state)
    assert len(buffer) == 8


@pytest.mark.parametrize("column", range(6))
@pytest.mark.parametrize("wrong", [torch.inf, -1.0])
def test_signals_that_cannot_be_are_rejected(pair, column, wrong):
    state, buffer = pair
    if column == buffer.storage.signal_table.reward_column and wrong == -1.0:
        return
    state["_storage"]["_signals"]["rows"][3, column] = wrong
    with rejected(buffer, ValueError, r"of the saved signals must be (finite|in )"):
        buffer.load_state_dict(state)


def test_an_empty_buffer_is_restored_and_filled():
    first, second = make_buffer(8), make_buffer(8, seed=5)
    second.load_state_dict(snapshot(first))
    second.extend(make_transitions(3))
    assert len(second) == 3
