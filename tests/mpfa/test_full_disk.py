"""A disk without room: an error that names the file, and everything else as it was."""

import errno
import os
from pathlib import Path

import pytest
import torch
from tensordict import MemoryMappedTensor
from torchrl.data import FlatStorageCheckpointer

from tests.mpfa.transitions import make_buffer, make_filled, make_transitions
from torchrl_mpfa import SignalMemmapStorage
from torchrl_mpfa.saving import save_atomically, write_text_atomically


def no_space(*_):
    """Fail as the system does where a disk has no room."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Full:
    """A file on a full disk: what PyTorch and Python write in it fails."""

    write = staticmethod(no_space)

    def __init__(self, file):
        self._file = file

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._file.close()


@pytest.fixture
def no_room(monkeypatch):
    """Let every new file be one on a full disk."""
    opened = Path.open

    def open_full(path, mode="r", *arguments, **kwargs):
        file = opened(path, mode, *arguments, **kwargs)
        return Full(file) if "x" in mode else file

    monkeypatch.setattr(Path, "open", open_full)


@pytest.mark.parametrize(
    "save",
    [
        lambda path: save_atomically({"values": torch.ones(100_000)}, path),
        lambda path: write_text_atomically("text", path),
    ],
    ids=["state", "text"],
)
def test_error_of_a_save_names_file_and_cause_and_the_old_file_stays(tmp_path, no_room, save):
    path = tmp_path / "state.pt"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="No space left on device") as caught:
        save(path)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert [file.name for file in tmp_path.iterdir()] == ["state.pt"]
    assert path.read_bytes() == b"old"


def test_other_errors_of_a_save_stay_as_they_are(tmp_path):
    with pytest.raises(AttributeError, match="local object"):
        save_atomically({"function": lambda: None}, tmp_path / "state.pt")


def files_of(storage):
    """Files of the memory-mapped entries and of the signals."""
    entries = storage._storage.values(True, True)
    return [Path(entry.filename) for entry in entries if isinstance(entry, MemoryMappedTensor)]


def test_memory_mapped_files_have_their_room_on_the_disk_before_they_are_used(tmp_path):
    storage = SignalMemmapStorage(10_000, scratch_dir=tmp_path)
    buffer = make_buffer(10_000, storage=storage)
    buffer.extend(make_transitions(1))
    found = [*files_of(storage), tmp_path / "signals.memmap"]
    assert len(found) > 2
    for file in found:
        assert file.stat().st_blocks * 512 >= file.stat().st_size > 10_000


@pytest.mark.parametrize("folder", [True, False], ids=["in a folder", "temporary"])
def test_first_write_without_room_raises_and_stores_nothing(tmp_path, monkeypatch, folder):
    storage = SignalMemmapStorage(100, scratch_dir=tmp_path if folder else None)
    buffer = make_buffer(100, storage=storage)
    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", no_space)
        with pytest.raises(OSError, match="No space left on device: '/"):
            buffer.extend(make_transitions(4))
        assert len(buffer) == 0
        assert not storage.initialized
    buffer.extend(make_transitions(4))
    assert buffer[:]["observation"].flatten().tolist() == [0.0, 1.0, 2.0, 3.0]


def test_signals_without_room_name_their_file(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "posix_fallocate", no_space)
    with pytest.raises(OSError, match=r"No space left on device: '.*signals.memmap'"):
        SignalMemmapStorage(100, scratch_dir=tmp_path)


def test_dump_without_room_leaves_the_dump_before(tmp_path, request):
    buffer, fresh = make_filled(), make_buffer()
    buffer.dumps(tmp_path)
    buffer.extend(make_transitions(4, first=50))
    request.getfixturevalue("no_room")
    with pytest.raises(OSError, match="No space left on device"):
        buffer.dumps(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["state.pt"]
    fresh.loads(tmp_path)
    assert fresh[:]["observation"].flatten().tolist() == list(range(16))


def test_checkpointer_without_room_raises_and_is_not_killed(tmp_path, monkeypatch):
    buffer = make_filled()
    buffer.storage.checkpointer = FlatStorageCheckpointer()
    monkeypatch.setattr(os, "posix_fallocate", no_space)
    with pytest.raises(OSError, match="No space left on device"):
        buffer.dumps(tmp_path / "dump")
    assert not (tmp_path / "dump").exists()
