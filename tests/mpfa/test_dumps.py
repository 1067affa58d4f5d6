"""Dumps: whole or absent, damage is noticed, and nothing in them is executed."""

import os
import pickle
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests.mpfa.transitions import make_buffer, make_transitions, same, snapshot, train_rounds
from torchrl_mpfa import SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.dumps import MANIFEST, new_dump, open_dump, seal_dump


class Trap:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture
def dumped(tmp_path):
    buffer = make_buffer(16)
    buffer.extend(make_transitions(12))
    train_rounds(buffer, 3)
    buffer.dumps(tmp_path / "buffer")
    return tmp_path / "buffer"


def refused(folder, match):
    """Whether loading is refused and changes nothing."""
    buffer = make_buffer(16, seed=5)
    buffer.extend(make_transitions(7, seed=4))
    before = snapshot(buffer)
    with pytest.raises(ValueError, match=match):
        buffer.loads(folder)
    return same(before, snapshot(buffer))


@pytest.mark.parametrize("place", [".", "dump-1", "dump-1/storage"])
@pytest.mark.parametrize("name", ["prefetch.pkl", "other.pickle"])
@pytest.mark.parametrize("sealed", [False, True])
def test_a_file_that_would_be_unpickled_is_never_read(dumped, tmp_path, place, name, sealed):
    trap = tmp_path / "trap"
    (dumped / place / name).write_bytes(pickle.dumps(Trap(str(trap))))
    if sealed and place == "dump-1":
        text = (dumped / MANIFEST).read_text(encoding="utf-8")
        (dumped / MANIFEST).write_text(text.replace('"files": {', f'"files": {{"{name}": [1, 2],'))
    if place == ".":
        make_buffer(16).loads(dumped)
    else:
        assert refused(dumped, rf"{name} could execute anything when it is read")
    assert not trap.exists()


def test_what_torchrl_wrote_is_refused_and_not_unpickled(tmp_path):
    trap = tmp_path / "trap"
    (tmp_path / "buffer").mkdir()
    (tmp_path / "buffer/prefetch.pkl").write_bytes(pickle.dumps(Trap(str(trap))))
    for buffer in (make_buffer(16), SignalReplayBuffer(storage=SignalTensorStorage(4))):
        with pytest.raises(
            ValueError, match=r"buffer is not a complete dump .*: it has no manifest"
        ):
            buffer.loads(tmp_path / "buffer")
    assert not trap.exists()


def test_our_dumps_hold_no_pickles(dumped):
    assert {file.suffix for file in dumped.rglob("*") if file.is_file()} == {
        ".memmap",
        ".json",
        ".pt",
    }


def files_of(folder):
    return sorted(file for file in folder.rglob("*") if file.is_file() and file.name != MANIFEST)


def test_every_bit_that_flips_is_noticed(dumped):
    chance = random.Random(0)
    for _ in range(60):
        file = chance.choice([*files_of(dumped), dumped / MANIFEST])
        whole = file.read_bytes()
        damaged = bytearray(whole)
        bit = chance.randrange(len(whole) * 8)
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        assert refused(dumped, "is damaged|is missing|is not part|format of"), (file, bit)
        file.write_bytes(whole)
    make_buffer(16).loads(dumped)


def test_a_missing_short_or_unknown_file_is_refused_by_name(dumped):
    for file in files_of(dumped):
        whole = file.read_bytes()
        file.write_bytes(whole[:-1])
        assert refused(dumped, f"{file.name} is damaged: its size or checksum is wrong")
        file.unlink()
        assert refused(dumped, f"{file.name} is missing")
        file.write_bytes(whole)
    (dumped / "dump-1/storage/more.memmap").write_bytes(b"1")
    assert refused(dumped, "more.memmap is not part of the dump")


def test_a_folder_outside_is_not_followed(dumped):
    text = (dumped / MANIFEST).read_text(encoding="utf-8")
    (dumped / MANIFEST).write_text(text.replace('"dump-1"', '"../dump-1"'), encoding="utf-8")
    assert refused(dumped, "manifest.json is damaged: it names the folder '../dump-1'")
    with pytest.raises(FileNotFoundError, match=r"no such folder: .*none"):
        make_buffer(16).loads(dumped / "none")


def test_a_dump_that_fails_leaves_the_old_one_and_no_rest(dumped, monkeypatch):
    buffer = make_buffer(16)
    buffer.extend(make_transitions(5))

    def crash(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(buffer.writer, "dumps", crash)
    with pytest.raises(KeyboardInterrupt):
        buffer.dumps(dumped)
    assert sorted(os.listdir(dumped)) == ["dump-1", MANIFEST]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 12


def test_the_next_dump_removes_the_old_one_and_what_killed_ones_left(dumped):
    (dumped / "dump-7").mkdir()
    (dumped / "notes.txt").write_text("mine")
    buffer = make_buffer(16)
    buffer.extend(make_transitions(5))
    buffer.dumps(dumped)
    assert sorted(os.listdir(dumped)) == ["dump-8", MANIFEST, "notes.txt"]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 5


def test_a_storage_notices_damage_by_itself(tmp_path):
    first, second = SignalTensorStorage(4), SignalTensorStorage(4)
    first.set(torch.arange(3), make_transitions(3))
    first.dumps(tmp_path / "storage")
    second.loads(tmp_path / "storage")
    assert same(first.state_dict(), second.state_dict())
    file = next((tmp_path / "storage").rglob("*.memmap"))
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(ValueError, match=f"{file.name} is damaged"):
        second.loads(tmp_path / "storage")


def test_folders_are_sealed_and_opened_without_a_buffer(tmp_path):
    with new_dump(tmp_path / "dump") as folder:
        (folder / "a").mkdir()
        (folder / "a/b.json").write_text("{}")
    assert open_dump(tmp_path / "dump") == folder
    (folder / "a/b.json").write_text("[]")
    with pytest.raises(ValueError, match=r"b\.json is damaged"):
        open_dump(tmp_path / "dump")
    seal_dump(tmp_path / "dump", folder)
    assert open_dump(tmp_path / "dump") == folder


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
def test_a_dump_that_is_killed_leaves_the_old_one_or_the_new_one(tmp_path):
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
