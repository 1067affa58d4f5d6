"""A device beside the CPU for the tests of the replay parts."""

import pytest
import torch

from tests.mpfa.second_device import emulated


@pytest.fixture
def second_device(monkeypatch):
    """``DEVICE`` is there: a GPU, or where there is none what stands for it, and counts."""
    if torch.cuda.is_available():
        yield None
        return
    with emulated(monkeypatch) as machine:
        yield machine
