"""The two ways to write, sample and update: compiled loops, and PyTorch."""

from torchrl_mpfa import native

PATHS = ("compiled", "pytorch")


def take(path, monkeypatch):
    """Parts that are made from now on take this path."""
    monkeypatch.setenv("TORCHRL_MPFA_NATIVE", "1" if path == "compiled" else "0")
    native.find_loops.cache_clear()
    assert (native.find_loops() is None) == (path == "pytorch")
