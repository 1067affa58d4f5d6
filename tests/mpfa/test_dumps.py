"""Folders of saved buffers: whole or absent, damage is noticed, and nothing in them is executed."""

import json
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
from torchrl.data import (
    CompressedListStorage,
    LazyMemmapStorage,
    LazyTensorStorage,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers import RandomSampler
from torchrl.envs.transforms import Transform

from tests.mpfa.transitions import (
    Trap,
    make_buffer,
    make_transitions,
    rejected,
    same,
    train_rounds,
)
from torchrl_mpfa import (
    MPFASampler,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalTensorStorage,
)
from torchrl_mpfa.saving import load_safely, save_atomically


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


def with_files(dumped, **files):
    """Put files in the place of the state of the storage of a dump, as an attacker could."""
    path = dumped / "state.pt"
    content = {name: torch.tensor([*text], dtype=torch.uint8) for name, text in files.items()}
    save_atomically({**load_safely(path), "_storage": {"_files": content}}, path)


def test_text_that_torchrl_would_evaluate_is_never_read(dumped, tmp_path):
    trap = tmp_path / "trap"
    code = {"__type__": "torch.dtype", "value": f"__import__('os').mkdir({str(trap)!r})"}
    files = {"metadata.json": json.dumps([code]).encode(), "data_indices.json": b"[0]"}
    with_files(dumped, **files)
    buffer = SignalReplayBuffer(storage=CompressedListStorage(16), sampler=RandomSampler())
    buffer.set_sampler(make_buffer(16).sampler)
    with pytest.raises(ValueError, match=r"data_indices\.json could execute anything"):
        buffer.loads(dumped)
    assert not trap.exists()


@pytest.mark.parametrize("name", ["prefetch.pkl", "next/other.pickle", "0", "meta.json/x.PKL"])
def test_file_that_would_be_unpickled_is_never_read(dumped, tmp_path, name):
    trap = tmp_path / "trap"
    with_files(dumped, **{name: pickle.dumps(Trap(trap))})
    with pytest.raises(ValueError, match=rf"{name} could execute anything when it is read"):
        make_buffer(16).loads(dumped)
    assert not trap.exists()


@pytest.mark.parametrize("name", ["../x.json", "/tmp/x.json", "a/../../x.json"])
def test_file_outside_of_its_folder_is_never_written(dumped, name):
    with_files(dumped, **{name: b"{}"})
    with pytest.raises(ValueError, match="files of a part must lie in its folder, got"):
        make_buffer(16).loads(dumped)


def test_folder_is_loaded_through_a_link_to_it(dumped, tmp_path):
    (tmp_path / "latest").symlink_to(dumped)
    make_buffer(16).loads(tmp_path / "latest")


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_parts_of_a_buffer_of_torchrl_s_save_themselves(tmp_path, kind):
    def make():
        storage, sampler = kind(16), MPFASampler(16)
        return TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=4)

    first, second = make(), make()
    first.extend(make_transitions(12))
    first.dumps(tmp_path / "buffer")
    for part in ("storage", "sampler"):
        assert [file.name for file in (tmp_path / "buffer" / part).iterdir()] == ["state.pt"]
    second.loads(tmp_path / "buffer")
    assert same(first[:].to_dict(), second[:].to_dict())
    assert same(first.sampler.state_dict(), second.sampler.state_dict())


def test_writer_of_the_highest_values_is_restored(tmp_path):
    first, second = (SignalReplayBuffer(storage=SignalTensorStorage(4)) for _ in range(2))
    for buffer in (first, second):
        # TorchRL's makes a list of a nested key when it is loaded.
        buffer.set_writer(TensorDictMaxValueWriter(rank_key="observation"))
    first.extend(make_transitions(8))
    first.dumps(tmp_path / "buffer")
    second.loads(tmp_path / "buffer")
    for buffer in (first, second):
        buffer.extend(make_transitions(4, first=2, seed=1))
        buffer.extend(make_transitions(2, first=6, seed=2))
    assert same(first[:].to_dict(), second[:].to_dict())


