"""Save, kill and load: what comes after is equal to the last bit, generator included."""

import pickle
import shutil
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import Checkpoint

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
from torchrl_mpfa import MPFASampler, SignalMemmapStorage, SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.files import load_safely, save_atomically, seal_dump

ROUNDS = 100


def make_kind(kind, folder, seed=0):
    """A buffer whose entropies are counted again every third of its size."""
    if kind == "memory":
        storage = SignalTensorStorage(24)
    else:
        storage = SignalMemmapStorage(24, scratch_dir=folder)
    return make_buffer(24, 6, seed=seed, storage=storage, entropy_refresh=1 / 3)


def go_on(buffer):
    """A hundred more rounds with new transitions among them; everything that was sampled."""
    sampled = []
    for number in range(ROUNDS // 10):
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


def by_checkpoint(first, second, folder):
    Checkpoint(buffer=first).save(folder / "checkpoint")
    Checkpoint(buffer=second).load(folder / "checkpoint")


# TorchRL recommends a memory map that was allocated before; ours is a fresh one on purpose.
@pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized TensorDict")
@pytest.mark.parametrize("way", [by_state_dict, by_own_file, by_folder, by_checkpoint])
@pytest.mark.parametrize("kind", ["memory", "memmap"])
@pytest.mark.parametrize("rows", [11, 40], ids=["half full", "wrapped"])
def test_training_goes_on_bit_for_bit(way, kind, rows, tmp_path):
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
    assert go_on(first).equal(go_on(second))
    assert same(snapshot(first), snapshot(second))


def test_a_restored_buffer_does_not_share_memory_with_the_first(tmp_path):
    first, second = make_kind("memory", tmp_path), make_kind("memory", tmp_path)
    first.extend(make_transitions(24))
    state = first.state_dict()
    second.load_state_dict(state)
    before = snapshot(second)
    go_on(first)
    assert same(before, snapshot(second))
    assert same(state["_sampler"], second.state_dict()["_sampler"])


def test_priorities_set_after_saving_are_forgotten_by_loading(tmp_path):
    buffer = make_kind("memory", tmp_path)
    buffer.extend(make_transitions(24))
    train_rounds(buffer, 5)
    buffer.dumps(tmp_path / "buffer")
    before = snapshot(buffer)
    buffer.extend(make_transitions(20, seed=8))
    train_rounds(buffer, 5)
    buffer.loads(tmp_path / "buffer")
    assert same(before, snapshot(buffer))


def seal_again(folder):
    """Make the checksums of a dump those of what is in it now, as an attacker could."""
    seal_dump(folder / "dump-1/storage", folder / "dump-1/storage")
    seal_dump(folder, folder / "dump-1")


SAMPLER, STORAGE, TABLE = ("_sampler",), ("_storage",), ("_storage", "_signals")
SPOILS = [
    ((*SAMPLER, "_max_capacity"), 25, "'_max_capacity' of the saved sampler must be 24, got 25"),
    (
        (*SAMPLER, "_signals"),
        ["novelty", "td_error"],
        r"'_signals' of the saved sampler must be .*, got \['novelty', 'td_error'\]",
    ),
    ((*SAMPLER, "_format"), 99, "'_format' of .* must be 2, which this version reads, got 99"),
    ((*TABLE, "capacity"), 25, "'capacity' of the saved signals must be 24, got 25"),
    ((*TABLE, "names"), ["td_error"], r"'names' of the saved signals .*, got \['td_error'\]"),
    ((*STORAGE, "_signals_format"), 7, "'_signals_format' of .* must be 1, which .*, got 7"),
    ((*STORAGE, "_signals"), MISSING, "'_signals' is missing in the saved storage"),
]


@pytest.mark.parametrize(("path", "value", "message"), SPOILS)
@pytest.mark.parametrize("way", ["state", "folder"])
def test_a_state_that_does_not_fit_is_rejected_and_nothing_changes(
    path, value, message, way, tmp_path
):
    first, second = make_kind("memory", tmp_path), make_kind("memory", tmp_path, seed=5)
    first.extend(make_transitions(24))
    second.extend(make_transitions(9, seed=3))
    train_rounds(second, 4)
    state = snapshot(first)
    spoil(state, path, value)
    if way == "folder":
        first.dumps(tmp_path / "buffer")
        folder = tmp_path / "buffer/dump-1"
        save_atomically(state["_sampler"], folder / "sampler/sampler.pt")
        signals = {key: state["_storage"].get(key) for key in ("_signals", "_signals_format")}
        save_atomically(signals, folder / "storage/signals.pt")
        if value is MISSING:
            (folder / "storage/signals.pt").unlink()
        seal_again(tmp_path / "buffer")
    with rejected(second, (KeyError, ValueError), message):
        if way == "state":
            second.load_state_dict(state)
        else:
            second.loads(tmp_path / "buffer")


def test_a_buffer_of_other_signals_is_rejected(tmp_path):
    first = make_kind("memory", tmp_path)
    first.extend(make_transitions(9))
    other = SignalReplayBuffer(
        storage=SignalTensorStorage(24, signals=["td_error"]),
        sampler=MPFASampler(24, signals=["td_error"]),
        batch_size=6,
    )
    with pytest.raises(
        ValueError, match=r"of the saved sampler must be \['td_error'\], got \['action_gradient',"
    ):
        other.load_state_dict(first.state_dict())


@pytest.mark.parametrize("file", ["sampler/sampler.pt", "storage/signals.pt"])
def test_a_folder_with_code_in_it_is_rejected_and_nothing_changes(file, tmp_path):
    first, second = make_kind("memory", tmp_path), make_kind("memory", tmp_path, seed=5)
    first.extend(make_transitions(24))
    second.extend(make_transitions(9, seed=3))
    first.dumps(tmp_path / "buffer")
    path, trap = tmp_path / "buffer/dump-1" / file, tmp_path / "trap"
    save_atomically({"_format": 1, "x": Trap(trap)}, path)
    seal_again(tmp_path / "buffer")
    before = snapshot(second)
    with pytest.raises(pickle.UnpicklingError, match=f"{path.name} holds more than tensors"):
        second.loads(tmp_path / "buffer")
    assert not trap.exists()
    assert same(before, snapshot(second))


def test_what_is_saved_of_the_sampler_can_be_read_by_a_person(tmp_path):
    buffer = make_kind("memory", tmp_path)
    buffer.extend(make_transitions(24))
    train_rounds(buffer, 2)
    buffer.dumps(tmp_path / "buffer")
    text = Path(tmp_path / "buffer/dump-1/sampler/sampler_metadata.json").read_text()
    assert '"_alpha": 0.6' in text
    assert '"td_error"' in text


def test_a_folder_may_be_moved_before_it_is_loaded(tmp_path):
    first, second = make_kind("memory", tmp_path), make_kind("memory", tmp_path)
    first.extend(make_transitions(24))
    first.dumps(tmp_path / "here")
    shutil.move(tmp_path / "here", tmp_path / "there")
    second.loads(tmp_path / "there")
    assert first.sample()["index"].equal(second.sample()["index"])


@pytest.mark.parametrize("way", [by_state_dict, by_folder], ids=lambda way: way.__name__)
def test_a_restored_storage_knows_the_device_that_it_was_to_find_out(tmp_path, way):
    first, second = (
        SignalReplayBuffer(storage=SignalTensorStorage(24, device="auto"), batch_size=4)
        for _ in range(2)
    )
    first.extend(make_transitions(10))
    way(first, second, tmp_path)
    assert second._storage.device == torch.device("cpu")
    assert len(second.sample()) == 4
