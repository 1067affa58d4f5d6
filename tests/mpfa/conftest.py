"""A device beside the CPU, and compiled loops that are looked for anew, for the replay parts."""

import pytest
import torch

from tests.mpfa.second_device import emulated
from torchrl_mpfa import native


@pytest.fixture
def second_device(monkeypatch):
    """``DEVICE`` is there: a GPU, or where there is none what stands for it, and counts."""
    if torch.cuda.is_available():
        yield None
        return
    with emulated(monkeypatch) as machine:
        yield machine


@pytest.fixture
def own_library(monkeypatch):
    """A test looks for the compiled loops by its own environment, and so does the next one."""
    monkeypatch.delenv("TORCHRL_MPFA_NATIVE", raising=False)
    native.find_loops.cache_clear()
    yield
    native.find_loops.cache_clear()
