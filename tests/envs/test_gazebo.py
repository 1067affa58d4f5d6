"""Worlds of Gazebo: what is read, what is left out, and what is rejected."""

import gzip
import math
import time

import pytest

from mpfa_envs import NavigationEnv, WorldFileError
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.worlds.barn import barn_task, barn_world
from mpfa_envs.worlds.gazebo import load_gazebo_world
from tests.envs.sdf import CYLINDER, box, model, quietly, walls, write

BARN_CENTER = (-2.25, 7.0)
SPECK = "<box><size>1e-200 1e-200 1</size></box>"
LOOSE = "<model name='l'><link><collision/><collision/></link></model>"


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
    env = NavigationEnv(world=world, physics="kinematic", contact=True)
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
    pose = "0 0 0 30 0 90"
    wall = "<box><size>4 0.2 1</size></box>"
    models = [
        model(wall, "1 0 0.5 0 0 90").replace("frame=''", f"degrees='{flag}'")
        for flag in ("true", "1")
    ]
    models.append(model(wall, pose).replace("frame=''", "degrees='true'"))
    with pytest.warns(UserWarning, match="left out 1 tilted parts$"):
        world = load_gazebo_world(write(tmp_path, "".join(models)), size=(9, 9), center=(0, 0))
    assert not world.polygons and len(world.boxes) == 2
    for each in world.boxes:
        assert tuple(each.bounds) == pytest.approx((0.9, -2.0, 1.1, 2.0))


def test_the_state_of_the_file_says_where_models_are(tmp_path):
    state = "<state><model name='m'><pose>3 4 0 0 0 0</pose></model></state>"
    world = load_gazebo_world(
        write(tmp_path, model(CYLINDER) + state), size=(10, 10), center=(0, 0)
    )
    assert (world.cylinders[0].x, world.cylinders[0].y) == (3.0, 4.0)


def test_shapes_above_the_robot_or_in_the_floor_are_no_obstacles(tmp_path):
    slab = "<box><size>1 1 0.1</size></box>"
    models = "".join(model(slab, f"0 0 {z} 0 0 0") for z in (-0.045, 0.3, 0.6))
    room = {"size": (4.0, 4.0), "center": (0.0, 0.0)}
    assert len(load_gazebo_world(write(tmp_path, models), **room).boxes) == 1
    assert len(load_gazebo_world(write(tmp_path, models), **room, height=1.0).boxes) == 2


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
        world = load_gazebo_world(write(tmp_path, content), size=(4.0, 4.0))
    assert len(world.cylinders) == 1
    text = str(caught[0].message)
    with pytest.raises(WorldFileError, match="is mostly left out; pass a size") as error:
        load_gazebo_world(write(tmp_path, content))
    assert text.split(": ", 1)[1] in str(error.value)
    for part in (
        "read 2 of 9 collisions, left out ",
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
        (model(CYLINDER.replace("0.075", "-1")), 5, "radius must be positive, got '-1'"),
        (model("<box></box>"), 5, "box lacks size"),
        ("<model>", 4, "is not XML: mismatched tag"),
        ("", 3, "has no obstacle"),
        (model(CYLINDER, "1e308 0 0 0 0 0"), 4, "pose must be 6 numbers, got '1e308 0 0 0 0 0'"),
        (model("<plane><normal>0 0 0</normal></plane>"), 5, "normal must not be zero"),
        (model("<box><size>1 1 1</size></box>"), 3, r"has no room for a robot in its .1\.001"),
        (
            model("<mesh/>") + LOOSE,
            3,
            "no size; read 0 of 3 .* 1 geometries of the kind mesh, 1 mod",
        ),
    ],
)
def test_a_bad_file_is_rejected_with_line_and_reason(content, line, reason, tmp_path):
    with pytest.raises(WorldFileError, match=reason) as caught:
        load_gazebo_world(write(tmp_path, content))
    assert f"room.world:{line}: " in str(caught.value)


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


DISC = "<cylinder><radius>8</radius><length>0.3</length></cylinder>"
SQUARE = "<box><size>14 14 0.1</size></box>"
FLOORS = {
    "slab under all": (box(0, 0, 0.05, "12 12 0.1"), 0.0),
    "slab between the walls": (box(0, 0, 0.05, "9.8 9.8 0.1"), 0.0),
    "four tiles": ("".join(box(x, y, 0.02, "5 5 0.04") for x in (-3, 2) for y in (-3, 2)), 0.0),
    "carpet on a slab": (box(0, 0, 0.05, "12 12 0.1") + box(0, 0, 0.11, "11 11 0.02"), 0.1),
    "turned square": (model(SQUARE, "0 0 0.05 0 0 0.7"), 0.1),
    "slab in the air": (box(0, 0, 2.95, "12 12 0.1"), 3.0),
    "plane in a pit": (model("<plane/>", "0 0 -1 0 0 0"), -1.0),
    "ground wider than the house": (
        box(0, 0, -0.5, "90 90 1.1") + box(0, 0, 0.1, "11 11 0.1"),
        0.1,
    ),
}


@pytest.mark.parametrize("name", FLOORS)
def test_what_lies_under_everything_else_is_the_floor(name, tmp_path):
    floor, bottom = FLOORS[name]
    content = walls(bottom) + box(2, 2, bottom + 0.5, "1 1 1") + floor
    world, told = quietly(write(tmp_path, content), size=(20.0, 20.0), center=(0.0, 0.0))
    assert not told
    assert world.clearance(0.0, 0.0) == pytest.approx(1.5 * math.sqrt(2))
    assert world.clearance(2.0, 2.0) == 0.0
    assert len(world.obstacles) == 5


