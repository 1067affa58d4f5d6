"""What touches trees, rows and tables is tested with compiled loops, and with PyTorch instead."""

import pytest

from tests.mpfa.native.paths import PATHS, take
from torchrl_mpfa import native


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    """What samplers and storages of a test take."""
    take(request.param, monkeypatch)
    yield request.param
    native.find_loops.cache_clear()
