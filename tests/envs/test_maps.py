"""Maps of ROS: what is read and written, and what a robot meets in them."""

import math
import pickle
import warnings

import numpy as np
import pytest

from mpfa_envs import (
    ROBOTS,
    WORLDS,
    Box,
    Lidar,
    NavigationEnv,
    VectorNavigationEnv,
    World,
    WorldFileError,
    load_world,
    save_world,
)
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.worlds.shapes import OccupancyGrid
from tests.envs.map_files import write_map
from tests.envs.shapes import GRID, SCATTERED, cells


@pytest.fixture(scope="module")
def scattered():
    """The same room twice: with the cells of a map, and with a box for each."""
    half, side = np.array(GRID.size) / 2, GRID.resolution
    corners = np.argwhere(GRID.occupied) * side - half
    boxes = tuple(Box(x, y, x + side, y + side) for x, y in corners.tolist())
    return SCATTERED, World(name="boxes", size=GRID.size, boxes=boxes)


def places(world, count, seed=1):
    """Points and headings in the room."""
    half = np.array(world.size) / 2
    rng = np.random.default_rng(seed)
    return np.column_stack(
        (rng.uniform(-half, half, (count, 2)), rng.uniform(-math.pi, math.pi, count))
    )


def test_cells_are_as_far_as_boxes_in_their_place(scattered):
    cells, boxes = scattered
    points = places(cells, 400)[:, :2]
    expected = np.array([boxes.clearance(x, y) for x, y in points])
    np.testing.assert_allclose([cells.clearance(x, y) for x, y in points], expected, atol=1e-12)
    np.testing.assert_allclose(cells.clearances(points), expected, atol=1e-12)
    grids = [FreeGrid(world, distance=0.2, resolution=0.07) for world in (cells, boxes)]
    expected = np.maximum(grids[1].clearance, 0.0)
    behind = grids[1].clearance < 0.0
    np.testing.assert_allclose(
        np.maximum(grids[0].clearance, 0.0)[~behind], expected[~behind], atol=1e-6
    )


def test_rays_meet_cells_where_they_meet_boxes_in_their_place(scattered):
    lidars = [Lidar(world, sectors=18) for world in scattered]
    for x, y, heading in places(scattered[0], 200):
        np.testing.assert_allclose(*(lidar.cast(x, y, heading) for lidar in lidars), atol=1e-9)


def test_robots_share_a_map_and_unused_maps_go(scattered):
    world = scattered[0]
    other = World(name="other", size=(4.0, 4.0), occupancy=OccupancyGrid(cells((20, 20)), 0.2))
    again = pickle.loads(pickle.dumps(world))
    env = VectorNavigationEnv(3, world=[world, WORLDS["B"], again], physics="kinematic")
    env.reset(seed=0)
    arrays = env._batch.worlds.arrays
    assert arrays.grid_of.tolist() == [0, -1, 0]
    assert arrays.grids.shapes.tolist() == [[40, 30]]
    env._batch.worlds[0] = env._batch.worlds[2] = WORLDS["B"]
    env._batch.worlds[1] = other
    arrays = env._batch.worlds.arrays
    assert arrays.grid_of.tolist() == [-1, 0, -1]
    assert arrays.grids.shapes.tolist() == [[20, 20]]


def test_a_map_that_is_written_is_read_as_it_was(scattered, tmp_path):
    grid = OccupancyGrid(cells(), 0.2, origin=(-3.5, 12.25))
    world = World(name="floor", size=grid.size, occupancy=grid)
    world.to_map(tmp_path / "floor.yaml")
    assert World.from_map(tmp_path / "floor.yaml") == world
    assert load_world(tmp_path / "floor.yaml") == world
    assert hash(load_world(tmp_path / "floor.yaml")) == hash(world)
    assert world != World(name="floor", size=grid.size, occupancy=OccupancyGrid(cells(), 0.2))


@pytest.mark.parametrize("name", ["D", "barn-3", "halls-2"])
def test_shapes_become_cells_that_cover_them_and_little_more(name, tmp_path):
    world = NavigationEnv(world=name, physics="kinematic").world
    world.to_map(tmp_path / "map.yaml", resolution=0.1)
    found = load_world(tmp_path / "map.yaml")
    points = places(world, 500)[:, :2]
    gaps = found.clearances(points) - np.maximum(world.clearances(points), 0.0)
    assert gaps.max() <= 0.1  # A corner of an obstacle may stick out of its cell.
    assert gaps.min() >= -0.1 * math.sqrt(2)


def test_the_origin_of_an_image_is_its_lower_left_corner(tmp_path):
    shades = np.full((20, 40), 254, dtype=np.uint8)
    shades[0, 10] = 0  # At the top.
    world = load_world(write_map(tmp_path, shades))
    assert world.size == (2.0, 1.0)
    assert world.occupancy.occupied[10, 19]
    assert world.occupancy.occupied.sum() == 1
    assert world.occupancy.center == (0.0, 2.5)
    assert world.clearance(-0.475, 0.475) == 0.0


