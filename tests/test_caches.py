"""The rule of folders of caches, which each package has by itself: both find the same one."""

import os
from pathlib import Path

import pytest

from mpfa_envs.compiled import own_cache_folder as of_envs
from torchrl_mpfa.caches import own_cache_folder as of_core

OTHER = 65534


def _open_with_files(folder, owner):
    folder.mkdir()
    (folder / "file").touch(mode=0o600)
    os.chown(folder / "file", owner, -1)
    folder.chmod(0o777)


def _linked(folder):
    target = folder.parent / "target"
    target.mkdir()
    os.chown(target, OTHER, -1)
    folder.symlink_to(target)


def _of_other(folder):
    folder.mkdir(mode=0o755)
    os.chown(folder, OTHER, -1)


SITUATIONS = {
    "nothing": (lambda folder: None, True),
    "a closed folder": (lambda folder: folder.mkdir(mode=0o700), True),
    "an open folder of one's own files": (lambda f: _open_with_files(f, os.geteuid()), True),
    "an open folder with another's file": (lambda f: _open_with_files(f, OTHER), False),
    "a folder of another user": (_of_other, False),
    "a link to a folder of another user": (_linked, False),
    "a file": (lambda folder: folder.touch(), False),
}


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
@pytest.mark.parametrize("situation", SITUATIONS)
def test_both_packages_take_or_pass_over_the_same_folder(situation, tmp_path, monkeypatch):
    prepare, taken = SITUATIONS[situation]
    for number, find in enumerate((of_core, of_envs)):
        cache = tmp_path / str(number)
        cache.mkdir()
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        prepare(cache / "torchrl_mpfa")
        assert find() == (cache / "torchrl_mpfa" if taken else None)


@pytest.mark.parametrize("given", ["", "relative", "~/caches", "./here"])
@pytest.mark.parametrize("home", ["home", "none", "relative"])
def test_both_packages_ignore_what_is_no_absolute_path(given, home, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", given)
    if home == "none":
        monkeypatch.delenv("HOME", raising=False)
        monkeypatch.setattr("pwd.getpwuid", lambda user: {}[user])
    else:
        monkeypatch.setenv("HOME", str(tmp_path / "home") if home == "home" else "home")
    expected = tmp_path / "home" / ".cache" / "torchrl_mpfa" if home == "home" else None
    assert of_core() == of_envs() == expected
    assert [path.name for path in Path(tmp_path).iterdir()] == ["home"] * (home == "home")
