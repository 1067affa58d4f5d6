"""Memory-mapped signals: no storage ever empties the file of another, in no process."""

import copy
import gc
import os
import pickle
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from tests.mpfa.transitions import make_buffer, make_filled, make_transitions, same, train_rounds
from torchrl_mpfa import SignalMemmapStorage


@pytest.mark.parametrize("capacity", [100, 16, 3])
def test_folder_in_use_is_rejected_and_its_user_unaffected(tmp_path, capacity):
    buffer = make_filled(16, storage=SignalMemmapStorage(16, scratch_dir=tmp_path))
    before = buffer.storage.signal_table.rows.clone()
    with pytest.raises(FileExistsError, match=r"signals.memmap is in use by a living storage"):
        SignalMemmapStorage(capacity, scratch_dir=tmp_path, existsok=True)
    assert torch.equal(before.nan_to_num(-1), buffer.storage.signal_table.rows.nan_to_num(-1))
    train_rounds(buffer, 2)


def test_files_of_an_earlier_storage_are_overwritten_only_if_asked(tmp_path):
    storage = SignalMemmapStorage(16, scratch_dir=tmp_path)
    buffer = make_buffer(16, storage=storage)
    buffer.extend(make_transitions(3))
    size = os.stat(tmp_path / "signals.memmap").st_size
    del storage, buffer
    gc.collect()
    with pytest.raises(FileExistsError, match="is there from an earlier storage: pass existsok=Tr"):
        SignalMemmapStorage(8, scratch_dir=tmp_path)
    assert os.stat(tmp_path / "signals.memmap").st_size == size
    storage = SignalMemmapStorage(8, scratch_dir=tmp_path, existsok=True)
    buffer = make_buffer(8, storage=storage)
    assert storage.signal_table.size == 0
    buffer.extend(make_transitions(3))
    assert os.stat(tmp_path / "signals.memmap").st_size == size // 2


def test_a_storage_that_is_gone_leaves_its_folder_free(tmp_path):
    for _ in range(3):
        storage = SignalMemmapStorage(8, scratch_dir=tmp_path, existsok=True)
        del storage
        gc.collect()


@pytest.mark.parametrize("folder", [True, False])
@pytest.mark.parametrize("filled", [0, 9, 16])
@pytest.mark.parametrize("way", [copy.deepcopy, lambda buffer: pickle.loads(pickle.dumps(buffer))])
def test_copy_has_its_own_files_and_samples_like_the_first(tmp_path, folder, filled, way):
    kwargs = {"scratch_dir": tmp_path} if folder else {}
    first = make_buffer(16, storage=SignalMemmapStorage(16, **kwargs))
    if filled:
        first.extend(make_transitions(filled))
        train_rounds(first, 2)
    second, third = way(first), way(first)
    third.extend(make_transitions(12, seed=4, first=500))
    for each in (first, second):
        each.extend(make_transitions(5, seed=1, first=100))
    assert same(train_rounds(first, 3), train_rounds(second, 3))
    assert same(first[:].to_dict(), second[:].to_dict())
    assert (third[:]["observation"] >= 500).sum() == 12
    assert second.storage._storage.is_memmap()


CODE = """
import sys
import torchrl_mpfa, torchrl_mpfa.integrations.trainer
print('hydra' in sys.modules)
torchrl_mpfa.SignalMemmapStorage(3, scratch_dir=sys.argv[1], existsok=True)
"""


def test_import_has_no_hydra_and_folder_in_use_is_rejected(tmp_path):
    buffer = make_filled(16, storage=SignalMemmapStorage(16, scratch_dir=tmp_path))
    before = buffer.storage.signal_table.rows.clone()
    ended = subprocess.run(
        [sys.executable, "-c", CODE, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[3],
    )
    assert ended.stdout.split()[-1] == "False"
    assert ended.returncode == 1
    assert "signals.memmap is in use by a living storage" in ended.stderr
    assert torch.equal(before.nan_to_num(-1), buffer.storage.signal_table.rows.nan_to_num(-1))
    train_rounds(buffer, 2)


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="Linux says what it was told")
def test_the_system_reads_no_rows_ahead(tmp_path):
    make_filled(16, storage=SignalMemmapStorage(16, scratch_dir=tmp_path))
    mappings = Path("/proc/self/smaps").read_text(encoding="utf-8").split("VmFlags:")
    flags = [
        after.splitlines()[0].split()
        for before, after in pairwise(mappings)
        if f"{tmp_path}/float32.rows" in before
    ]
    assert flags and all("rr" in names for names in flags)
