"""What needs another process: one test for all, as PyTorch takes seconds to import."""

import subprocess
import sys
from pathlib import Path

import torch

from tests.mpfa.transitions import make_filled, train_rounds
from torchrl_mpfa import SignalMemmapStorage

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
        cwd=Path(__file__).parents[2],
    )
    assert ended.stdout.split()[-1] == "False"
    assert ended.returncode == 1
    assert "signals.memmap is in use by a living storage" in ended.stderr
    assert torch.equal(before.nan_to_num(-1), buffer.storage.signal_table.rows.nan_to_num(-1))
    train_rounds(buffer, 2)