def test_a_map_is_cut_to_its_free_cells(tmp_path):
    shades = np.full((60, 50), 205, dtype=np.uint8)
    shades[10:30, 15:40] = 254
    shades[10:30, 14] = 0
    world = load_world(write_map(tmp_path, shades))
    assert world.occupancy.occupied.shape == (27, 22)
    assert world.occupancy.origin == pytest.approx((-1.0 + 14 * 0.05, 2.0 + 29 * 0.05))
    whole = World.from_map(write_map(tmp_path, shades), unknown="free")
    assert whole.size == (2.5, 3.0)
    assert whole.occupancy.occupied.sum() == 20


def test_unknown_cells_of_map_saver_are_not_free(tmp_path):
    shades = np.full((140, 160), 205, dtype=np.uint8)
    shades[20:120, 20:140] = 0  # A building with walls of one cell, and a margin of 1 m around it.
    shades[21:119, 21:139] = 254
    saved = write_map(tmp_path, shades, free_thresh=0.25)
    with pytest.warns(UserWarning, match=r"map\.yaml:6: free_thresh = 0\.25 .* unknown") as caught:
        world = load_world(saved)
    assert len(caught) == 1
    assert world.size == pytest.approx((120 * 0.05, 100 * 0.05))
    env = VectorNavigationEnv(50, world=world, physics="kinematic")
    for seed in range(4):
        env.reset(seed=seed)
        assert (np.abs(env.poses[:, :2]) < [59 * 0.05, 49 * 0.05]).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_world(write_map(tmp_path, shades, free_thresh=0.196)) == world
        assert World.from_map(saved, unknown="free").size == pytest.approx((8.0, 7.0))


@pytest.mark.filterwarnings("ignore:.*free_thresh = 0.[279]")
@pytest.mark.parametrize(
    ("changes", "occupied"),
    [
        ({}, [1, 1, 1, 0]),  # 0, 100 and 205 are p of 1, 0.61 and 0.2, 254 of 0.004.
        ({"occupied_thresh": 0.6, "free_thresh": 0.21}, [1, 1, 1, 0]),
        ({"free_thresh": 0.25, "mode": "scale"}, [1, 1, 0, 0]),
        ({"occupied_thresh": 0.5, "free_thresh": 0.7}, [1, 1, 1, 0]),
        ({"occupied_thresh": 0.1, "free_thresh": 0.9, "mode": "scale"}, [1, 1, 1, 0]),
        ({"negate": 1}, [0, 1, 1, 1]),
        ({"mode": "scale"}, [1, 1, 0, 0]),
        ({"mode": "scale", "occupied_thresh": 0.99, "free_thresh": 0.5}, [1, 0, 0, 0]),
        ({"mode": "raw"}, [0, 1, 1, 1]),
    ],
)
def test_shades_mean_what_the_thresholds_and_the_mode_say(changes, occupied, tmp_path):
    shades = np.full((3, 12), 0 if occupied[0] == 0 else 254, dtype=np.uint8)
    shades[1, 1:12:3] = [0, 100, 205, 254]
    world = load_world(write_map(tmp_path, shades, **changes))
    assert world.occupancy.occupied[1:12:3, 1].astype(int).tolist() == occupied


@pytest.mark.parametrize("kind", ["P2", "P5"])
def test_images_may_have_comments_and_be_text(kind, tmp_path):
    head = f"{kind}\n# made by a robot\n3 2\n# and more\n255\n".encode()
    rows = [254, 0, 254, 254, 254, 254]
    body = " ".join(map(str, rows)).encode() if kind == "P2" else bytes(rows)
    path = write_map(tmp_path, None)
    (tmp_path / "map.pgm").write_bytes(head + body)
    assert load_world(path).occupancy.occupied.T.tolist() == [[False] * 3, [False, True, False]]


@pytest.mark.parametrize(
    ("changes", "line", "reason"),
    [
        ({"image": "other.pgm"}, 1, "there is no"),
        ({"image": "map.yaml"}, 1, "cannot be read"),
        ({"resolution": -0.05}, 2, "resolution must be positive, got -0.05"),
        ({"resolution": 500}, 2, None),
        ({"resolution": "fine"}, 2, "resolution must be a number in meters, got 'fine'"),
        ({"origin": "[0, 0]"}, 3, "origin must be .x, y, yaw., got 2 entries"),
        ({"origin": "[0, 0, 0.3]"}, 3, "yaw of 0"),
        ({"image": "x" * 5000}, 1, "image must be one of .* cannot be read"),
        ({"negate": 2}, 4, "negate must be 0 or 1, got 2"),
        ({"occupied_thresh": "nan"}, 5, "occupied_thresh must be a number, got 'nan'"),
        ({"origin": "[0, 0, 1.58]"}, 3, "yaw of 0 or a multiple of pi/2.*got 1.58"),
        ({"image": "/home/user/maps/map.pgm"}, 1, "there is no .*; write image: map.pgm, which"),
        ({"image": r"C:\maps\map.pgm"}, 1, "there is no .*; write image: map.pgm, which"),
        ({"resolution": None, "rezolution": 1}, 1, "is missing; .* did you mean 'resolution'"),
        ({"mode": "tinary"}, 7, "mode must be one of .*, got tinary"),
        ({"negate": None}, 1, "negate is missing"),
        ({"resolution": "!!python/object:os.system x"}, 2, None),
    ],
)
def test_a_bad_map_is_rejected_with_line_and_reason(changes, line, reason, tmp_path):
    shades = np.full((3, 4), 254, dtype=np.uint8)
    with pytest.raises(WorldFileError, match=reason) as caught:
        load_world(write_map(tmp_path, shades, **changes))
    wrong = 1 if changes == {"resolution": 500} else line
    assert f"map.yaml:{wrong}: " in str(caught.value)


