from __future__ import annotations

import math
import time
from pathlib import Path

import pytest

from mpfa_envs import (
    EXAMPLE_WORLD,
    WORLDS,
    Box,
    NavigationEnv,
    World,
    WorldFileError,
    generate_world,
    load_world,
    save_world,
)

HALL = generate_world("halls", 1)
STAR = [
    [round((1.2 + 0.6 * (i % 2)) * part, 3) for part in (math.cos(i / 16), math.sin(i / 16))]
    for i in range(100)
]


@pytest.mark.parametrize("world", [*WORLDS.values(), load_world(EXAMPLE_WORLD), HALL])
def test_a_saved_world_comes_back_equal(world: object, tmp_path: Path) -> None:
    save_world(world, tmp_path / "world.yaml")
    assert load_world(tmp_path / "world.yaml") == world


def test_the_example_can_be_driven_in(physics: str) -> None:
    env = NavigationEnv(world=EXAMPLE_WORLD, physics=physics)
    _, info = env.reset(seed=0)
    assert info["x"] < -2.4
    assert env.step([0.0, 0.0])[4]["distance"] > 2.0
    env.close()


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("size: [4, 4]\nboxs: []\n", 2, "unknown key 'boxs' in the file; did you mean 'boxes'"),
        ("name: x\n", 1, "size is missing"),
        ("- 1\n", 1, "the file must be a mapping"),
        ("size: [4]\n", 1, r"size must be \[width, depth\], got 1 entries"),
        ("size: [4, wide]\n", 1, "size must be a number in meters, got 'wide'"),
        ("size: [4, 4]\nname: [a]\n", 2, "name must be text"),
        ("size: [4, 4]\nsize: [5, 5]\n", 2, "key 'size' appears twice"),
        ("size: [4, 4]\nboxes:\n  - 3\n", 3, "an entry of boxes must be a mapping"),
        (
            "size: [4, 4]\ncylinders:\n  - {x: 0, y: 0, radius: 1}\n  - {x: 0, y: 0}\n",
            4,
            "an entry of cylinders lacks the key 'radius'",
        ),
        (
            "size: [4, 4]\nboxes:\n  - {x_min: 1, x_max: 0, y_min: 0, y_max: 1}\n",
            3,
            "box must have x_min < x_max",
        ),
        (
            "size: [4, 4]\nboxes:\n  - {x_min: 1, x_max: 3, y_min: 0, y_max: 1}\n",
            3,
            "boxes must lie in the room",
        ),
        (
            "size: [4, 4]\nboxes:\n  - {x_min: -1, x_max: 1, y_min: -1, y_max: 1}\n"
            "goal:\n  - {x_min: -1, x_max: 1, y_min: -1, y_max: 1}\n",
            5,
            "an entry of goal has no point 0.5 m from every obstacle",
        ),
        ("size: [1e308, 1e308]\n", 1, r"size must be at most 1000 m, got \(1e\+308, 1e\+308\)"),
        (
            "size: [500, 500]\nboxes:\n"
            + "  - {x_min: 0, x_max: 1, y_min: 0, y_max: 1}\n" * 501
            + "cylinders:\n"
            + "  - {x: 0, y: 0, radius: 1}\n" * 500,
            1,
            "boxes, cylinders and polygons must be at most 1000 in all, got 1001",
        ),
        (
            f"size: [4, 4]\npolygons:\n- &p {STAR}\n" + "- *p\n" * 3000,
            3,
            "polygons must have at most 1000 entries, got 3001",
        ),
        (
            "size: [4, 4]\nstart:\n- &p {x_min: -1, x_max: 1, y_min: -1, y_max: 1}\n"
            + "- *p\n" * 1000,
            3,
            "start must have at most 1000 entries, got 1001",
        ),
        ("size: [4, 1_0]\n", 1, "size must be a number in meters, got '1_0'"),
        ("size: [4, 4]\npolygons:\n  - [[0, 0], 1]\n", 3, "a vertex must be a list"),
        ("size: [4, 4]\npolygons:\n  - [[0, 0], [1, 0]]\n", 3, "polygon must have 3 to 100 vert"),
        ("size: [4, 4\nboxes: 1\n", 2, "is not YAML"),
        ("size: !!python/object/apply:os.system [echo]\n", 1, "size must be"),
    ],
)
def test_a_bad_file_is_rejected_with_its_line(
    text: str, line: int, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(WorldFileError, match=f"bad.yaml:{line}: .*{message}"):
        load_world(path)
    assert time.process_time() - start < 3.0


@pytest.mark.parametrize("open_, close", [("[", "]"), ("{a: ", "}"), ("- ", "")])
def test_a_deeply_nested_file_is_rejected(open_: str, close: str, tmp_path: Path) -> None:
    path = tmp_path / "deep.yaml"
    path.write_text("size: " + open_ * 2000 + close * 2000)
    with pytest.raises(WorldFileError, match=r"deep.yaml.*(nested too deeply|is not YAML)"):
        load_world(path)


def test_a_too_long_file_is_rejected_unread(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text("#" * 1_000_001)
    with pytest.raises(WorldFileError, match=r"long.yaml: .* has more than 1000000 bytes"):
        load_world(path)


FENCES = "\n".join(
    f"  - {{x_min: {x}, x_max: {x + 0.5}, y_min: -499, y_max: 499}}" for x in range(-100, 100)
)


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ("  - {x_min: -400, x_max: 400, y_min: -400, y_max: 400}", "has no point 0.5 m"),
        # Passages that are a little too narrow, 200 of them, each of 1 km.
        (FENCES, "is too large to find a point 0.5 m|has no point 0.5 m"),
    ],
)
def test_a_large_region_without_room_is_rejected_soon(
    boxes: str, message: str, tmp_path: Path
) -> None:
    region = "start:\n  - {x_min: -99, x_max: 99, y_min: -400, y_max: 400}\n"
    path = tmp_path / "large.yaml"
    path.write_text(f"size: [1000, 1000]\nboxes:\n{boxes}\n{region}")
    start = time.process_time()
    with pytest.raises(WorldFileError, match=message):
        load_world(path)
    assert time.process_time() - start < 10.0


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World(name=" "), "name must be text"),
        (
            World(name="edge", start_regions=(Box(-5, -5, -4.8, 5),)),
            "an entry of start has no point 0.5 m",
        ),
    ],
)
def test_a_world_that_cannot_be_loaded_is_not_saved(
    world: World, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "world.yaml"
    path.write_text("kept")
    with pytest.raises(ValueError, match=f"world must be one that can be loaded.*{message}"):
        save_world(world, path)
    assert path.read_text() == "kept"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(WorldFileError, match=r"none.yaml: cannot be read"):
        NavigationEnv(world=tmp_path / "none.yaml")
