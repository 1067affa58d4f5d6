"""Planners on the known map: lengths against the grid's own, and followers that arrive."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from mpfa_envs import (
    WORLDS,
    Box,
    NavigationEnv,
    World,
    evaluate,
    make_planner,
    run_tasks,
    world_tasks,
)
from mpfa_envs.driver import Errand, Senses, as_driver
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.planners import (
    AntColony,
    MapPlanner,
    PurePursuit,
    Search,
    path_length,
    shortest_path,
)
from mpfa_envs.planners.ant_colony import moves_of_cells
from mpfa_envs.robots.model import ROBOTS

# A wall from side to side: nothing gets through.
DIVIDED = World(name="divided", size=(4.0, 4.0), boxes=(Box(-0.1, -2.0, 0.1, 2.0),))
FULL = World(name="full", size=(1.0, 1.0), boxes=(Box(-0.5, -0.5, 0.5, 0.5),))
TURTLEBOT = ROBOTS["turtlebot2"]


def places(grid: FreeGrid, count: int, seed: int = 0) -> list[tuple[float, float]]:
    """Positions in and around free cells."""
    rng = np.random.default_rng(seed)
    cells = grid.cells[rng.integers(len(grid.cells), size=count)]
    off = grid.resolution * (rng.random((count, 2)) - 0.5)
    return [
        (float(grid.xs[i] + across), float(grid.ys[j] + up))
        for (i, j), (across, up) in zip(cells, off, strict=True)
    ]


@pytest.mark.parametrize("world", ["D", "bars-3", "mazes-3"])
def test_a_path_is_as_long_as_that_of_the_grid(world: str) -> None:
    room = resolve_world(world)
    grid = FreeGrid(room, distance=0.25, resolution=0.2)
    ends = places(grid, 12)
    for start, goal in zip(ends[:6], ends[6:], strict=True):
        path = shortest_path(grid, start, goal)
        assert path is not None and path[0] == start and path[-1] == goal
        assert path_length(grid, path) == pytest.approx(grid.length(start, goal), abs=1e-9)
        for x, y in path[1:-1]:
            assert room.clearance(x, y) >= 0.25 - 1e-6


@pytest.mark.slow
def test_a_path_in_a_room_of_80_m_is_soon_there_and_takes_little_memory() -> None:
    # In a process of its own, as the peak of a process never falls.
    code = """
import resource, time
from mpfa_envs import World
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.planners import shortest_path
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for side in (4.0, 80.0):  # The first compiles the loops.
    before, began = peak(), time.process_time()
    grid = FreeGrid(World(name="hall", size=(side, side)), distance=0.25)
    corner = side / 2 - 0.5
    assert shortest_path(grid, (-corner, -corner), (corner, 0.3 * corner)) is not None
print((peak() - before) / 1024, time.process_time() - began)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    megabytes, seconds = map(float, done.stdout.split())
    assert megabytes < 150 and seconds < 3


@pytest.mark.slow
def test_a_planner_in_a_very_large_room_takes_cells_that_are_not_too_many() -> None:
    planner = make_planner("astar")
    assert isinstance(planner, MapPlanner)
    start, goal = (0.0, -5.0), (0.0, 5.0)
    for side in (190.0, 300.0):
        wall = Box(-side / 2, -0.1, side / 2, 0.1)
        divided = World(name="divided", size=(side, side), boxes=(wall,))
        assert planner.plan(divided, start, goal)[0] == [start, goal]
    assert len(planner.plan(World(name="hall", size=(300.0, 300.0)), start, goal)[0]) > 30


@pytest.mark.parametrize("world", ["A", "B", "D"])
def test_ants_find_a_path_within_a_tenth_of_the_shortest(world: str) -> None:
    grid = FreeGrid(WORLDS[world], distance=0.25, resolution=0.25)
    ends = places(grid, 6, seed=1)
    for start, goal in zip(ends[:3], ends[3:], strict=True):
        path = AntColony(iterations=20)(grid, start, goal)
        assert path is not None
        # From the nearest cell the path may be longer by the gaps, which the shortest avoids.
        assert path_length(grid, path) <= 1.1 * grid.length(start, goal) + grid.resolution