@pytest.mark.parametrize("content", [b"P5\n2 1\n255\n\xfe\xfe", b"<?xml version='1.0'?>\n<sdf/>"])
def test_a_file_of_another_kind_is_rejected_with_the_kinds_that_are_read(content, tmp_path):
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(
        WorldFileError, match=r"(not UTF-8|mapping).*\.yml .* image of a ROS map.*\.sdf"
    ):
        load_world(tmp_path / "map.pgm")
    with pytest.raises(ValueError, match=r"world must be .*\.yml .* image of a ROS map.*\.sdf"):
        NavigationEnv(world=str(tmp_path / "map.pgm"))


def test_huge_broken_or_full_images_are_rejected(tmp_path):
    path = write_map(tmp_path, None)
    for side, reason in (
        (5000, "is truncated"),
        (9000, "at most 67108864 pixels"),
        (100_000, "exceeds limit"),
    ):
        (tmp_path / "map.pgm").write_bytes(f"P5\n{side} {side}\n255\n".encode())
        with pytest.raises(WorldFileError, match=reason):
            load_world(path)
    write_map(tmp_path, np.full((5000, 4000), 254, dtype=np.uint8), resolution=0.01)
    with pytest.raises(WorldFileError, match="at most 16000000 pixels in its free part"):
        load_world(path)
    (tmp_path / "map.pgm").write_bytes(b"P5\n100 100\n255\nshort")
    with pytest.raises(WorldFileError, match="cannot be read"):
        load_world(path)
    write_map(tmp_path, np.zeros((3, 3), dtype=np.uint8))
    with pytest.raises(WorldFileError, match="must have a free cell"):
        load_world(path)
    with pytest.raises(ValueError, match="unknown must be one of"):
        World.from_map(path, unknown="maybe")


def test_bad_grids_and_worlds_are_rejected_before_they_are_made(scattered, tmp_path):
    world = scattered[0]
    with pytest.raises(ValueError, match="occupied must be an array"):
        OccupancyGrid(np.zeros((3, 3)), 0.1)
    with pytest.raises(ValueError, match="resolution must be positive"):
        OccupancyGrid(np.zeros((3, 3), dtype=bool), 0.0)
    with pytest.raises(ValueError, match="size must be that of the occupancy"):
        World(name="map", size=(3.0, 3.0), occupancy=world.occupancy)
    with pytest.raises(ValueError, match="must be written by to_map"):
        save_world(world, tmp_path / "world.yaml")
    with pytest.raises(ValueError, match="path must end in"):
        world.to_map(tmp_path / "map.pgm")
    with pytest.raises(ValueError, match="resolution must leave"):
        WORLDS["A"].to_map(tmp_path / "map.yaml", resolution=0.001)
    assert not list(tmp_path.iterdir())


def test_a_robot_drives_in_a_map_as_among_boxes(scattered, physics):
    envs = [NavigationEnv(world=world, physics=physics) for world in scattered]
    task = envs[0].reset(seed=0) and envs[0].task
    assert scattered[1].clearance(*task.start[:2]) > ROBOTS["turtlebot2"].radius
    envs[1].reset(options=task._asdict())
    for _ in range(10):
        (seen, *ends, info), (expected, *expected_ends, other) = (
            env.step([0.6, 0.2]) for env in envs
        )
        np.testing.assert_allclose(seen, expected, atol=1e-6)
        assert ends == pytest.approx(expected_ends, abs=1e-6)
        assert info == pytest.approx(other, abs=1e-6)
        if any(ends[1:]):
            break
    for env in envs:
        env.close()


def test_a_map_is_rendered(scattered):
    env = NavigationEnv(world=scattered[0], physics="kinematic", render_mode="rgb_array")
    env.reset(seed=0)
    task, picture = env.task, env.render()
    env = NavigationEnv(world=scattered[1], physics="kinematic", render_mode="rgb_array")
    env.reset(options=task._asdict())
    # Boxes have an edge that cells have not.
    assert (picture != env.render()).any(axis=-1).mean() < 0.35
