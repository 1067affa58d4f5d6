"""What holds for all tests: no log lines of TorchRL, one thread, a fixed global seed."""

import gc
import logging
import os

# Also for the processes that tests start: two of them and two of pytest's on two cores.
os.environ["OMP_NUM_THREADS"] = "1"

import pytest
import torch
from torchrl import torchrl_logger

# TorchRL tells of every storage that it allocates.
torchrl_logger.setLevel(logging.WARNING)


def pytest_collection_finish() -> None:
    """Leave what was imported out of later garbage collections, each of which takes 0.3 s of it."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def one_thread():
    """TorchRL's parallel environments leave more, and tiny operations then wait for each other."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def fixed_seed():
    """Networks start from torch's global generator; every test starts it at the same place."""
    # torch.manual_seed would also keep a traceback for each accelerator that is not there.
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(0)
