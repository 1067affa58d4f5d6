"""Files: written whole or not at all, read without executing anything."""

import os
import pickle
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from tests.mpfa.compiled import fail_with
from tests.mpfa.transitions import Trap, same
from torchrl_mpfa.saving import (
    check_saved,
    check_saved_numbers,
    load_safely,
    save_atomically,
    write_text_atomically,
)


def test_saved_state_is_read_again(tmp_path):
    state = {"a": torch.arange(3), "b": {"c": [1, 2.5, None, "text"]}}
    save_atomically(state, tmp_path / "state.pt")
    found = load_safely(tmp_path / "state.pt")
    assert found["a"].tolist() == [0, 1, 2]
    assert found["b"] == state["b"]
    assert os.listdir(tmp_path) == ["state.pt"]


class CannotBeSaved:
    def __reduce__(self):
        raise KeyboardInterrupt


def crash(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("rename", [crash, os.replace], ids=["at the rename", "in the write"])
@pytest.mark.parametrize("kind", ["state", "text"])
def test_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch, kind, rename):
    path, text = tmp_path / "file", kind == "text"
    write = write_text_atomically if text else save_atomically
    write("α\n" if text else {"step": 1}, path)
    before = path.read_bytes()
    monkeypatch.setattr(os, "replace", rename)
    # A text of half a character cannot be encoded.
    with pytest.raises((KeyboardInterrupt, UnicodeEncodeError)):
        write("β\ud800" if text else {"step": 2, "bad": CannotBeSaved()}, path)
    assert path.read_bytes() == before
    assert path.read_text(encoding="utf-8") == "α\n" if text else load_safely(path) == {"step": 1}
    assert os.listdir(tmp_path) == ["file"]


def test_file_is_on_the_disk_before_it_takes_the_place_of_the_old_one(tmp_path, monkeypatch):
    done = []
    for name in ("fsync", "replace"):
        call = getattr(os, name)
        monkeypatch.setattr(
            os, name, lambda *args, name=name, call=call: (done.append(name), call(*args))
        )
    save_atomically({"step": 1}, tmp_path / "state.pt")
    assert done == ["fsync", "replace"]


def test_leftover_of_another_users_process_stays(tmp_path, monkeypatch):
    leftover = tmp_path / ".state.pt.1-0123456789abcdef.tmp"
    leftover.write_bytes(b"being written")
    monkeypatch.setattr(os, "kill", fail_with(PermissionError()))
    save_atomically({"step": 1}, tmp_path / "state.pt")
    assert leftover.exists()


def test_save_removes_the_leftovers_of_killed_processes_alone(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for name in (f"{gone.pid}", f"{gone.pid}-0123456789abcdef"):
        (tmp_path / f".state.pt.{name}.tmp").write_bytes(b"half")
    alive = tmp_path / f".state.pt.{os.getppid()}.tmp"
    alive.write_bytes(b"being written")
    save_atomically({"step": 1}, tmp_path / "state.pt")
    assert sorted(os.listdir(tmp_path)) == [alive.name, "state.pt"]


def test_concurrent_saves_damage_no_file(tmp_path):
    path = tmp_path / "state.pt"

    def save(number):
        for _ in range(15):
            save_atomically({"of": torch.full((5000,), number)}, path)
            assert len(load_safely(path)["of"].unique()) == 1

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(save, range(3)))
    assert os.listdir(tmp_path) == ["state.pt"]


def test_link_at_the_temporary_name_is_not_followed(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    monkeypatch.setattr("secrets.token_hex", lambda _: "known")
    for name in (f"{os.getpid()}", f"{os.getpid()}-known"):
        (tmp_path / f".table.md.{name}.tmp").symlink_to(victim)
    with pytest.raises(FileExistsError):
        write_text_atomically("text", tmp_path / "table.md")
    assert victim.read_text(encoding="utf-8") == "precious"


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_saved_file_has_ordinary_permissions(tmp_path, mask):
    before = os.umask(mask)
    try:
        save_atomically({}, tmp_path / "state.pt")
    finally:
        os.umask(before)
    assert (tmp_path / "state.pt").stat().st_mode & 0o777 == 0o666 & ~mask


def test_file_with_code_in_it_is_rejected_and_not_executed(tmp_path):
    trap, path = tmp_path / "trap", tmp_path / "state.pt"
    save_atomically({"a": Trap(trap)}, path)
    with pytest.raises(pickle.UnpicklingError, match=r"state\.pt holds more than tensors"):
        load_safely(path)
    assert not trap.exists()
    # The trap works: without the safe reader it would have snapped.
    torch.load(path, weights_only=False)
    assert trap.exists()


def test_foreign_file_is_rejected_by_name(tmp_path):
    trap, path = tmp_path / "trap", tmp_path / "state.pt"
    for content in (pickle.dumps({"a": Trap(trap)}, protocol=2), b"", b"a,b\n1,2\n" * 50):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"state\.pt is cut short, or was not written by"):
            load_safely(path)
    assert not trap.exists()


def test_flipped_bit_is_noticed_or_harmless(tmp_path):
    path = tmp_path / "state.pt"
    state = {"a": torch.rand(300), "b": {"c": [1, 2.5, None, "text"]}, "d": torch.arange(99)}
    save_atomically(state, path)
    whole = path.read_bytes()
    noticed = 0
    for bit in random.Random(0).sample(range(len(whole) * 8), 200):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            assert same(load_safely(path), state)
        except ValueError as error:
            assert "state.pt is" in str(error)
            noticed += 1
    assert noticed > 190


def test_flipped_bit_at_the_begin_of_a_large_file_is_noticed(tmp_path):
    path = tmp_path / "state.pt"
    save_atomically({"a": torch.zeros(2**19)}, path)  # Of two megabytes.
    damaged = bytearray(path.read_bytes())
    damaged[2**19] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match="its checksum is wrong"):
        load_safely(path)


def test_saved_value_of_another_type_is_rejected():
    with pytest.raises(ValueError, match="'strict' of the saved sampler must be True, got 1"):
        check_saved("sampler", {"strict": 1}, strict=True)


@pytest.mark.parametrize("wrong", [torch.nan, torch.tensor([0.0, torch.inf])])
def test_saved_number_that_is_not_finite_is_found_in_any_depth(wrong):
    state = {"groups": [{"lr": 1.0, "params": (3, "a", None)}], "weight": torch.zeros(2)}
    check_saved_numbers("learner", state)
    state["groups"].append({"lr": wrong})
    with pytest.raises(ValueError, match=r"saved learner must be finite, got (nan|inf) in 'lr'"):
        check_saved_numbers("learner", state)
