"""Files that a user names: anything may lie there, and what is not ours stays."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mpfa_envs import (
    WORLDS,
    Policy,
    WorldFileError,
    load_policy,
    load_world,
    save_policy,
    save_world,
)
from mpfa_envs.deploy.card import CardError, read_exported
from mpfa_envs.files import cause_of
from mpfa_envs.policies.layers import Linear
from mpfa_envs.policies.policy import PolicyFileError
from mpfa_envs.worlds.gazebo import load_gazebo_world

POLICY = Policy([Linear(np.ones((2, 24), np.float32), np.zeros(2, np.float32))])
TEXT = "root:x:0:0:root:/root:/bin/bash\n"
MAP = "image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"


def card_of_nothing(path: Path) -> object:
    path.with_suffix(".onnx").write_bytes(b"")
    return read_exported(path.with_suffix(".onnx"))


def map_of(path: Path) -> object:
    path.with_name("map.yaml").write_text(f"{MAP}free_thresh: 0.196\n")
    return load_world(path.with_name("map.yaml"))


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="there are no pipes and no such device")
@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    ("name", "load", "error"),
    [
        ("world.yaml", load_world, WorldFileError),
        ("room.world", load_gazebo_world, WorldFileError),
        ("room.world.gz", load_gazebo_world, WorldFileError),
        ("map.pgm", map_of, WorldFileError),
        ("policy.npz", load_policy, PolicyFileError),
        ("policy.onnx", read_exported, CardError),
        ("policy.json", card_of_nothing, CardError),
    ],
)
def test_pipes_and_devices_are_not_read(
    name: str, kind: str, load: Callable[[Path], object], error: type[Exception], tmp_path: Path
) -> None:
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(error, match=rf"{name}.* it is not a regular file"):
        load(path)


@pytest.mark.parametrize(
    ("name", "content", "save", "what"),
    [
        ("policy.npz", TEXT, partial(save_policy, POLICY), "policy"),
        ("policy.onnx", TEXT, partial(save_policy, POLICY), "policy"),
        ("b.yaml", TEXT, partial(save_world, WORLDS["B"]), "world"),
        ("b.yaml", f"{MAP}free_thresh: 0.196\n", partial(save_world, WORLDS["B"]), "world"),
    ],
)
def test_a_file_replaces_only_its_own_kind_without_overwrite(
    name: str, content: str, save: Callable[..., object], what: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(FileExistsError, match=f"path must be free or hold a {what} unless overw"):
        save(path)
    assert path.read_text() == content
    assert [each.name for each in tmp_path.iterdir()] == [name]
    save(path, overwrite=True)
    written = path.read_bytes()
    save(path)
    assert path.read_bytes() == written != content.encode()


@pytest.mark.parametrize(
    "content", [b"", b"junk", b"P5 10 10 255\n", b"PK\x03\x04junk", b"\x93NUMPY"]
)
@pytest.mark.parametrize(
    ("name", "load"),
    [
        ("map.pgm", map_of),
        ("room.world", load_gazebo_world),
        ("room.world.gz", load_gazebo_world),
        ("world.yaml", load_world),
        ("policy.npz", load_policy),
        ("policy.onnx", load_policy),
    ],
)
def test_a_message_has_no_address_of_an_object(
    tmp_path: Path, name: str, load: Callable[[Path], object], content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        load(tmp_path / name)
    assert not re.search(r" at 0x|\n", str(caught.value))


def test_the_cause_of_an_error_is_kept_without_the_objects_in_it() -> None:
    error = ValueError("cannot read <a.B object at 0x7f> of <open file 'x' at 0xAB> here")
    assert cause_of(error) == "cannot read of here"
