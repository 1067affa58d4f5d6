"""Included models of Gazebo: where they are read from, what they become, and what is rejected."""

import os

import pytest

from mpfa_envs import Box, WorldFileError
from mpfa_envs.worlds.gazebo import load_gazebo_world
from tests.envs.sdf import box, quietly, walls, write

BLOCK = (
    "<sdf><model name='b'>{}<pose>0 0 0.5 0 0 0</pose><link><collision><geometry><box>"
    "<size>1 1 1</size></box></geometry></collision></link>{}</model></sdf>"
)


def put(folder, name="b", extra="", static="<static>1</static>", file="model.sdf"):
    """Write a model of a box of a meter into a folder of models."""
    (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / name / file).write_text(BLOCK.format(static, extra))


def include(uri="model://b", rest="<pose>2 2 0.5 0 0 0</pose>"):
    return f"<include><uri>{uri}</uri>{rest}</include>"


@pytest.mark.parametrize(
    "where", ["", "worlds/models", "GAZEBO_MODEL_PATH", "GZ_SIM_RESOURCE_PATH", "model_paths"]
)
@pytest.mark.parametrize("uri", ["model://b", "file://b/model.sdf", "model://b/model.sdf"])
def test_an_included_model_is_read_from_the_search_folders(where, uri, tmp_path, monkeypatch):
    models = tmp_path / where
    put(models)
    arguments = {}
    if where == "model_paths":
        arguments = {where: models}
    elif where.isupper():
        monkeypatch.setenv(where, os.pathsep.join(("", str(tmp_path / "none"), str(models))))
    folder = tmp_path if not where else tmp_path / "worlds"
    folder.mkdir(exist_ok=True)
    path = write(folder, walls() + include(uri) + include(uri, "<name>two</name>"))
    world, told = quietly(path, center=(0, 0), **arguments)
    assert not told
    assert world.boxes[4:] == (Box(1.5, 1.5, 2.5, 2.5), Box(-0.5, -0.5, 0.5, 0.5))


def test_an_include_changes_its_model(tmp_path):
    put(tmp_path, static="")
    put(tmp_path, "outer", include(rest="<pose>0 2 0 0 0 0</pose>"))
    (tmp_path / "b/model.config").write_text(
        "<model><sdf version='1.10'>old.sdf</sdf><sdf version='1.6'>new.sdf</sdf></model>"
    )
    (tmp_path / "b/model.sdf").rename(tmp_path / "b/new.sdf")
    state = "<state><model name='x'><pose>-2 2 0.5 0 0 0</pose><scale>2 1 1</scale></model></state>"
    content = include(rest="") + include(rest="<static>true</static><name>x</name>")
    path = write(tmp_path, walls() + content + include("model://outer") + state)
    world, told = quietly(path, center=(0, 0))
    assert told.endswith("read 7 of 8 collisions, left out 1 models that may move")
    assert [each.bounds for each in world.boxes[4:]] == [
        (-3.0, 1.5, -1.0, 2.5),
        (1.5, 1.5, 2.5, 2.5),
        (1.5, 3.5, 2.5, 4.5),
    ]


def test_nothing_outside_the_search_folders_is_read(tmp_path):
    put(tmp_path / "out", "b")
    put(tmp_path / "in", "c", static="")
    (tmp_path / "in/link").symlink_to(tmp_path / "out/b")
    (tmp_path / "in/c/model.config").write_text("<model><sdf>../../out/b/model.sdf</sdf></model>")
    (tmp_path / "in/loop").symlink_to(tmp_path / "in/loop")
    os.mkfifo(tmp_path / "in/pipe")
    away = ("model://../out/b", "model://link", "model://c", f"file://{tmp_path}/out/b/model.sdf")
    odd = ("https://b", "model://loop", "model://pipe", "model://", "", "model://" + "x" * 5000)
    content = "".join(include(uri) for uri in (*away, *odd)) + "<include/>"
    path = write(tmp_path / "in", walls() + content)
    _, told = quietly(path, size=(11, 11))
    assert told.endswith("read 4 of 4 collisions, left out 11 includes")
    with pytest.raises(WorldFileError, match=r"is mostly left out; .* left out 11 includes"):
        load_gazebo_world(path)
    inside = write(tmp_path / "in", walls() + include(f"file://{tmp_path}/in/c/model.sdf"))
    assert quietly(inside)[1].endswith("left out 1 models that may move")


def test_circles_and_floods_of_includes_are_rejected(tmp_path):
    put(tmp_path, "b", include() * 2)
    put(tmp_path, "wide", "<link/>" * 4000)
    path = write(tmp_path, walls() + include())
    with pytest.raises(WorldFileError, match=r"b/model.sdf:1: is in more than 20 includes"):
        load_gazebo_world(path)
    path = write(tmp_path, walls() + include("model://wide") * 200)
    with pytest.raises(WorldFileError, match=r"room.world:12: has more than 500000 elements"):
        load_gazebo_world(path)
    put(tmp_path, "bad", "<link>")
    path = write(tmp_path, walls() + include("model://bad"))
    with pytest.raises(WorldFileError, match=r"bad/model.sdf:1: is not XML"):
        load_gazebo_world(path)
    path = write(tmp_path, box(0, 0, 1, "1 1 1") * 5001)
    with pytest.raises(WorldFileError, match=r"has more than 5000 shapes"):
        load_gazebo_world(path)
