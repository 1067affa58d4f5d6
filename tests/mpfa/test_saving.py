"""Files: written whole or not at all, and read without executing anything."""

import os
import pickle

import pytest
import torch

from torchrl_mpfa import load_safely, save_atomically


def test_what_is_saved_is_read_again(tmp_path):
    state = {"a": torch.arange(3), "b": {"c": [1, 2.5, None, "text"]}}
    save_atomically(state, tmp_path / "state.pt")
    found = load_safely(tmp_path / "state.pt")
    assert found["a"].tolist() == [0, 1, 2]
    assert found["b"] == state["b"]
    assert os.listdir(tmp_path) == ["state.pt"]


class CannotBeSaved:
    def __reduce__(self):
        raise RuntimeError("disk full")


def test_a_write_that_fails_leaves_the_old_file_and_no_rest(tmp_path):
    path = tmp_path / "state.pt"
    save_atomically({"step": 1}, path)
    with pytest.raises(RuntimeError, match="disk full"):
        save_atomically({"step": 2, "bad": CannotBeSaved()}, path)
    assert load_safely(path) == {"step": 1}
    assert os.listdir(tmp_path) == ["state.pt"]


def test_a_crash_before_the_rename_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "state.pt"
    save_atomically({"step": 1}, path)

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(KeyboardInterrupt):
        save_atomically({"step": 2}, path)
    assert load_safely(path) == {"step": 1}
    assert os.listdir(tmp_path) == ["state.pt"]


class Malicious:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("writer", ["pickle", "torch"])
def test_a_file_with_code_in_it_is_refused_and_not_executed(tmp_path, writer):
    trap, path = tmp_path / "trap", tmp_path / "state.pt"
    if writer == "torch":
        torch.save({"a": Malicious(str(trap))}, path)
    else:
        path.write_bytes(pickle.dumps({"a": Malicious(str(trap))}, protocol=2))
    with pytest.raises(pickle.UnpicklingError):
        load_safely(path)
    assert not trap.exists()
    # The trap works: without the safe reader it would have snapped.
    torch.load(path, weights_only=False) if writer == "torch" else pickle.loads(path.read_bytes())
    assert trap.exists()


@pytest.mark.parametrize("size", [0, 10, 200])
def test_a_truncated_file_is_an_error(tmp_path, size):
    path = tmp_path / "state.pt"
    save_atomically({"a": torch.arange(100)}, path)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises((RuntimeError, EOFError, pickle.UnpicklingError)):
        load_safely(path)


def test_a_file_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_safely(tmp_path / "none.pt")
