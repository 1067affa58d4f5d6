"""Tests that need another process; one for all, as each takes seconds to import PyTorch."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.mpfa.transitions import make_filled, train_rounds
from torchrl_mpfa import SignalMemmapStorage

CODE = """
import sys
import torchrl_mpfa, torchrl_mpfa.integrations.trainer
print('hydra' in sys.modules)
torchrl_mpfa.SignalMemmapStorage(3, scratch_dir=sys.argv[1], existsok=True)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("scratch")


@pytest.fixture(scope="module")
def buffer(folder):
    buffer = make_filled(16, storage=SignalMemmapStorage(16, scratch_dir=folder))
    return buffer


@pytest.fixture(scope="module")
def before(buffer):
    return buffer.storage.signal_table.rows.clone()


@pytest.fixture(scope="module")
def ended(folder, before):
    """The other process."""
    return subprocess.run(
        [sys.executable, "-c", CODE, str(folder)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )


def test_importing_the_package_does_not_import_hydra(ended):
    assert ended.stdout.split()[-1] == "False"


def test_folder_in_use_is_rejected_and_its_user_unaffected(ended, buffer, before):
    assert ended.returncode == 1
    assert "signals.memmap is in use by a living storage" in ended.stderr
    assert torch.equal(before.nan_to_num(-1), buffer.storage.signal_table.rows.nan_to_num(-1))
    train_rounds(buffer, 2)
