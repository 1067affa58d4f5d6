"""Save, kill and load: the rest is equal to the last bit, and a wrong state changes nothing."""

import pickle
import shutil
from copy import deepcopy

import pytest
import torch
from torchrl.checkpoint import Checkpoint
from torchrl.data import ImmutableDatasetWriter, LazyMemmapStorage, LazyTensorStorage
from torchrl.envs.transforms import RewardScaling

from tests.mpfa.transitions import (
    MISSING,
    Trap,
    make_buffer,
    make_transitions,
    rejected,
    same,
    snapshot,
    spoil,
    train_rounds,
)
from torchrl_mpfa import SignalMemmapStorage, SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.saving import load_safely, save_atomically

CAPACITY = 24
UNALLOCATED = pytest.mark.filterwarnings(
    "ignore:Loading the storage on an uninitialized:UserWarning"
)
"""TorchRL recommends a memory map that was allocated before; ours is new on purpose."""


def make_kind(kind, folder, seed=0):
    """A buffer whose entropies are counted again every third of its size."""
    if kind == "memory":
        storage = SignalTensorStorage(CAPACITY)
    else:
        storage = SignalMemmapStorage(CAPACITY, scratch_dir=folder)
    return make_buffer(CAPACITY, 6, seed=seed, storage=storage, entropy_refresh=1 / 3)


def resume(buffer):
    """Train for a hundred rounds with new transitions among them; return all that was sampled."""
    sampled = []
    for number in range(10):
        buffer.extend(make_transitions(2, seed=number, first=1000 + number))
        sampled.append(train_rounds(buffer, 10, seed=number))
    return torch.cat(sampled)


def by_state_dict(first, second, folder):
    torch.save(first.state_dict(), folder / "buffer.pt")
    second.load_state_dict(torch.load(folder / "buffer.pt", weights_only=True))


def by_own_file(first, second, folder):
    save_atomically(first.state_dict(), folder / "buffer.pt")
    second.load_state_dict(load_safely(folder / "buffer.pt"))


def by_folder(first, second, folder):
    first.dumps(folder / "buffer")
    second.loads(folder / "buffer")


def by_moved_folder(first, second, folder):
    first.dumps(folder / "here")
    shutil.move(folder / "here", folder / "there")
    second.loads(folder / "there")


def by_checkpoint(first, second, folder):
    Checkpoint(buffer=first).save(folder / "checkpoint")
    Checkpoint(buffer=second).load(folder / "checkpoint")


@UNALLOCATED
@pytest.mark.parametrize(
    ("way", "kind", "rows"),
    [
        (by_state_dict, "memory", 11),
        (by_own_file, "memmap", 40),
        (by_folder, "memory", 40),
        (by_moved_folder, "memmap", 11),
        (by_checkpoint, "memory", 40),
    ],
)
def test_restored_buffer_trains_like_the_uninterrupted_one(way, kind, rows, tmp_path):
    first = make_kind(kind, tmp_path / "first")
    first.extend(make_transitions(rows))
    train_rounds(first, 7)
    # Between two counts of the entropies: some of the buffer is new, not yet a third.
    first.extend(make_transitions(3, seed=1, first=rows))
    train_rounds(first, 2, seed=1)
    assert first.sampler.state_dict()["_weighed_at"] < first.storage.signal_table.writes

    second = make_kind(kind, tmp_path / "second", seed=99)
    way(first, second, tmp_path)
    assert same(snapshot(first), snapshot(second))
    assert resume(first).equal(resume(second))
    assert same(snapshot(first), snapshot(second))


def test_restored_buffer_shares_no_memory_with_the_first(tmp_path):
    first, second = make_kind("memory", tmp_path), make_kind("memory", tmp_path)
    first.extend(make_transitions(CAPACITY))
    state = first.state_dict()
    second.load_state_dict(state)
    before = snapshot(second)
    resume(first)
    assert same(before, snapshot(second))
    assert same(state["_sampler"], second.state_dict()["_sampler"])


@pytest.mark.parametrize("way", [by_state_dict, by_folder])
def test_restored_storage_finds_its_device(tmp_path, way):
    first, second = (
        SignalReplayBuffer(storage=SignalTensorStorage(CAPACITY, device="auto"), batch_size=4)
        for _ in range(2)
    )
    first.extend(make_transitions(10))
    way(first, second, tmp_path)
    assert second._storage.device == torch.device("cpu")
    assert len(second.sample()) == 4


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


@pytest.fixture
def pair():
    """The state of one buffer, and another buffer in the middle of its training."""
    first, second = make_buffer(8), make_buffer(8, seed=5)
    first.extend(make_transitions(8))
    train_rounds(first, 2)
    second.extend(make_transitions(6, seed=3))
    train_rounds(second, 2)
    return snapshot(first), second


