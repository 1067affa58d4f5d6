"""Compiled loops are made where they are not there, can be missing, and are no one else's."""

import errno
import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import pytest

from tests.mpfa.compiled import fail_with
from tests.mpfa.transitions import make_buffer, make_transitions, write_signals
from torchrl_mpfa import native
from torchrl_mpfa.native import build
from torchrl_mpfa.native.build import compile_library, library_name

pytestmark = pytest.mark.usefixtures("own_library")


def finds_loops(home, monkeypatch, reason):
    """Look for loops with a folder of caches; without them a warning must give the reason."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    native.find_loops.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        compiled = native.find_loops()
    texts = [str(warning.message) for warning in caught]
    assert len(texts) == (compiled is None) and all(reason in text for text in texts)
    return compiled is not None


def test_without_a_compiler_pytorch_trains(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    native.find_loops.cache_clear()
    with pytest.warns(UserWarning, match="there is no C compiler"):
        assert native.find_loops() is None
    assert native.find_loops() is None  # Says so once.
    buffer = make_buffer(16)
    buffer.extend(make_transitions(16))
    buffer.update_tensordict_priority(write_signals(buffer.sample()))
    assert list((tmp_path / "torchrl_mpfa").iterdir()) == []


@pytest.mark.parametrize("part", ["SOURCE", "_OPTIONS"])
def test_name_of_the_library_follows_from_source_and_options(part, monkeypatch, tmp_path):
    before, other = library_name(), tmp_path / "replay.c"
    other.write_bytes(build.SOURCE.read_bytes() + b"\n")
    monkeypatch.setattr(build, part, {"SOURCE": other, "_OPTIONS": ("-O2",)}[part])
    assert library_name() != before


def test_a_folder_of_caches_that_is_no_folder_leaves_it_to_pytorch(monkeypatch, tmp_path):
    (tmp_path / "torchrl_mpfa").write_text("")
    assert not finds_loops(tmp_path, monkeypatch, "there is no folder of caches")


def test_without_a_home_it_is_left_to_pytorch(monkeypatch):
    monkeypatch.setattr(Path, "home", fail_with(RuntimeError("no home")))
    assert not finds_loops("", monkeypatch, "there is no folder of caches")


@pytest.mark.parametrize("cache", ["relative", "~/caches"])
def test_a_folder_of_caches_below_the_working_folder_is_ignored(cache, tmp_path, monkeypatch):
    (tmp_path / "home").mkdir()
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    monkeypatch.chdir(tmp_path)
    assert finds_loops(cache, monkeypatch, "")
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


def test_a_full_disk_leaves_it_to_pytorch(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(tempfile, "TemporaryDirectory", fail_with(full))
    assert not finds_loops(tmp_path, monkeypatch, "No space left on device")


@pytest.mark.parametrize("content", ["no program", ""])
def test_a_compiler_that_cannot_run_leaves_it_to_pytorch(content, tmp_path, monkeypatch):
    compiler = tmp_path / "cc"
    compiler.write_text(content)
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    assert not finds_loops(tmp_path / "cache", monkeypatch, "Exec format")


def test_a_library_that_cannot_be_loaded_is_compiled_once(tmp_path, monkeypatch):
    compiler, log = tmp_path / "cc", tmp_path / "log"
    save = 'for word; do [ "$last" = -o ] && printf junk > "$word"; last=$word; done'
    compiler.write_text(f"#!/bin/sh\necho run >> {log}\n{save}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    for reason in ("cannot be loaded", "to compile it again", "to compile it again"):
        assert not finds_loops(tmp_path, monkeypatch, reason)
    assert log.read_text() == "run\n"
    (failed,) = (tmp_path / "torchrl_mpfa").glob("*.failed")
    failed.unlink()
    monkeypatch.delenv("CC")
    assert finds_loops(tmp_path, monkeypatch, "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
@pytest.mark.parametrize("planted", ["folder", "file in an open folder", "file in a closed folder"])
def test_a_library_of_another_user_is_not_loaded(planted, tmp_path, monkeypatch):
    folder = tmp_path / "torchrl_mpfa"
    folder.mkdir()
    library = folder / library_name()
    assert compile_library(library) is None
    os.chown(library, 65534, 65534)
    if planted == "folder":
        os.chown(folder, 65534, 65534)
    folder.chmod(0o755 if planted == "file in a closed folder" else 0o777)
    loaded = finds_loops(tmp_path, monkeypatch, "there is no folder of caches")
    # In a closed folder it is replaced by one of the user's own.
    assert loaded == (planted == "file in a closed folder")
    assert not loaded or library.stat().st_uid == os.geteuid()


def test_others_cannot_write_to_the_folder_of_what_is_loaded(monkeypatch, tmp_path):
    (tmp_path / "torchrl_mpfa").mkdir(mode=0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native.find_loops.cache_clear()
    assert native.find_loops() is not None
    assert (tmp_path / "torchrl_mpfa").stat().st_mode & 0o777 == 0o700


def test_a_compiler_that_fails_leaves_no_file(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "false")
    assert compile_library(tmp_path / "replay.so").startswith("false failed")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_library_is_compiled_again(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native.find_loops.cache_clear()
    assert native.find_loops() is not None
    (made,) = (tmp_path / "torchrl_mpfa").iterdir()
    # Not in place: this process has it mapped.
    made.unlink()
    made.write_bytes(b"not a library")
    native.find_loops.cache_clear()
    assert native.find_loops() is not None


def test_a_first_use_in_two_processes_at_once_gives_both_the_loops(tmp_path):
    program = "from torchrl_mpfa.native import find_loops; assert find_loops() is not None"
    environment = {"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    command = [sys.executable, "-c", program]
    runs = [subprocess.Popen(command, env=environment) for _ in range(2)]
    assert [run.wait() for run in runs] == [0, 0]
