"""What holds for all tests: no log lines of TorchRL, one thread, a fixed global seed."""

import logging

import pytest
import torch
from torchrl import torchrl_logger

torch.set_num_threads(1)
# TorchRL tells of every storage that it allocates.
torchrl_logger.setLevel(logging.WARNING)


@pytest.fixture(autouse=True)
def fixed_seed():
    """Networks start from torch's global generator; every test starts it at the same place."""
    torch.manual_seed(0)