def test_ants_give_the_best_path_of_all_iterations_without_loops() -> None:
    grid = FreeGrid(WORLDS["D"], distance=0.25, resolution=0.25)
    neighbors, _ = moves_of_cells(grid)
    number = {tuple(cell): at for at, cell in enumerate(grid.cells.tolist())}
    lengths = []
    for iterations in range(1, 6):  # The first ones are the same each time.
        colony = AntColony(ants=2, iterations=iterations, greed=0.3)
        path = colony(grid, (-4.0, -4.0), (4.0, 4.0))
        assert path is not None
        lengths.append(path_length(grid, path))
        cells = [number[grid.index(*place)] for place in path[1:-1]]
        for at, cell in enumerate(cells):
            around = set(neighbors[cell].tolist())
            assert not around & set(cells[at + 2 :])
    assert lengths == sorted(lengths, reverse=True)


def test_ants_mark_the_iterations_path_and_the_best_so_far_in_turn() -> None:
    grid, lengths = FreeGrid(WORLDS["D"], distance=0.25, resolution=0.25), []
    places = np.stack((grid.xs[grid.cells[:, 0]], grid.ys[grid.cells[:, 1]]), axis=1)

    class Recorded(AntColony):
        def _mark(self, pheromone, neighbors, path) -> None:
            lengths.append(float(np.hypot(*np.diff(places[path], axis=0).T).sum()))
            super()._mark(pheromone, neighbors, path)

    Recorded(ants=2, iterations=12, greed=0.3)(grid, (-4.0, -4.0), (4.0, 4.0))
    best = np.minimum.accumulate(lengths)
    np.testing.assert_array_equal(lengths[1::2], best[1::2])
    assert (np.array(lengths[::2]) > best[::2]).any()


def test_ants_stop_after_the_iteration_in_which_time_is_up() -> None:
    grid = FreeGrid(WORLDS["D"], distance=0.25, resolution=0.25)
    ends = (-4.0, -4.0), (4.0, 4.0)
    hurried = AntColony(iterations=50, time_limit=1e-9)(grid, *ends)
    assert hurried == AntColony(iterations=1)(grid, *ends)


@pytest.mark.parametrize("search", [shortest_path, AntColony(ants=3, iterations=2)])
def test_a_blocked_goal_has_no_path(search: Search) -> None:
    divided = FreeGrid(DIVIDED, distance=0.25)
    assert search(divided, (-1.0, 0.0), (1.0, 0.0)) is None
    assert search(FreeGrid(FULL, distance=0.25), (0.0, 0.0), (0.1, 0.0)) is None


def test_pursuit_drives_on_the_arc_to_the_point_ahead() -> None:
    grid = FreeGrid(WORLDS["A"], distance=0.25)
    # Ahead by the look-ahead distance, on a circle of 1.5 m to the left.
    angle = 2.0 * math.asin(0.6 / 2.0 / 1.5)
    point = (1.5 * math.sin(angle), 1.5 * (1.0 - math.cos(angle)))
    pursuit = PurePursuit([point, point], TURTLEBOT, grid, look_ahead=0.61)
    left, right = TURTLEBOT.wheel_speeds(np.array(pursuit.act(0.0, 0.0, 0.0), np.float32))
    radius = 0.5 * TURTLEBOT.wheel_base * (right + left) / (right - left)
    # It is the nearest of the arcs that it looks at.
    assert 1.0 / radius == pytest.approx(1.0 / 1.5, abs=0.2)
    assert right == pytest.approx(TURTLEBOT.max_wheel_speed)


def test_pursuit_keeps_its_side_for_a_point_behind() -> None:
    grid = FreeGrid(WORLDS["A"], distance=0.25)
    for side in (1.0, -1.0):
        pursuit = PurePursuit([(0.0, 0.0), (-3.0, side * 1e-3)], TURTLEBOT, grid)
        # It overshoots the direction opposite to the point: it still turns to the same side.
        for heading in (0.0, -side * 0.3, side * 0.3, -side * 0.1):
            left, right = pursuit.act(0.0, 0.0, heading)
            assert (right > left) == (side > 0)
            # On the tightest arc one wheel is as slow and one as fast as it can be.
            assert sorted((left, right)) == pytest.approx([-1.0, 1.0])