STORAGE, SAMPLER, TABLE = ("_storage",), ("_sampler",), ("_sampler", "_signals")
OBSERVATION = ("_storage", "_storage", "observation")
NAN = float("nan")
SPOILS = [
    *[
        ((name,), MISSING, f"'{name}' is missing in the saved buffer")
        for name in ("_storage", "_sampler", "_writer", "_transforms", "_rng", "_batch_size")
    ],
    (("_rng",), (torch.zeros(3), "cpu"), "RNG state|expected"),
    (("_batch_size",), 0, "batch_size must be an integer from 1"),
    (("_transforms",), {"x": torch.ones(1)}, "Unexpected key"),
    (("_writer", "_cursor"), MISSING, "'_cursor' is missing in the saved writer"),
    (("_writer", "_cursor"), 8, "cursor of the saved writer must be below 8, got 8"),
    (TABLE, MISSING, "'_signals' is missing in the saved sampler"),
    ((*TABLE, "names"), ["td_error"], r"'names' of the saved signals .*, got \['td_error'\]"),
    ((*TABLE, "rows"), MISSING, "'rows' is missing in the saved signals"),
    ((*TABLE, "rows"), torch.ones(7, 6).double(), r"'rows' of the saved .* be \[8, 6\] doubles"),
    ((*TABLE, "size"), -1, "size must be an integer from 0"),
    ((*TABLE, "writes"), 7, "times of the saved signals must be below 7, got 7"),
    ((*SAMPLER, "_format"), 3, "'_format' of the saved sampler must be 5, got 3"),
]
OF_THE_STORAGE = [
    ((*STORAGE, "_len"), MISSING, "'_len' is missing in the saved storage"),
    ((*STORAGE, "_len"), 10**18, r"'_len' of the saved storage must be in \[0, 8\], got 1000"),
    ((*STORAGE, "_len"), 7, "the saved storage has 7 rows, its signals 8"),
    (OBSERVATION, MISSING, "entry 'observation' is missing"),
    (OBSERVATION, torch.ones(8, 2), r"'observation' must have the shape \[1\] .*, got \[2\]"),
    (OBSERVATION, torch.ones(8, 1).double(), "'observation' must be torch.float32 as in the sto"),
    (OBSERVATION, torch.tensor([[NAN]] + [[1.0]] * 7), "'observation' must be finite, got nan in"),
    (("_storage", "_storage", "more"), torch.ones(8, 1), "'more' is not in the storage"),
    ((*TABLE, "size"), 9, r"the saved storage has 8 rows, its signals 9"),
]


@pytest.mark.parametrize(("path", "value", "message"), SPOILS)
def test_wrong_state_is_rejected_and_changes_nothing(pair, path, value, message):
    state, buffer = pair
    spoil(state, path, value)
    twin = deepcopy(buffer)
    with rejected(buffer, (KeyError, ValueError, TypeError, RuntimeError), message):
        buffer.load_state_dict(state)
    assert train_rounds(buffer, 3).equal(train_rounds(twin, 3))


def test_rejected_load_leaves_the_numbers_of_transforms():
    first, second = (
        make_buffer(8, transform=RewardScaling(loc, 1.0, in_keys=[("next", "reward")]))
        for loc in (0.0, 5.0)
    )
    first.extend(make_transitions(8))
    state = snapshot(first)
    spoil(state, ("_sampler", "_eps"), MISSING)
    with rejected(second, KeyError, "'_eps' is missing"):
        second.load_state_dict(state)


@pytest.mark.parametrize(("path", "value", "message"), OF_THE_STORAGE)
def test_wrong_state_of_the_storage_leaves_an_empty_buffer(pair, path, value, message):
    state, buffer = pair
    spoil(state, path, value)
    with pytest.raises((KeyError, ValueError), match=message):
        buffer.load_state_dict(state)
    assert len(buffer) == buffer.sampler.table.size == 0
    buffer.extend(make_transitions(5))
    train_rounds(buffer, 3)


@pytest.mark.parametrize("column", range(6))
@pytest.mark.parametrize("wrong", [torch.inf, -1.0])
def test_impossible_signals_are_rejected(pair, column, wrong):
    state, buffer = pair
    if column == buffer.storage.signal_table.reward_column and wrong == -1.0:
        return
    state["_sampler"]["_signals"]["rows"][3, column] = wrong
    with rejected(buffer, ValueError, "of the saved signals must be finite and not negative"):
        buffer.load_state_dict(state)


