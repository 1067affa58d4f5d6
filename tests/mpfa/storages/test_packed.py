"""Packed rows: the entries of one type lie side by side in a file of a storage's folder."""

import io
import pickle
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorStorageCheckpointer

from tests.mpfa.transitions import same
from torchrl_mpfa import SignalMemmapStorage
from torchrl_mpfa.storages.packed import PackedTensor


def make_rows(count, first=0):
    """Rows with a number, vectors and a matrix of one type, and entries of two others."""
    numbers = first + torch.arange(12.0 * count).reshape(count, 3, 4)
    after = {"observation": numbers[:, 1] + 0.25, "done": torch.arange(count).unsqueeze(1) % 2 == 0}
    entries = {
        "observation": numbers[:, 0],
        "image": numbers + 0.5,
        "time": numbers[:, 0, 0] + 0.75,
    }
    return TensorDict({**entries, "next": after, "step": torch.arange(count)}, [count])


@pytest.fixture
def storage(tmp_path):
    """A storage of ten slots in a folder, six of them filled."""
    storage = SignalMemmapStorage(10, scratch_dir=tmp_path / "rows")
    storage.set(torch.arange(6), make_rows(6))
    return storage


def names_in(folder):
    return {path.name for path in folder.rglob("*") if path.is_file()} - {"signals.memmap"}


def test_each_type_has_a_file_with_whole_rows_one_after_the_other(storage, tmp_path):
    assert names_in(tmp_path) == {"float32.rows", "bool.rows", "int64.rows"}
    numbers = np.fromfile(tmp_path / "rows/float32.rows", np.float32).reshape(10, 3 * 4 + 4 + 4 + 1)
    row = make_rows(6)[4]
    floats = [
        row[key].flatten() for key in ("observation", "image", "time", ("next", "observation"))
    ]
    assert sorted(numbers[4].tolist()) == sorted(torch.cat(floats).tolist())
    assert not numbers[6:].any()


@pytest.mark.parametrize("asked", [False, True])
def test_rows_read_are_those_written(storage, asked):
    slots = torch.tensor([5, 0, 3, 3])
    storage.set(torch.tensor([3, 5]), new := make_rows(2, first=500))
    expected = make_rows(6)
    expected[torch.tensor([3, 5])] = new
    plan = storage.plan(slots)
    plan._is_cold = asked
    assert same(storage.get(slots).to_dict(), expected[slots].to_dict())
    assert same(storage[:6].to_dict(), expected.to_dict())
    assert same(storage[1:4].to_dict(), expected[1:4].to_dict())


@pytest.mark.parametrize("pickler", [pickle, ForkingPickler], ids=["pickle", "processes"])
def test_a_part_of_a_part_is_found_in_the_file_by_whoever_unpickles_it(storage, pickler):
    found = pickle.loads(bytes(pickler.dumps(storage[1:5][2:])))
    assert same(found.to_dict(), make_rows(6)[3:5].to_dict())
    found["image"][0] = 7.0
    assert (storage.get(torch.tensor([3]))["image"] == 7.0).all()


@pytest.mark.parametrize("key", ["observation", "image", "time"])
@pytest.mark.parametrize("way", ["unbind", "split", "chunk"])
def test_parts_of_an_entry_are_found_again(storage, way, key):
    entry = storage._storage[key]
    parts = {"unbind": entry.unbind, "split": lambda dim: entry.split(4, dim)}
    for part in parts.get(way, lambda dim: entry.chunk(3, dim))(0):
        assert isinstance(part, PackedTensor)
        assert pickle.loads(pickle.dumps(part)).equal(part)


def test_a_saved_state_has_each_number_once_and_restores_any_storage(storage):
    file = io.BytesIO()
    torch.save(storage.state_dict(), file)
    bytes_each = make_rows(1).bytes()
    assert len(file.getvalue()) < 10 * bytes_each + 5_000
    file.seek(0)
    for restored in (LazyTensorStorage(10), SignalMemmapStorage(10)):
        file.seek(0)
        restored.load_state_dict(torch.load(file))
        assert same(restored[:].to_dict(), make_rows(6).to_dict())


def test_a_state_shares_the_rows_and_is_read_ahead(storage):
    values = storage.state_dict()["_storage"]
    assert values["image"].data_ptr() != storage._storage["image"].data_ptr()
    storage.set(torch.tensor([2]), make_rows(1, first=90))
    assert values["image"][2].equal(make_rows(1, first=90)["image"][0])
    same_file = values["image"].untyped_storage().data_ptr()
    assert values["observation"].untyped_storage().data_ptr() == same_file


def test_a_state_has_the_rows_of_a_file_that_was_removed_meanwhile(storage, tmp_path):
    (tmp_path / "rows/float32.rows").unlink()
    values = storage.state_dict()["_storage"]
    assert values["image"][:6].equal(make_rows(6)["image"])
    assert not (tmp_path / "rows/float32.rows").exists()


@pytest.mark.parametrize("folder", ["rows", "elsewhere"])
def test_a_checkpointer_of_torchrl_saves_the_rows_also_in_their_folder(storage, tmp_path, folder):
    checkpointer, restored = TensorStorageCheckpointer(), LazyTensorStorage(10)
    checkpointer.dumps(storage, tmp_path / folder)
    checkpointer.loads(restored, tmp_path / folder)
    for each in (restored, storage):
        assert same(each[:].to_dict(), make_rows(6).to_dict())


def test_tensordict_does_not_take_the_folder_for_one_without_entries(storage, tmp_path):
    with pytest.raises(FileNotFoundError):
        TensorDict.load_memmap(tmp_path / "rows")


def test_files_of_an_earlier_storage_are_kept_and_nothing_is_stored(storage, tmp_path):
    before = (tmp_path / "rows/float32.rows").read_bytes()
    del storage
    (tmp_path / "rows/signals.memmap").unlink()
    second = SignalMemmapStorage(10, scratch_dir=tmp_path / "rows")
    with pytest.raises(FileExistsError, match=r"\.rows"):
        second.set(torch.arange(6), make_rows(6, first=50))
    assert len(second) == 0 and not second.initialized
    assert (tmp_path / "rows/float32.rows").read_bytes() == before
    assert names_in(tmp_path) == {"float32.rows", "bool.rows", "int64.rows"}


@pytest.mark.parametrize("kwargs", [{"scratch_dir": None}, {"shared_init": True}])
def test_storages_that_torchrl_maps_for_others_have_a_file_an_entry(kwargs, tmp_path):
    storage = SignalMemmapStorage(10, **{"scratch_dir": tmp_path, **kwargs})
    storage.set(torch.arange(6), make_rows(6))
    assert not any(isinstance(entry, PackedTensor) for entry in storage._storage.values(True, True))
    assert not list(Path(tmp_path).rglob("*.rows"))
    assert same(storage.get(torch.arange(6)).to_dict(), make_rows(6).to_dict())


def test_two_dimensions_of_slots_are_packed_too(tmp_path):
    storage = SignalMemmapStorage(12, scratch_dir=tmp_path, ndim=2)
    rows = torch.stack([make_rows(3), make_rows(3, first=100)], 1)
    storage.set(slice(0, 3), rows)
    assert isinstance(storage._storage["image"], PackedTensor)
    assert same(storage[:].to_dict(), rows.to_dict())
