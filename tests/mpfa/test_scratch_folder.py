"""Memory-mapped signals: no storage ever empties the file of another."""

import gc
import os

import pytest
import torch

from tests.mpfa.transitions import make_filled, make_transitions, train_rounds
from torchrl_mpfa import SignalMemmapStorage


@pytest.mark.parametrize("capacity", [100, 16, 3])
def test_a_folder_in_use_is_rejected_and_the_user_of_it_goes_on(tmp_path, capacity):
    buffer = make_filled(16, storage=SignalMemmapStorage(16, scratch_dir=tmp_path))
    before = buffer.storage.signal_table.rows.clone()
    with pytest.raises(FileExistsError, match=r"signals.memmap is in use by a living storage"):
        SignalMemmapStorage(capacity, scratch_dir=tmp_path, existsok=True)
    assert torch.equal(before.nan_to_num(-1), buffer.storage.signal_table.rows.nan_to_num(-1))
    train_rounds(buffer, 2)


def test_files_of_an_earlier_storage_are_overwritten_only_if_asked(tmp_path):
    storage = SignalMemmapStorage(16, scratch_dir=tmp_path)
    storage.set(torch.arange(3), make_transitions(3))
    size = os.stat(tmp_path / "signals.memmap").st_size
    del storage
    gc.collect()
    with pytest.raises(FileExistsError, match="is there from an earlier storage: pass existsok=Tr"):
        SignalMemmapStorage(8, scratch_dir=tmp_path)
    assert os.stat(tmp_path / "signals.memmap").st_size == size
    storage = SignalMemmapStorage(8, scratch_dir=tmp_path, existsok=True)
    assert storage.signal_table.size == 0
    storage.set(torch.arange(3), make_transitions(3))
    assert os.stat(tmp_path / "signals.memmap").st_size == size // 2


def test_a_storage_that_is_gone_leaves_its_folder_free(tmp_path):
    for _ in range(3):
        storage = SignalMemmapStorage(8, scratch_dir=tmp_path, existsok=True)
        del storage
        gc.collect()