def test_pursuit_turns_from_a_wall_that_its_arc_would_meet() -> None:
    wall = World(name="wall", boxes=(Box(-0.5, 0.25, 3.0, 0.5),))
    grid = FreeGrid(wall, distance=0.2, resolution=0.05)
    # The path leads into the wall on the left, which no planner would let it.
    pursuit = PurePursuit([(0.0, 0.0), (0.5, 0.4)], TURTLEBOT, grid)
    x, y, heading = 0.0, 0.0, 0.0
    with NavigationEnv(world=wall, physics="kinematic", contact=True) as env:
        env.reset(options={"start": (x, y, heading), "goal": (4.0, 0.0)})
        for _ in range(4):
            *_, info = env.step(np.array(pursuit.act(x, y, heading), np.float32))
            x, y, heading = info["x"], info["y"], info["heading"]
    assert not info["collision"] and info["min_clearance"] > 0.0


@pytest.mark.parametrize("name", ["dijkstra", "astar", "ant_colony"])
def test_the_followers_reach_the_goals_of_map_d(name: str) -> None:
    episodes = 5 if name == "ant_colony" else 20
    results = evaluate(make_planner(name), "D", episodes=episodes, seed=3)
    assert all(result.success for result in results)
    # Robots start in any direction: what they drive to turn is in it.
    assert np.mean([result.spl for result in results]) > 0.85
    assert all(result.plan_s > 0.0 and result.decision_s > 0.0 for result in results)


def test_pursuit_turns_on_the_spot_to_a_point_beside_the_robot() -> None:
    grid = FreeGrid(WORLDS["A"], distance=0.25)
    for side in (1.0, -1.0):
        pursuit = PurePursuit([(0.0, 0.0), (0.0, side * 3.0)], ROBOTS["kobuki"], grid)
        left, right = pursuit.act(0.0, 0.0, 0.0)
        assert left == -right and side * right > 0.0


def test_the_follower_reaches_goals_on_wheels() -> None:
    results = evaluate(make_planner("dijkstra"), "D", episodes=4, physics="wheels")
    assert sum(result.success for result in results) >= 3


def test_a_planner_keeps_less_where_nothing_keeps_its_clearance() -> None:
    # A gap of 0.46 m: room for the robot, 0.36 m across, and not for its clearance.
    gap = World(
        name="gap", size=(4.0, 4.0), boxes=(Box(-0.1, 0.23, 0.1, 2.0), Box(-0.1, -2.0, 0.1, -0.23))
    )
    path, grid = MapPlanner(shortest_path).plan(gap, (-1.0, 0.0), (1.0, 0.0))
    assert len(path) > 2
    assert grid.distance < 0.25
    # Where there is no path at all it tries its luck.
    straight, _ = MapPlanner(shortest_path).plan(DIVIDED, (-1.0, 0.0), (1.0, 0.0))
    assert straight == [(-1.0, 0.0), (1.0, 0.0)]


def test_an_action_takes_its_share_of_the_time_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.count()
    monkeypatch.setattr(
        "mpfa_envs.evaluation.runs.time", SimpleNamespace(process_time=ticks.__next__)
    )
    results = run_tasks(
        as_driver(lambda seen: np.ones((len(seen), 2))),
        world_tasks("A", episodes=4),
        envs_at_once=4,
        physics="kinematic",
        max_steps=1,
        action_repeat=1,
    )
    # A tick each for planning, and one for the action of all four.
    assert [(result.plan_s, result.decision_s) for result in results] == [(1.0, 0.25)] * 4


def test_a_driver_is_told_each_errand_and_what_its_robots_sense() -> None:
    begun: list[tuple[str, tuple[float, float, float], tuple[float, float]]] = []
    goals: dict[int, tuple[float, float]] = {}

    class Told:
        def begin(self, robot: int, errand: Errand) -> None:
            assert errand.world is not None and errand.map_shape is not None
            begun.append((errand.world.name, errand.start, errand.goal))
            goals[robot] = errand.goal

        def drive(self, senses: Senses) -> np.ndarray:
            count = len(senses.robots)
            size = senses.observations.shape[1]
            assert senses.states.shape == (count, 1, size) and senses.motions.shape == (count, 5)
            assert senses.goals.tolist() == [list(goals[robot]) for robot in senses.robots]
            assert senses.maps is not None and senses.maps.shapes.shape == (2, 2)
            np.testing.assert_array_equal(senses.poses, senses.motions[:, :3])
            return np.ones((count, 2), np.float32)

    tasks = world_tasks("A", episodes=3) + world_tasks("B", episodes=2)
    run_tasks(Told(), tasks, envs_at_once=2, physics="kinematic", memory="map", max_steps=10)
    assert sorted(begun) == sorted((each.world.name, *each.task) for each in tasks)