def test_folder_with_code_in_it_is_rejected_and_not_executed(tmp_path):
    first, second = make_kind("memory", tmp_path), make_kind("memory", tmp_path, seed=5)
    first.extend(make_transitions(CAPACITY))
    second.extend(make_transitions(9, seed=3))
    first.dumps(tmp_path / "buffer")
    trap = tmp_path / "trap"
    save_atomically({**snapshot(first), "x": Trap(trap)}, tmp_path / "buffer/state.pt")
    with rejected(second, pickle.UnpicklingError, "state.pt holds more than tensors"):
        second.loads(tmp_path / "buffer")
    assert not trap.exists()


@pytest.mark.parametrize("way", ["extend", "slots", "load another"])
def test_state_whose_data_were_overwritten_since_is_rejected(pair, way):
    other, buffer = pair
    buffer.extend(make_transitions(2))
    state, copy = buffer.state_dict(), snapshot(buffer)
    if way == "extend":
        buffer.extend(make_transitions(8, rewards=[50.0] * 8))
    elif way == "slots":
        buffer[torch.tensor([1])] = make_transitions(1, rewards=[50.0])
    else:
        buffer.load_state_dict(other)
        while buffer.state_dict()["_time"] < copy["_time"]:
            buffer.extend(make_transitions(1))
    for reader in (buffer, make_buffer(8)):
        with rejected(reader, ValueError, "was written to since this state of it was made"):
            reader.load_state_dict(state)
    buffer.load_state_dict(copy)
    assert same(copy, snapshot(buffer))


def test_number_of_samples_after_which_rows_are_consumed_is_restored(pair):
    other, buffer = pair
    buffer.load_state_dict({**deepcopy(other), "_consume_after_n_samples": 3})
    assert buffer.state_dict()["_consume_after_n_samples"] == 3


def test_state_is_loaded_several_times_before_a_write(pair):
    _, buffer = pair
    state, other = buffer.state_dict(), make_buffer(8)
    train_rounds(buffer, 2)
    for _ in range(2):
        buffer.load_state_dict(state)
        other.load_state_dict(state)
        assert train_rounds(buffer, 2).equal(train_rounds(other, 2))


def state_of_torchrl(kind=LazyTensorStorage, *, count=6, without=None):
    """The state of one of TorchRL's own storages, which has no signals."""
    storage = kind(8)
    data = make_transitions(count).set("index", torch.arange(count))  # As a writer does.
    storage.set(torch.arange(count), data if without is None else data.exclude(without))
    return deepcopy(storage.state_dict())


@UNALLOCATED
@pytest.mark.parametrize("ours", [SignalTensorStorage, SignalMemmapStorage])
@pytest.mark.parametrize("theirs", [LazyTensorStorage, LazyMemmapStorage])
def test_transitions_of_torchrl_count_as_written_when_a_buffer_gets_them(ours, theirs):
    storage = ours(8)
    storage.load_state_dict(state_of_torchrl(theirs))
    buffer, written = make_buffer(8, storage=storage), make_buffer(8)
    written.extend(make_transitions(6))
    assert same(buffer.sampler.state_dict(), written.sampler.state_dict())
    assert (storage.get(torch.arange(6)) == written.storage.get(torch.arange(6))).all()
    train_rounds(buffer, 3)
    assert sorted(buffer.sampler.weights) == ["action_gradient", "reward", "td_error"]


def test_rewards_of_torchrl_in_two_dimensions_find_their_slots():
    trajectories = make_transitions(12).reshape(4, 3)
    theirs, ours = LazyTensorStorage(24, ndim=2), SignalTensorStorage(24, ndim=2)
    theirs.set(range(4), trajectories)
    ours.load_state_dict(theirs.state_dict())
    rewards = trajectories["next", "reward"].flatten().double()
    assert make_buffer(24, storage=ours).sampler.table.rewards.equal(rewards)


REWARD = ("_storage", "next.reward")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (REWARD, torch.full((8, 1), torch.nan), "reward.*must be finite"),
        (REWARD, torch.ones(8, 2), r"one real number per transition, got|the shape \[1\]"),
        (("_len",), 9, r"'_len' of the saved storage must be in \[0, 8\], got 9"),
        (("_storage",), {}, "the saved storage must have 8 slots"),
    ],
)
def test_transitions_of_torchrl_that_cannot_be_fused_are_rejected(path, value, message):
    state, storage = state_of_torchrl(), SignalTensorStorage(8)
    spoil(state, path, value)
    with pytest.raises((KeyError, ValueError), match=message):
        storage.load_state_dict(state)
        make_buffer(8, storage=storage)
