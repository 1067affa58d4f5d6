"""The path on a robot's map, against SciPy's Dijkstra on the same map, and what it is good for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from mpfa_envs import (
    Box,
    GoalRelabeling,
    Lidar,
    NavigationEnv,
    TaskConfig,
    VectorNavigationEnv,
    World,
    generate_world,
)
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.scene.colors import PATH
from mpfa_envs.sensing.map_loops import BLOCKED, TIGHT
from mpfa_envs.sensing.map_memory import RESOLUTION, MapMemory
from mpfa_envs.worlds.shapes import OccupancyGrid
from tests.envs.shapes import random_shapes

ROBOT = ROBOTS["turtlebot2"]
FACTORS = (1, 3, 30, 200)
POCKET = World(
    name="pocket",
    boxes=(Box(1.0, -1.5, 1.2, 1.5), Box(-1.0, 1.3, 1.0, 1.5), Box(-1.0, -1.5, 1.0, -1.3)),
)
"""A U that is open to the left."""


def scan(memory: MapMemory, lidar: Lidar, pose: tuple[float, float, float], goal: tuple) -> list:
    motions = np.array([[*pose, 0.0, 0.0]])
    return memory.remember(motions, np.array([goal]), lidar.cast(*pose)[None])[0].tolist()


def levels_of_points(points: np.ndarray, memory: MapMemory) -> np.ndarray:
    """What the points that the lidar met make of each cell."""
    columns, rows = memory.arrays.shapes[0]
    origin = memory.arrays.origins[0]
    x = origin[0] + RESOLUTION * np.arange(columns)[:, None, None]
    y = origin[1] + RESOLUTION * np.arange(rows)[None, :, None]
    gaps = np.hypot(x - points[:, 0], y - points[:, 1]).min(axis=2) - ROBOT.radius
    return np.searchsorted([-0.22, -0.06, 0.02], -gaps, side="right")


def cheapest(levels: np.ndarray, goal: tuple[int, int]) -> np.ndarray:
    """Costs of the paths from all cells to the goal, by SciPy."""
    columns, rows = levels.shape
    edges = []
    for i in range(columns):
        for j in range(rows):
            for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
                to = i + di, j + dj
                if 0 <= to[0] < columns and 0 <= to[1] < rows:
                    factor = max(FACTORS[levels[i, j]], FACTORS[levels[to]])
                    length = 14 if di and dj else 10
                    edges.append((i * rows + j, to[0] * rows + to[1], factor * length))
    starts, ends, costs = np.array(edges).T
    graph = csr_array((costs.astype(float), (starts, ends)), shape=(levels.size, levels.size))
    found = dijkstra(graph, directed=False, indices=goal[0] * rows + goal[1])
    return found.reshape(levels.shape)


@pytest.mark.parametrize(("seed", "mount"), [(0, (0.0, 0.0)), (1, (0.1, 0.2))])
def test_the_path_is_the_cheapest_after_every_scan(seed: int, mount: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    world = random_shapes(rng, boxes=4, cylinders=4)
    lidar = Lidar(world, mount=mount)
    memory = MapMemory(1, ROBOT, lidar)
    memory.begin(0, world)
    goal, points = (3.9, 2.9), []
    pose = np.array([-4.0, -3.0, 0.0])
    for _ in range(6):
        angles = pose[2] + lidar.angles
        ranges = lidar.cast(*pose)
        met = ranges < lidar.max_range
        forward = np.array([math.cos(pose[2]), math.sin(pose[2])])
        sensor = pose[:2] + mount[0] * forward + mount[1] * np.array([-forward[1], forward[0]])
        points += [
            sensor + r * np.array([math.cos(a), math.sin(a)])
            for r, a in zip(ranges[met], angles[met], strict=True)
        ]
        path = scan(memory, lidar, tuple(pose), goal)
        levels = levels_of_points(np.array(points), memory)
        np.testing.assert_array_equal(memory.arrays.levels[0], levels)
        cell, end = (
            tuple(np.rint((np.array(at) - memory.arrays.origins[0]) / RESOLUTION).astype(int))
            for at in (pose[:2], goal)
        )
        assert path[2] == pytest.approx(cheapest(levels, end)[cell] * RESOLUTION / 10)
        assert math.hypot(path[0], path[1]) == pytest.approx(1.0)
        pose += [rng.uniform(0.0, 0.6), rng.uniform(0.0, 0.5), rng.uniform(-0.5, 0.5)]


def test_a_path_through_a_tight_gap_costs_more_than_one_near_a_wall() -> None:
    half = ROBOT.radius + 0.04  # Of a gap in which the rim is 4 cm from either side.
    world = World(
        name="gap",
        size=(6.1, 4.1),  # An odd number of cells, one of which has its center at zero.
        boxes=(Box(0.9, half, 1.1, 2.05), Box(0.9, -2.05, 1.1, -half)),
    )
    lidar, memory = Lidar(world), MapMemory(1, ROBOT, Lidar(world))
    memory.begin(0, world)
    for side, heading in ((2.0, 0.0), (0.0, 0.0)):  # Both sides of the wall are seen.
        path = scan(memory, lidar, (side, 0.0, heading), (2.0, 0.0))
    origin = memory.arrays.origins[0]
    start, end, gap = (
        tuple(np.rint((np.array(at) - origin) / RESOLUTION).astype(int))
        for at in ((0.0, 0.0), (2.0, 0.0), (1.0, 0.0))
    )
    levels = memory.arrays.levels[0]
    assert levels[gap] == TIGHT
    assert path[2] == pytest.approx(cheapest(levels, end)[start] * RESOLUTION / 10)
    assert path[2] > 6.0  # Were a tight cell as cheap as one near a wall: 2 m at three times.


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("off", [0.0, 0.025, 0.05, 0.075])
def test_a_door_ten_centimeters_wider_than_the_robot_is_open_wherever_cells_begin(
    off: float, known: bool
) -> None:
    half = ROBOT.radius + 0.05
    boxes = (Box(0.9, off + half, 1.1, 2.05), Box(0.9, -2.05, 1.1, off - half))
    world = World(name="door", size=(6.1, 4.1), boxes=boxes)
    lidar, memory = Lidar(world), MapMemory(1, ROBOT, Lidar(world))
    memory.begin(0, world, plan=world if known else None)
    for x in np.linspace(0.0, 2.0, 9):
        path = scan(memory, lidar, (x, off, 0.0), (2.0, off))
    columns, rows = np.rint((np.array((1.0, off)) - memory.arrays.origins[0]) / RESOLUTION)
    door = memory.arrays.levels[0, int(columns), int(rows) - 1 : int(rows) + 2]
    assert door.min() == TIGHT and door.max() == BLOCKED
    assert path[2] < 1.0


def test_a_robot_without_a_scan_keeps_its_map_and_path() -> None:
    lidar, memory = Lidar(POCKET), MapMemory(2, ROBOT, Lidar(POCKET))
    motions, goals = np.zeros((2, 5)), np.full((2, 2), 3.0)
    for index in range(2):
        memory.begin(index, POCKET)
    ranges = np.tile(lidar.cast(0.0, 0.0, 0.0), (2, 1))
    paths = memory.remember(motions, goals, ranges, np.array([False, True])).copy()
    assert not memory.arrays.levels[0].any() and memory.arrays.levels[1].any()
    np.testing.assert_array_equal(paths[0], 0.0)
    assert paths[1].any()


def test_an_episode_begins_with_an_empty_map() -> None:
    memory = MapMemory(2, ROBOT, Lidar(POCKET))
    memory.begin(0, POCKET)
    before = scan(memory, Lidar(POCKET), (0.0, 0.0, 0.0), (3.0, 0.0))
    assert memory.arrays.levels[0].any()
    assert not memory.arrays.levels[1].any()
    memory.begin(0, POCKET)
    assert not memory.arrays.levels[0].any()
    assert scan(memory, Lidar(POCKET), (0.0, 0.0, 0.0), (3.0, 0.0)) == before


def test_the_map_extends_the_observation_and_changes_nothing_else() -> None:
    worlds = [generate_world("mazes", 3), generate_world("halls", 4)]
    envs = [
        VectorNavigationEnv(2, world=worlds, physics="kinematic", memory=memory)
        for memory in ("none", "map")
    ]
    rng = np.random.default_rng(0)
    seen = [env.reset(seed=0)[0] for env in envs]
    for _ in range(50):
        np.testing.assert_array_equal(seen[0], seen[1][:, :24])
        assert envs[1].observation_space.contains(seen[1])
        actions = rng.uniform(-0.5, 1.0, (2, 2)).astype(np.float32)
        seen = [env.step(actions)[0] for env in envs]
    for env in envs:
        env.close()


def test_a_picture_shows_obstacles_and_the_path_to_the_goal() -> None:
    env = NavigationEnv(
        world=POCKET, physics="kinematic", memory="map", render_mode="rgb_array", max_steps=20
    )
    env.reset(options={"start": (0.0, 0.0, 0.0), "goal": (3.0, 0.0)})
    memory = env.robots._batch.memory
    sketch = memory.known_map(0, 0.0, 0.0)
    assert math.dist(sketch.path[0], (0.0, 0.0)) < 0.25
    assert math.dist(sketch.path[-1], (3.0, 0.0)) < 0.1
    steps = [math.dist(a, b) for a, b in zip(sketch.path, sketch.path[1:], strict=False)]
    assert max(steps) == pytest.approx(math.sqrt(2) * RESOLUTION)
    assert sketch.blocked.sum() == (memory.arrays.levels[0] == BLOCKED).sum() > 50
    # Past what it sees of an arm of the pocket, which is the part before it.
    assert min(x for x, y in sketch.path if abs(y) > 1.4) < -0.3
    orange = (env.render() == PATH[:3]).all(axis=-1)
    assert 50 < orange.sum() < 5000
    env.close()


@pytest.mark.parametrize("world", ["D", "mazes-3", "map"])
def test_a_plan_gives_cells_the_levels_that_hits_all_over_would_give(world: str) -> None:
    if world == "map":
        cells = np.zeros((120, 80), np.bool_)
        cells[60, 20:] = cells[20:40, 30] = True
        grid = OccupancyGrid(cells, 0.1)
        room = World(name="map", size=grid.size, occupancy=grid)
    else:
        room = resolve_world(world)
    robot = ROBOTS["kobuki"]
    memory = MapMemory(2, robot, lidar := Lidar(room, sectors=720, field_of_view=360.0))
    memory.begin(0, room, plan=room)
    memory.begin(1, room)
    rng = np.random.default_rng(0)
    goals = np.zeros((2, 2))
    only = np.array([False, True])
    for _ in range(400):
        x, y = rng.uniform(-0.5, 0.5, 2) * room.size
        if room.clearance(x, y) > 0.05:
            ranges = np.tile(lidar.cast(x, y, 0.0), (2, 1))
            memory.remember(np.tile([x, y, 0.0, 0.0, 0.0], (2, 1)), goals, ranges, only)
    # All that was hit is known; inside of obstacles nothing is hit.
    columns, rows = memory.arrays.shapes[0]
    known, hit = memory.arrays.levels[:, :columns, :rows]
    assert (known >= hit).all()
    places = np.indices(known.shape).reshape(2, -1).T * 0.1 + memory.arrays.origins[0]
    free = (room.clearances(places) > 0.03).reshape(known.shape)
    assert (known[free] == hit[free]).mean() > 0.97


def test_with_a_plan_the_path_is_known_before_anything_is_seen() -> None:
    wall = World(name="wall", size=(12.0, 8.0), boxes=(Box(1.0, -4.0, 1.2, 2.5),))
    ways = {}
    for plan in ("unknown", "known"):
        robot = {"robot": "kobuki", "memory": "map", "plan": plan, "physics": "kinematic"}
        env = NavigationEnv(world=wall, lidar={"max_range": 2.0}, **robot)
        seen, _ = env.reset(options={"start": (-3.0, -2.0, 0.0), "goal": (4.0, -2.0)})
        ways[plan] = seen[env.config.observation_slices["way_length"]][0]
        env.close()
    assert ways["unknown"] == pytest.approx(0.7, abs=0.02)
    assert ways["known"] > 1.1


def test_a_plan_needs_a_map() -> None:
    with pytest.raises(ValueError, match="plan must be 'unknown' without a map"):
        TaskConfig(plan="known")
    with pytest.raises(ValueError, match="plan must be"):
        TaskConfig(memory="map", plan="some")
    with pytest.raises(ValueError, match="plan must be 'unknown' with goals in hindsight"):
        GoalRelabeling(TaskConfig(memory="map", plan="known", progress="none"))
