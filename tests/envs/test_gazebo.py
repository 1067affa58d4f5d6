"""Worlds of Gazebo: what is read, what is left out, and what is rejected."""

import gzip
import math
import time

import pytest

from mpfa_envs import NavigationEnv, WorldFileError
from mpfa_envs.generators.resolve import resolve_world
from mpfa_envs.worlds.barn import barn_task, barn_world
from mpfa_envs.worlds.gazebo import load_gazebo_world

BARN_CENTER = (-2.25, 7.0)
SPECK = "<box><size>1e-200 1e-200 1</size></box>"
CYLINDER = "<cylinder><radius>0.075</radius><length>1</length></cylinder>"


def model(geometry, pose="0 0 0 0 0 0", *, static="<static>1</static>", link="", name="m"):
    """A model of one link and one collision; the visual is larger and must not count."""
    seen = "<visual><geometry><box><size>9 9 9</size></box></geometry></visual>"
    collision = f"<collision name='c'>{link}<geometry>{geometry}</geometry></collision>"
    link = f"<link name='l'>{seen}{collision}</link>"
    return f"<model name='{name}'>{static}<pose frame=''>{pose}</pose>\n{link}</model>\n"


def write(folder, content, head="", name="room.world"):
    start = f"<?xml version='1.0'?>\n{head}<sdf version='1.6'>\n<world name='w'>\n"
    text = f"{start}{content}</world></sdf>"
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def test_a_benchmark_world_is_the_same_by_file_and_numbers(tmp_path):
    expected = barn_world(3)
    models = "".join(
        model(CYLINDER, f"{c.x + BARN_CENTER[0]:.6f} {c.y + BARN_CENTER[1]:.6f} 0 0 -0 0")
        for c in expected.cylinders
    )
    path = write(tmp_path, models, name="world_50.world.gz")
    world = load_gazebo_world(path, size=(10.0, 15.0), center=BARN_CENTER)
    assert world.name == "world_50"
    assert len(world.cylinders) == len(expected.cylinders)
    for found, wanted in zip(world.cylinders, expected.cylinders, strict=True):
        assert (found.x, found.y, found.radius) == pytest.approx((wanted.x, wanted.y, 0.075))
    env = NavigationEnv(world=world, physics="kinematic", collision_distance="contact")
    env.reset(options=barn_task()._asdict())


def test_poses_of_model_link_and_collision_add_up(tmp_path):
    turn = f"<pose>1 0 0 0 0 {math.pi / 2}</pose>"
    inner = model("<box><size>2 1 1</size></box>", "1 0 0 0 0 0", link=turn, static="")
    pose = f"<pose>5 5 0.5 0 0 {math.pi / 2}</pose>"
    outer = f"<model name='o'><static>true</static>{pose}{inner}</model>"
    straight = load_gazebo_world(write(tmp_path, outer), center=(0, 0)).boxes
    # The box of 2 x 1 m lies two meters along the turned model's axis, turned twice by a quarter.
    assert straight[0].bounds == pytest.approx((4.0, 6.5, 6.0, 7.5))
    slanted = model("<box><size>2 1 1</size></box>", f"0 0 0 0 0 {math.pi / 4}")
    world = load_gazebo_world(write(tmp_path, slanted))
    assert not world.boxes
    assert world.polygons[0].area == pytest.approx(2.0)
    assert max(x for x, _ in world.polygons[0].vertices) == pytest.approx(1.5 * math.sqrt(0.5))


def test_turns_may_be_written_in_degrees(tmp_path):
    pose = "0 0 0 180 0 90"  # Upside down, which is tilted.
    wall = "<box><size>4 0.2 1</size></box>"
    models = [
        model(wall, "1 0 0.5 0 0 90").replace("frame=''", f"degrees='{flag}'")
        for flag in ("true", "1")
    ]
    models.append(model(wall, pose).replace("frame=''", "degrees='true'"))
    with pytest.warns(UserWarning, match="left out 1 tilted parts$"):
        world = load_gazebo_world(write(tmp_path, "".join(models)), size=(9, 9), center=(0, 0))
    assert not world.polygons and len(world.boxes) == 2
    for box in world.boxes:
        assert tuple(box.bounds) == pytest.approx((0.9, -2.0, 1.1, 2.0))


def test_the_state_of_the_file_says_where_models_are(tmp_path):
    state = "<state><model name='m'><pose>3 4 0 0 0 0</pose></model></state>"
    world = load_gazebo_world(
        write(tmp_path, model(CYLINDER) + state), size=(10, 10), center=(0, 0)
    )
    assert (world.cylinders[0].x, world.cylinders[0].y) == (3.0, 4.0)


def test_the_room_is_as_large_as_the_obstacles(tmp_path):
    models = model(CYLINDER, "-3 1 0 0 0 0") + model(CYLINDER, "5 7 0 0 0 0")
    path = write(tmp_path, models)
    world = resolve_world(path)
    assert world.size == pytest.approx((8.15, 6.15), abs=0.003)
    assert (world.cylinders[0].x, world.cylinders[1].y) == pytest.approx((-4.0, 3.0))
    assert resolve_world(str(path)) == world


def test_shapes_above_the_robot_or_in_the_floor_are_no_obstacles(tmp_path):
    slab = "<box><size>1 1 0.1</size></box>"
    models = "".join(model(slab, f"0 0 {z} 0 0 0") for z in (-0.045, 0.3, 0.6))
    world = load_gazebo_world(write(tmp_path, models))
    assert len(world.boxes) == 1
    assert len(load_gazebo_world(write(tmp_path, models), height=1.0).boxes) == 2