@pytest.mark.parametrize(
    ("geometry", "turn", "bounds"),
    [
        ("<box><size>1 2 3</size></box>", f"{math.pi / 2} 0 0", (1, 3)),
        ("<box><size>1 2 3</size></box>", "0 1.5708 0", (3, 2)),
        ("<box><size>1 2 3</size></box>", "-1.5708 0 1.5708", (3, 1)),
        ("<box><size>1 2 3</size></box>", "0.000012 -0.000004 3.14159", (1, 2)),
        ("<cylinder><radius>0.5</radius><length>3</length></cylinder>", "3.14159 0 0", (1, 1)),
        ("<cylinder><radius>0.5</radius><length>3</length></cylinder>", "1.5708 0 0", (1, 3)),
        ("<plane><normal>1 0 0</normal><size>1 3</size></plane>", "0 0 0", (0.01, 3)),
        ("<plane><size>3 2</size></plane>", "1.5708 0 0", (3, 0.01)),
    ],
)
def test_quarter_turns_exchange_the_axes(geometry, turn, bounds, tmp_path):
    path = write(tmp_path, walls() + model(geometry, f"2 -1 0.5 {turn}"))
    world, told = quietly(path, center=(0, 0))
    assert not told
    shape = (
        world.obstacles[-1] if "cylinder" not in geometry or bounds == (1, 1) else world.boxes[4]
    )
    assert not world.polygons
    x_min, y_min, x_max, y_max = shape.bounds
    assert (x_max - x_min, y_max - y_min) == pytest.approx(bounds, abs=1e-4)
    assert ((x_max + x_min) / 2, (y_max + y_min) / 2) == pytest.approx((2, -1))


def test_an_upright_plane_that_is_turned_is_a_wall(tmp_path):
    plane = "<plane><normal>0.6 0.8 0</normal><size>2 2</size></plane>"
    world = load_gazebo_world(write(tmp_path, walls() + model(plane, "1 1 0.5 0 0 0")))
    # Its sides are turned in its plane: 2 * 0.8 + 2 * 0.6 along the wall.
    assert world.polygons[0].area == pytest.approx(2.8 * 0.01)


def test_the_state_of_the_file_scales_models(tmp_path):
    state = "".join(
        f"<model name='{name}'><pose>2 2 0.5 0 0 {yaw}</pose><scale>{scale}</scale></model>"
        for name, yaw, scale in (("b", math.pi / 2, "1 3 1"), ("c", 0, "4 4 0.1"))
    )
    content = box(2, 2, 0.5, "1 1 1", name="b") + model(CYLINDER, name="c")
    path = write(tmp_path, walls() + content + f"<state>{state}</state>")
    world = load_gazebo_world(path, center=(0, 0))
    assert world.boxes[4].bounds == pytest.approx((0.5, 1.5, 3.5, 2.5))
    assert world.cylinders[0].radius == pytest.approx(0.3)


def test_collisions_in_unknown_places_are_counted(tmp_path):
    crowd = f"<population>{model(CYLINDER)}</population>"
    bare = model("").replace("<geometry></geometry>", "<pose>0 0 0 0 0 0</pose>")
    _, told = quietly(write(tmp_path, walls() + crowd + bare))
    assert told.endswith(
        "read 4 of 6 collisions, left out 1 geometries of the kind none, 1 other collisions"
    )


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<sdf", "<!-- gz topic -t x --msgtype y -- -->\n<!---->\n<sdf"),
        ("<?xml", "\n  \n<?xml"),
        ("<?xml", "<!-- License -- of\nall -->\n<?xml"),
        ("<?xml", "\ufeff<?xml"),
        ("<?xml version='1.0'?>\n", ""),
        ("<?xml", "junk <?xml"),
        ("<world", "<plugin name='a&b'>x & y &lt; <![CDATA[ <!-- -- ]]></plugin>\n<world"),
        ("</sdf>", "</sdf>\n<!-- -- -->\n<sdf/> junk"),
    ],
)
def test_what_gazebo_takes_for_xml_is_read_with_its_lines(old, new, tmp_path):
    path = write(tmp_path, walls() + "<model name='m'><static>1</static><pose>0</pose></model>")
    path.write_text(path.read_text().replace(old, new, 1))
    text = path.read_text()
    line = 1 + text[: text.index("<pose>0<")].count("\n")
    with pytest.raises(
        WorldFileError, match=rf"room.world:{line}: pose must be 6 numbers, got '0'"
    ):
        load_gazebo_world(path)
    path.write_text(text.replace("<pose>0<", "<pose>0 0 0 0 0 0<"))
    assert len(load_gazebo_world(path).boxes) == 4


def test_a_file_in_latin_1_is_read(tmp_path):
    path = write(tmp_path, walls().replace("name='m'", "name='caf\xe9'"))
    path.write_bytes(path.read_text().encode("latin-1"))
    assert len(load_gazebo_world(path).boxes) == 4


@pytest.mark.parametrize("text", [b"<!--", b"<?", b"<![CDATA[", b"&"])
def test_marks_without_an_end_are_rejected_soon(text, tmp_path):
    (tmp_path / "a.world").write_bytes(text * 500_000)
    start = time.process_time()
    with pytest.raises(WorldFileError, match="is not XML"):
        load_gazebo_world(tmp_path / "a.world")
    assert time.process_time() - start < 2.0


@pytest.mark.parametrize("text", ["plain text", "(", "<sdf>(</sdf", "a: (b)"])
def test_other_text_is_not_taken_for_a_world_of_stage(tmp_path, text):
    (tmp_path / "yard.world").write_text(text)
    with pytest.raises(WorldFileError, match="is not XML"):
        resolve_world(tmp_path / "yard.world")
