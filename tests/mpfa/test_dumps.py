"""Folders of saved buffers: whole or absent, damage is noticed, and nothing in them is executed."""

import json
import os
import pickle
import random
import signal
import subprocess
import sys
import threading
import time
import zlib
from pathlib import Path

import pytest
from torchrl.data import CompressedListStorage, LazyTensorStorage
from torchrl.data.replay_buffers import RandomSampler

from tests.mpfa.transitions import Trap, make_buffer, make_transitions, rejected, train_rounds
from torchrl_mpfa import SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.saving import MANIFEST, new_dump, open_dump


@pytest.fixture
def dumped(tmp_path):
    buffer = make_buffer(16)
    buffer.extend(make_transitions(12))
    train_rounds(buffer, 3)
    buffer.dumps(tmp_path / "buffer")
    return tmp_path / "buffer"


def check_rejected(folder, match):
    """Check that loading a folder raises and changes nothing."""
    buffer = make_buffer(16, seed=5)
    buffer.extend(make_transitions(7, seed=4))
    with rejected(buffer, ValueError, match):
        buffer.loads(folder)


def sealed_by_hand(path, folder):
    """The manifest of whatever is there, links to folders left out."""
    found = sorted(file for file in folder.rglob("*") if file.is_file() and file.name != MANIFEST)
    files = {
        file.relative_to(folder).as_posix(): [file.stat().st_size, zlib.crc32(file.read_bytes())]
        for file in found
    }
    manifest = {"format": 2, "folder": os.path.relpath(folder, path), "files": files}
    (path / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")


@pytest.mark.parametrize("indices", [True, False])
def test_text_that_torchrl_would_evaluate_is_never_read(tmp_path, indices):
    trap = tmp_path / "trap"

    def make(kind):
        return SignalReplayBuffer(storage=kind(max_size=16), sampler=RandomSampler(), batch_size=2)

    buffer = make(LazyTensorStorage)
    buffer.extend(make_transitions(4))
    buffer.dumps(tmp_path / "buffer")
    folder = tmp_path / "buffer/dump-1"
    code = {"__type__": "torch.dtype", "value": f"__import__('os').mkdir({str(trap)!r})"}
    (folder / "storage/metadata.json").write_text(json.dumps([code]), encoding="utf-8")
    if indices:
        (folder / "storage/data_indices.json").write_text("[0]", encoding="utf-8")
    sealed_by_hand(tmp_path / "buffer", folder)
    with pytest.raises((ValueError, FileNotFoundError), match=r"data_indices\.json|Data indices"):
        make(CompressedListStorage).loads(tmp_path / "buffer")
    assert not trap.exists()


def replace_by_link(path):
    path.rename(path.with_name("moved"))
    path.symlink_to("moved")


@pytest.mark.parametrize(
    ("place", "spoil", "words"),
    [
        ("dump-1/storage/observation.memmap", replace_by_link, "observation.memmap is a link"),
        ("dump-1/storage", replace_by_link, "dump-1/storage is a link"),
        ("dump-1/storage/none", lambda path: path.symlink_to("nothing"), "storage/none is a link"),
        ("dump-1/storage/pipe", os.mkfifo, "storage/pipe is a link or a device"),
        ("dump-1", replace_by_link, "it names the folder 'dump-1', which is not the dump's own"),
        (MANIFEST, replace_by_link, f"it has no {MANIFEST}"),
    ],
)
def test_link_or_pipe_in_a_folder_is_rejected(dumped, place, spoil, words):
    spoil(dumped / place)
    check_rejected(dumped, words)


def test_folder_is_loaded_through_a_link_to_it(dumped, tmp_path):
    (tmp_path / "latest").symlink_to(dumped)
    make_buffer(16).loads(tmp_path / "latest")
    make_buffer(16).storage.loads(tmp_path / "latest/dump-1/storage")


@pytest.mark.parametrize("place", [".", "dump-1", "dump-1/storage"])
@pytest.mark.parametrize("name", ["prefetch.pkl", "other.pickle", "0"])
@pytest.mark.parametrize("sealed", [False, True])
def test_file_that_would_be_unpickled_is_never_read(dumped, tmp_path, place, name, sealed):
    trap = tmp_path / "trap"
    (dumped / place / name).write_bytes(pickle.dumps(Trap(trap)))
    if sealed and place != ".":
        sealed_by_hand(dumped, dumped / "dump-1")
    if place == ".":
        make_buffer(16).loads(dumped)
    else:
        check_rejected(dumped, rf"{name} could execute anything when it is read")
    assert not trap.exists()


def test_folder_of_torchrl_is_rejected_and_not_unpickled(tmp_path):
    trap = tmp_path / "trap"
    (tmp_path / "buffer").mkdir()
    (tmp_path / "buffer/prefetch.pkl").write_bytes(pickle.dumps(Trap(trap)))
    for buffer in (make_buffer(16), SignalReplayBuffer(storage=SignalTensorStorage(4))):
        with pytest.raises(
            ValueError, match=r"buffer is not a complete dump .*: it has no manifest"
        ):
            buffer.loads(tmp_path / "buffer")
    assert not trap.exists()


def files_of(folder):
    beside = (MANIFEST, ".lock")
    return sorted(file for file in folder.rglob("*") if file.is_file() and file.name not in beside)


def test_flipped_bit_of_a_folder_is_noticed(dumped):
    chance = random.Random(0)
    for _ in range(60):
        file = chance.choice([*files_of(dumped), dumped / MANIFEST])
        whole = file.read_bytes()
        damaged = bytearray(whole)
        bit = chance.randrange(len(whole) * 8)
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"is damaged|is missing|is not part|format of"):
            open_dump(dumped)
        file.write_bytes(whole)
    make_buffer(16).loads(dumped)


