"""Folders of files that are whole or absent, whose damage is noticed, and that execute nothing."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_mpfa.saving import checksum_of, write_text_atomically

MANIFEST = "manifest.json"
_FORMAT = 1
_LOCK = ".lock"
_ENDINGS = {".json", ".memmap", ".pt"}
"""Of tensors and plain values. TensorDict unpickles what has others, also inside of archives."""
_EVALUATED = "data_indices.json"
"""Where this is, TorchRL's compressed storage executes text of its ``metadata.json``."""


@contextmanager
def new_dump(path: str | Path) -> Iterator[Path]:
    """A new folder inside ``path`` that counts once it is whole, and then replaces the one before.

    ``path/manifest.json`` names the folder that counts and is replaced in one step: a crash at any
    moment leaves the old dump or the new one. The next dump removes what a killed one left. Of
    several at once, by threads or processes, each waits for the one before.
    """
    path = Path(path).absolute()
    path.mkdir(exist_ok=True)
    with (path / _LOCK).open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        numbers = [int(found.name[5:]) for found in _versions(path)]
        folder = path / f"dump-{max(numbers, default=0) + 1}"
        folder.mkdir()
        try:
            yield folder
            seal_dump(path, folder)
        except BaseException:
            shutil.rmtree(folder)
            raise
        for old in _versions(path):
            if old != folder:
                shutil.rmtree(old, ignore_errors=True)


def seal_dump(path: Path, folder: Path) -> None:
    """Write size and checksum of every file in ``folder`` to ``path/manifest.json``."""
    files = {name: _measure(folder / name) for name in _files(folder)}
    manifest = {"format": _FORMAT, "folder": os.path.relpath(folder, path), "files": files}
    write_text_atomically(json.dumps(manifest, indent=1) + "\n", path / MANIFEST)


def open_dump(path: str | Path) -> Path:
    """Compare every file of a dump with its checksum, and return the folder of the files.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it is not a complete dump, a file is missing, unknown or damaged, or there is
            a link, or a file that could execute something when it is read.
    """
    path = Path(path).absolute()
    if not path.is_dir():
        raise FileNotFoundError(f"no such folder: {path}")
    if not (path / MANIFEST).is_file() or (path / MANIFEST).is_symlink():
        raise ValueError(f"{path} is not a complete dump of this package: it has no {MANIFEST}")
    try:
        manifest: dict[str, Any] = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        name, files, found = manifest["folder"], dict(manifest["files"]), manifest["format"]
        own = re.fullmatch(r"dump-\d+", name) and not (path / name).is_symlink()
        if name != "." and not own:
            raise ValueError(f"it names the folder {name!r}, which is not the dump's own")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path / MANIFEST} is damaged: {error}") from error
    if found != _FORMAT:
        raise ValueError(f"format of {path / MANIFEST} is {found}, this version reads {_FORMAT}")
    folder = path / name
    present = _files(folder)
    for file in sorted({*present} ^ {*files}):
        word = "missing" if file in files else "not part of the dump"
        raise ValueError(f"{folder / file} is {word}")
    for file in present:
        if _measure(folder / file) != files[file]:
            raise ValueError(f"{folder / file} is damaged: its size or checksum is wrong")
    return folder


def _versions(path: Path) -> list[Path]:
    return [found for found in path.glob("dump-*") if re.fullmatch(r"dump-\d+", found.name)]


def _files(folder: Path) -> list[str]:
    """Names of all files under a folder, but for its own manifest, none of which may execute."""
    found = [file for file in folder.rglob("*") if file != folder / MANIFEST]
    for file in found:
        if file.is_symlink() or not (file.is_dir() or file.is_file()):
            raise ValueError(f"{file} is a link or a device: dumps hold files and folders only")
        name = file.name.lower()
        if file.is_file() and (file.suffix.lower() not in _ENDINGS or name == _EVALUATED):
            raise ValueError(
                f"{file} could execute anything when it is read: dumps hold tensors and plain "
                "values only"
            )
    return sorted(file.relative_to(folder).as_posix() for file in found if file.is_file())


def _measure(file: Path) -> list[int]:
    """Size in bytes and CRC-32 of a file, which is on the disk afterwards."""
    with file.open("rb") as opened:
        os.fsync(opened.fileno())
        size = opened.seek(0, os.SEEK_END)
        return [size, checksum_of(opened, size)]
