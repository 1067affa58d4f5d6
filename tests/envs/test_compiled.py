"""Where compiled loops are kept: in folders that no other user can write to."""

from __future__ import annotations

import os
import pwd
import re
from pathlib import Path

import pytest

from mpfa_envs import compiled
from mpfa_envs.compiled import _cache_folder, own_cache_folder, own_folder
from tests.envs.process import ROOT, run

OTHER = 12345
"""The number of another user."""
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives a file to another user")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home, in which the test runs, without XDG_CACHE_HOME."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


def mode_of(folder: Path) -> int:
    return folder.stat().st_mode & 0o777


@pytest.mark.parametrize("variable", ["", "cache", "./cache", "~", "~/cache", "$HOME"])
def test_a_cache_home_that_is_not_absolute_is_ignored(
    home: Path, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", variable)
    assert own_cache_folder() == home / ".cache/torchrl_mpfa"
    assert not list((home / "here").iterdir())


def test_an_absolute_cache_home_is_used(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "caches"))
    assert own_cache_folder() == home / "caches/torchrl_mpfa"
    assert not (home / ".cache").exists()


def test_a_folder_that_is_made_is_closed_to_others_whatever_the_umask(home: Path) -> None:
    before = os.umask(0)
    try:
        folder = own_cache_folder()
    finally:
        os.umask(before)
    assert folder is not None
    assert (mode_of(folder), mode_of(folder.parent)) == (0o700, 0o700)


def unknown(user: int) -> None:
    raise KeyError(user)


@pytest.mark.parametrize("relative", [False, True])
def test_without_a_home_there_is_no_folder(
    home: Path, relative: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.delenv("HOME")
    if relative:
        monkeypatch.setenv("HOME", "here")
    assert own_cache_folder() is None


def test_where_a_file_stands_in_the_way_there_is_no_folder(home: Path) -> None:
    (home / ".cache").write_text("")
    assert own_cache_folder() is None


@needs_root
def test_a_folder_of_another_user_is_passed_over(home: Path) -> None:
    folder = home / ".cache/torchrl_mpfa"
    folder.mkdir(parents=True, mode=0o700)
    os.chown(folder, OTHER, OTHER)
    assert own_cache_folder() is None


@pytest.mark.parametrize("mode", [0o775, 0o757, 0o777, 0o720])
def test_a_folder_that_others_can_write_to_is_closed(home: Path, mode: int) -> None:
    folder = home / ".cache/torchrl_mpfa"
    (folder / "inner").mkdir(parents=True)
    folder.chmod(mode)
    assert own_cache_folder() == folder
    assert mode_of(folder) == mode & 0o755


@needs_root
@pytest.mark.parametrize("name", ["library.so", "inner/library.so", "inner"])
def test_an_open_folder_with_something_of_another_user_is_passed_over(
    home: Path, name: str
) -> None:
    folder = home / ".cache/torchrl_mpfa"
    (folder / "inner").mkdir(parents=True)
    folder.chmod(0o777)
    if name != "inner":
        (folder / name).write_text("")
    os.chown(folder / name, OTHER, OTHER)
    assert own_cache_folder() is None
    assert mode_of(folder) == 0o777


@needs_root
def test_a_link_to_a_folder_of_another_user_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir(mode=0o700)
    os.chown(tmp_path / "theirs", OTHER, OTHER)
    (tmp_path / "link").symlink_to("theirs")
    assert own_folder(tmp_path / "link") is None


@pytest.fixture
def package(home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package whose loops are compiled for the first time."""
    folder = home / "package"
    folder.mkdir()
    (folder / "compiled.py").write_text("")
    monkeypatch.setattr(compiled, "__file__", str(folder / "compiled.py"))
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", "")
    return folder


def found() -> Path:
    """The folder that a new process would take."""
    return Path(_cache_folder.__wrapped__())


def test_loops_are_kept_beside_the_package_where_that_is_the_users(package: Path) -> None:
    assert found().parent == package / "__pycache__"
    assert mode_of(found()) == 0o700


@needs_root
def test_beside_a_package_of_another_user_the_users_folder_is_taken(
    package: Path, home: Path
) -> None:
    (package / "__pycache__").mkdir()
    os.chown(package / "__pycache__", OTHER, OTHER)
    assert found().parent == home / ".cache/torchrl_mpfa"
    assert not list((package / "__pycache__").iterdir())


@needs_root
def test_loops_that_another_user_planted_are_not_loaded(package: Path, home: Path) -> None:
    for parent in (package / "__pycache__", home / ".cache/torchrl_mpfa"):
        folder = found()
        assert folder.parent == parent
        (folder / "inner").mkdir()
        (folder / "inner/loop.nbi").write_text("")
        os.chown(folder / "inner/loop.nbi", OTHER, OTHER)
    with pytest.warns(UserWarning, match=r"are not kept, .*: set NUMBA_CACHE_DIR to a folder"):
        assert _cache_folder.__wrapped__() == ""


def test_a_folder_that_the_user_names_is_taken_as_it_is(
    package: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = home / "named"
    named.mkdir()
    named.chmod(0o777)
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", str(named))
    assert found().parent == named
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", "/dev/null/none")
    with pytest.warns(UserWarning, match=r"are not kept, .*NUMBA_CACHE_DIR is not one"):
        assert _cache_folder.__wrapped__() == ""


TWO = """
import warnings
from numba.core.caching import IndexDataCacheFile
def full(*_):
    raise OSError(28, "No space left on device")
if {full}:
    IndexDataCacheFile.save = full
from loops import thrice, twice
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    print(twice(3.0), thrice(3.0), len(told), *[warning.message for warning in told])
"""


def test_loops_run_and_say_so_once_where_the_cache_is_damaged_or_full(tmp_path: Path) -> None:
    lines = "from mpfa_envs.compiled import njit\n"
    for name, factor in (("twice", 2.0), ("thrice", 3.0)):
        lines += f"@njit\ndef {name}(x):\n    return {factor} * x\n"
    (tmp_path / "loops.py").write_text(lines)
    folder = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    warned = r"6\.0 9\.0 1 compiled loops are not kept, .*{}"
    assert re.match(warned.format("No space left"), run(TWO.format(full=True), **folder))
    assert run(TWO.format(full=False), **folder) == "6.0 9.0 0\n"
    indices = list(tmp_path.rglob("*.nbi"))
    assert len(indices) == 2
    for index in indices:
        index.write_bytes(b"")
    assert re.match(warned.format("EOFError"), run(TWO.format(full=False), **folder))


TELLS = """
sys.stderr = sys.stdout
import numpy as np
from mpfa_envs.robots.motion_loops import scale_actions
from mpfa_envs import ROBOTS
for _ in range(2):
    scale_actions(np.zeros((1, 2)), ROBOTS["kobuki"].wheel_limits, np.zeros((1, 2)))
"""


def test_a_start_that_compiles_says_so_once_and_the_next_is_silent(tmp_path: Path) -> None:
    said = run(TELLS, NUMBA_CACHE_DIR=str(tmp_path))
    assert said.startswith("compiling loops: up to half a minute at a first start, and kept in")
    assert str(tmp_path) in said and said.count("\n") == 1
    assert run(TELLS, NUMBA_CACHE_DIR=str(tmp_path)) == ""