def test_missing_short_or_unknown_file_of_a_folder_is_rejected_by_name(dumped):
    for file in files_of(dumped):
        whole = file.read_bytes()
        file.write_bytes(whole[:-1])
        with pytest.raises(ValueError, match=f"{file.name} is damaged: its size or checksum is"):
            open_dump(dumped)
        file.unlink()
        with pytest.raises(ValueError, match=f"{file.name} is missing"):
            open_dump(dumped)
        file.write_bytes(whole)
    (dumped / "dump-1/storage/more.memmap").write_bytes(b"1")
    check_rejected(dumped, "more.memmap is not part of the dump")


def test_manifest_that_names_a_folder_outside_is_rejected(dumped):
    text = (dumped / MANIFEST).read_text(encoding="utf-8")
    (dumped / MANIFEST).write_text(text.replace('"dump-1"', '"../dump-1"'), encoding="utf-8")
    check_rejected(dumped, "manifest.json is damaged: it names the folder '../dump-1'")
    with pytest.raises(FileNotFoundError, match=r"no such folder: .*none"):
        make_buffer(16).loads(dumped / "none")


def test_failed_dump_leaves_the_old_folder_alone(dumped, monkeypatch):
    buffer = make_buffer(16)
    buffer.extend(make_transitions(5))

    def crash(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(buffer.writer, "dumps", crash)
    with pytest.raises(KeyboardInterrupt):
        buffer.dumps(dumped)
    assert sorted(os.listdir(dumped)) == [".lock", "dump-1", MANIFEST]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 12


def test_dump_removes_the_old_folder_and_leftovers(dumped):
    (dumped / "dump-7").mkdir()
    (dumped / "notes.txt").write_text("mine")
    buffer = make_buffer(16)
    buffer.extend(make_transitions(5))
    buffer.dumps(dumped)
    assert sorted(os.listdir(dumped)) == [".lock", "dump-8", MANIFEST, "notes.txt"]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 5


def test_concurrent_dumps_wait_for_each_other(dumped):
    later = make_buffer(16)
    later.extend(make_transitions(3))
    thread = threading.Thread(target=later.dumps, args=[dumped])
    with new_dump(dumped) as folder:
        thread.start()
        thread.join(0.2)
        assert thread.is_alive()
        assert sorted(os.listdir(dumped)) == [".lock", "dump-1", folder.name, MANIFEST]
    thread.join()
    assert sorted(os.listdir(dumped)) == [".lock", "dump-3", MANIFEST]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 3


DUMPING = """
import sys, torch
from tests.mpfa.transitions import make_buffer, make_transitions
buffer = make_buffer(16)
for number in range(10**9):
    buffer.extend(make_transitions(1, first=number))
    buffer.dumps(sys.argv[1])
    print(number, flush=True)
"""


@pytest.mark.slow
def test_killed_dump_leaves_the_old_folder_or_the_new_one(tmp_path):
    chance = random.Random(0)
    for number in range(20):
        process = subprocess.Popen(
            [sys.executable, "-c", DUMPING, str(tmp_path / "buffer")],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
            text=True,
        )
        with process:
            process.stdout.readline()
            time.sleep(chance.random() * 0.2)
            process.send_signal(signal.SIGKILL)
        buffer = make_buffer(16)
        buffer.loads(tmp_path / "buffer")
        assert 0 < len(buffer) <= 16, number