def test_a_warning_counts_the_parts_left_out(tmp_path):
    content = "".join(
        (
            model(CYLINDER),
            model(CYLINDER, static=""),
            model(CYLINDER, static="<static>0</static>"),
            model(CYLINDER, "0 0 0 0.3 0 0"),
            model("<mesh><uri>x</uri></mesh>"),
            model("<plane><normal>0 0 1</normal></plane>"),
            model(CYLINDER).replace("frame=''", "relative_to='other'"),
            model(CYLINDER).replace("<model", "<model placement_frame='l'"),
            model(CYLINDER, "0 0 0 0 0 0 1").replace("frame=''", "rotation_format='quat_xyzw'"),
            "<include><uri>model://sun</uri></include>" * 3,
        )
    )
    with pytest.warns(UserWarning) as caught:
        world = load_gazebo_world(write(tmp_path, content))
    assert len(world.cylinders) == 1
    text = str(caught[0].message)
    for part in (
        "3 includes",
        "2 models that may move",
        "1 tilted parts",
        "1 geometries of the kind mesh",
        "2 poses in named frames",
        "1 poses that are not written as roll, pitch and yaw",
    ):
        assert part in text
    assert "plane" not in text


@pytest.mark.parametrize(
    ("content", "line", "reason"),
    [
        (model(CYLINDER, "0 0 0 0 0"), 4, "pose must be 6 numbers, got '0 0 0 0 0'"),
        (model(CYLINDER, "0 0 nan 0 0 0"), 4, "pose must be 6 numbers"),
        (model(CYLINDER.replace("0.075", "-1")), 5, "radius must be positive, got '-1'"),
        (model("<box></box>"), 5, "box lacks size"),
        ("<model>", 4, "is not XML: mismatched tag"),
        ("", 3, "has no obstacle"),
        ("<a>" * 200, 4, "nested too deeply"),
        (model(CYLINDER.replace("0.075", "1_0")), 5, "radius must be 1 numbers, got '1_0'"),
        (model(CYLINDER, "1e308 0 0 0 0 0"), 4, "pose must be 6 numbers, got '1e308 0 0 0 0 0'"),
        (model(SPECK, "0 0 0 0 0 0.3"), 5, "polygon must have an area"),
    ],
)
def test_a_bad_file_is_rejected_with_line_and_reason(content, line, reason, tmp_path):
    with pytest.raises(WorldFileError, match=reason) as caught:
        load_gazebo_world(write(tmp_path, content))
    assert f"room.world:{line}: " in str(caught.value)


@pytest.mark.parametrize("encoding", ["foo", "utf-7", "idna", "hex"])
def test_an_unknown_encoding_is_rejected(encoding, tmp_path):
    path = write(tmp_path, model(CYLINDER))
    path.write_text(path.read_text().replace("?>", f" encoding='{encoding}'?>"))
    with pytest.raises(WorldFileError, match=r"room.world:1: is not XML"):
        load_gazebo_world(path)


def test_a_compressed_file_of_line_ends_is_read_soon(tmp_path):
    path = write(tmp_path, model(CYLINDER) + "\n" * 1_000_000, name="room.world.gz")
    start = time.process_time()
    assert len(load_gazebo_world(path).cylinders) == 1
    assert time.process_time() - start < 2.0


def test_entities_are_rejected_before_they_grow(tmp_path):
    head = '<!DOCTYPE x [<!ENTITY a "lol"><!ENTITY b "&a;&a;&a;&a;">]>\n'
    with pytest.raises(WorldFileError, match="must not have a document type"):
        load_gazebo_world(write(tmp_path, "&b;", head))
    outside = '<!DOCTYPE x SYSTEM "file:///etc/hostname">\n'
    with pytest.raises(WorldFileError, match="must not have a document type"):
        load_gazebo_world(write(tmp_path, model(CYLINDER), outside))


def test_other_files_and_too_small_rooms_are_rejected(tmp_path):
    with pytest.raises(WorldFileError, match="cannot be read"):
        load_gazebo_world(tmp_path / "none.world")
    flipped = bytearray(gzip.compress(b"<sdf/>" * 50 + bytes(range(256))))
    flipped[20] ^= 0xFF
    for content in (b"no gzip", gzip.compress(b"<sdf/>" * 1000)[:30], flipped):
        (tmp_path / "bad.world.gz").write_bytes(content)
        with pytest.raises(WorldFileError, match="cannot be read"):
            load_gazebo_world(tmp_path / "bad.world.gz")
    (tmp_path / "big.world.gz").write_bytes(gzip.compress(b" " * 30_000_000))
    with pytest.raises(WorldFileError, match="more than 20000000 bytes"):
        load_gazebo_world(tmp_path / "big.world.gz")
    (tmp_path / "robot.sdf").write_text("<robot/>")
    with pytest.raises(WorldFileError, match="must be an sdf element with a world"):
        load_gazebo_world(tmp_path / "robot.sdf")
    with pytest.raises(WorldFileError, match="cylinders must lie in the room"):
        load_gazebo_world(
            write(tmp_path, model(CYLINDER, "9 0 0 0 0 0")), size=(4, 4), center=(0, 0)
        )