@pytest.mark.parametrize(
    ("kind", "file"),
    [(LazyMemmapStorage, "observation.memmap"), (SignalMemmapStorage, "float32.rows")],
)
def test_rows_are_mapped_in_the_folder_of_the_storage_that_loads_them(dumped, tmp_path, kind, file):
    buffer = make_buffer(16, storage=kind(16, scratch_dir=tmp_path / "rows"))
    buffer.loads(dumped)
    assert (tmp_path / "rows" / file).exists()
    assert buffer[:]["observation"].flatten().tolist() == list(range(12))


@pytest.mark.parametrize("kind", [LazyTensorStorage, SignalTensorStorage, SignalMemmapStorage])
def test_names_with_dots_and_entries_without_numbers_are_restored(tmp_path, kind):
    def make(name):
        mapped = {"scratch_dir": tmp_path / name} if kind is SignalMemmapStorage else {}
        return make_buffer(8, storage=kind(8, **mapped))

    rows = make_transitions(4)
    rows["a.b"], rows["c", "d.e"], rows["none"] = torch.ones(4), torch.ones(4, 2), torch.ones(4, 0)
    first, second = make("first"), make("second")
    first.extend(rows)
    first.dumps(tmp_path / "buffer")
    second.loads(tmp_path / "buffer")
    assert same(first[:].to_dict(), second[:].to_dict())


def test_texts_are_rejected_at_the_save(tmp_path):
    buffer = make_buffer(8)
    rows = make_transitions(2)
    rows["task"] = ["one", "two"]
    buffer.extend(rows)
    with pytest.raises(ValueError, match=r"must be tensors to be saved, got .* at 'task'"):
        buffer.dumps(tmp_path / "buffer")


def test_what_could_not_be_read_again_is_rejected_before_anything_is_written(dumped):
    class Odd(Transform):
        def get_extra_state(self):
            return Trap("nowhere")

        def set_extra_state(self, state):
            pass

    buffer = make_buffer(16, transform=Odd())
    before = (dumped / "state.pt").read_bytes()
    with pytest.raises(pickle.UnpicklingError, match="Weights only load failed"):
        buffer.dumps(dumped)
    assert os.listdir(dumped) == ["state.pt"]
    assert (dumped / "state.pt").read_bytes() == before


def test_folder_of_torchrl_is_rejected_and_not_unpickled(tmp_path):
    trap = tmp_path / "trap"
    (tmp_path / "buffer").mkdir()
    (tmp_path / "buffer/prefetch.pkl").write_bytes(pickle.dumps(Trap(trap)))
    for buffer in (make_buffer(16), SignalReplayBuffer(storage=SignalTensorStorage(4))):
        for folder in ("buffer", "none"):
            with pytest.raises(FileNotFoundError, match=f"{folder} must be a folder of dumps"):
                buffer.loads(tmp_path / folder)
    assert not trap.exists()


def test_flipped_bit_or_short_file_of_a_folder_is_noticed(dumped):
    chance, file = random.Random(0), dumped / "state.pt"
    whole = file.read_bytes()
    for _ in range(60):
        damaged = bytearray(whole)
        bit = chance.randrange(len(whole) * 8)
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        check_rejected(dumped, r"is damaged|is cut short")
    file.write_bytes(whole[:-1])
    check_rejected(dumped, r"state\.pt is cut short")
    file.write_bytes(whole)
    make_buffer(16).loads(dumped)


def test_failed_dump_leaves_the_old_folder_alone(dumped, monkeypatch):
    buffer = make_buffer(16)
    buffer.extend(make_transitions(5))

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(KeyboardInterrupt):
        buffer.dumps(dumped)
    assert os.listdir(dumped) == ["state.pt"]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 12


def test_dump_replaces_the_state_and_leaves_all_else(dumped):
    (dumped / "notes.txt").write_text("mine")
    buffer = make_buffer(16)
    buffer.extend(make_transitions(5))
    buffer.dumps(dumped)
    assert sorted(os.listdir(dumped)) == ["notes.txt", "state.pt"]
    found = make_buffer(16)
    found.loads(dumped)
    assert len(found) == 5


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
