from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest

from mpfa_envs import WORLDS, Box, Cylinder, NavigationEnv, Polygon, World
from mpfa_envs.generators.resolve import resolve_world
from mpfa_envs.paths.planner import PathPlanner, is_small, shortest_length
from mpfa_envs.tasks.sampling import evaluation_pairs
from mpfa_envs.worlds.barn import barn_task, barn_world

BLOCK = World(name="block", boxes=(Box(-1.0, -2.0, 1.0, 2.0),))


def around_a_corner(radius: float) -> float:
    """Length from (-3, 0) to (3, 0) around the block: tangents, two arcs and a straight [m]."""
    reach = math.hypot(2.0, 2.0)
    tangent = math.sqrt(reach**2 - radius**2)
    # The tangent leaves at this angle from the x axis and the arc turns it into the x axis.
    turn = math.atan2(2.0, 2.0) + math.asin(radius / reach)
    return 2 * tangent + 2 * radius * turn + 2.0


def test_a_free_line_is_the_path_with_exact_length() -> None:
    planner = PathPlanner(WORLDS["A"], radius=0.18)
    assert planner.find((0.0, 0.0), (3.0, 4.0)) == [(0.0, 0.0), (3.0, 4.0)]
    assert planner.length((0.0, 0.0), (3.0, 4.0)) == 5.0


def test_the_path_around_a_cylinder_is_optimal_within_a_percent() -> None:
    world = World(name="pillar", cylinders=(Cylinder(0.0, 0.0, 1.0),))
    reach = 1.18
    optimum = 2 * math.sqrt(9 - reach**2) + reach * (math.pi - 2 * math.acos(reach / 3))
    length = PathPlanner(world, radius=0.18).length((-3.0, 0.0), (3.0, 0.0))
    assert optimum - 1e-9 <= length <= 1.01 * optimum


@pytest.mark.parametrize(
    ("name", "radius"),
    [
        ("D", 0.35),
        ("validation", 0.35),
        ("test", 0.35),
        ("halls-3@0.8", 0.25),
        ("halls-8@0.8", 0.25),
    ],
)
def test_no_point_of_a_path_comes_nearer_than_the_margin(name: str, radius: float) -> None:
    world = resolve_world(name)
    planner = PathPlanner(world, radius=radius)
    rng = np.random.default_rng(1)
    bends = 0
    while bends < 8:
        start, goal = (rng.uniform(-0.47, 0.47, (2, 2)) * world.size).tolist()
        path = planner.find(start, goal)
        assert (path is not None) == planner.is_reachable(start, goal)
        bends += path is not None and len(path) > 2
        for ends in itertools.pairwise(path or ()):
            assert world.clearances(np.linspace(*ends, 40)).min() >= radius - 1e-6


def test_a_narrow_passage_is_open_to_a_thin_robot_only() -> None:
    world = World(name="door", boxes=(Box(-0.2, -5.0, 0.2, -0.3), Box(-0.2, 0.3, 0.2, 5.0)))
    ends = (-2.0, 1.0), (2.0, -1.0)
    assert PathPlanner(world, radius=0.18).length(*ends) < 5.0
    assert PathPlanner(world, radius=0.35).length(*ends) == math.inf
    assert PathPlanner(world, radius=0.35).find(*ends) is None
    assert not PathPlanner(world, radius=0.35).is_reachable(*ends)


def test_there_is_no_path_from_within_a_margin() -> None:
    assert PathPlanner(BLOCK, radius=0.18).find((-1.1, 0.0), (3.0, 0.0)) is None


def as_polygon(box: Box, turn: float = 0.0) -> Polygon:
    """A box turned around the origin."""
    x0, y0, x1, y1 = box.bounds
    cosine, sine = math.cos(turn), math.sin(turn)
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return Polygon(tuple((cosine * x - sine * y, sine * x + cosine * y) for x, y in corners))


def test_a_rectangular_polygon_is_passed_like_a_box() -> None:
    world = World(name="same", polygons=tuple(as_polygon(box) for box in WORLDS["test"].boxes))
    boxes = PathPlanner(WORLDS["test"], radius=0.3)
    polygons = PathPlanner(world, radius=0.3)
    rng = np.random.default_rng(2)
    for start, goal in rng.uniform(-4.6, 4.6, (40, 2, 2)).tolist():
        assert polygons.length(start, goal) == pytest.approx(boxes.length(start, goal), rel=1e-6)
        assert polygons.is_reachable(start, goal) == boxes.is_reachable(start, goal)


@pytest.mark.parametrize("radius", [0.05, 0.18, 0.35])
@pytest.mark.parametrize("turn", [None, 0.4, 1.0, 2.5])
def test_the_path_around_any_box_is_optimal_within_a_percent(
    turn: float | None, radius: float
) -> None:
    world, angle = BLOCK, turn or 0.0
    if turn is not None:
        world = World(name="turned", polygons=(as_polygon(BLOCK.boxes[0], turn),))
    ends = [(3 * s * math.cos(angle), 3 * s * math.sin(angle)) for s in (-1, 1)]
    optimum = around_a_corner(radius)
    assert optimum - 1e-9 <= PathPlanner(world, radius=radius).length(*ends) <= 1.01 * optimum


@pytest.mark.parametrize("name", ["halls-4", "bars-test-2", "mazes-3@0.4"])
def test_a_grid_measures_what_the_planner_finds(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    world = resolve_world(name)
    tasks = [evaluation_pairs(world, 4, seed=seed)[3] for seed in range(3)]
    ends = [(task.start[:2], task.goal) for task in tasks]
    exact = [shortest_length(world, 0.18, *pair) for pair in ends]
    assert exact == [PathPlanner(world, radius=0.18).length(*pair) for pair in ends]
    monkeypatch.setattr("mpfa_envs.paths.planner.is_small", lambda world: False)
    on_grid = [shortest_length(world, 0.18, *pair) for pair in ends]
    assert on_grid == pytest.approx(exact, rel=0.025)
    assert on_grid != exact


def test_paths_among_hundreds_of_cylinders_take_no_minutes() -> None:
    world, task = barn_world(9), barn_task()
    assert not is_small(world) and len(world.cylinders) > 250
    start = time.process_time()
    length = shortest_length(world, 0.18, task.start[:2], task.goal)
    assert 10.0 < length < 14.0
    assert shortest_length(world, 0.18, task.start[:2], (0.0, 7.4)) == math.inf
    assert shortest_length(world, 0.18, (4.9, 0.0), task.goal) == math.inf
    env = NavigationEnv(world=world, physics="kinematic")
    for seed in range(5):
        assert env.reset(seed=seed)[1]["shortest_path"] > 5.0
    assert time.process_time() - start < 10.0
    with pytest.raises(ValueError, match="goal must be within reach of the start"):
        env.reset(options={"start": task.start, "goal": (0.0, 7.45)})


def test_a_closed_ring_of_cylinders_leaves_no_path() -> None:
    angles = np.linspace(0.0, math.tau, 80, endpoint=False)
    ring = tuple(Cylinder(2 * math.cos(a), 2 * math.sin(a), 0.08) for a in angles)
    world = World(name="ring", cylinders=ring)
    assert shortest_length(world, 0.18, (0.0, 0.0), (3.0, 3.0)) == math.inf
    around = shortest_length(world, 0.18, (-3.0, 0.0), (3.0, 0.0))
    assert around == pytest.approx(2 * math.sqrt(9 - 2.26**2) + 2.26 * 1.706, rel=0.02)


@pytest.mark.parametrize(
    ("size", "pillars"),
    [((60.0, 60.0), 0), ((60.0, 60.0), 60), ((21.0, 5.0), 8), ((500.0, 400.0), 30)],
)
def test_tasks_of_a_wide_room_can_be_driven_in_an_episode(
    size: tuple[float, float], pillars: int
) -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.4, 0.4, (pillars, 2)) * size
    pillar = tuple(Cylinder(x, y, 0.2) for x, y in places.tolist())
    world = World(name="hall", size=size, cylinders=pillar)
    tasks = evaluation_pairs(world, 40, seed=0)
    lengths = [shortest_length(world, 0.18, task.start[:2], task.goal) for task in tasks]
    assert min(lengths) >= 2.0 and max(lengths) <= 20.0
    assert np.median(lengths) > 5.0


def test_goals_in_regions_far_from_most_starts_are_found() -> None:
    corner = Box(25.0, 25.0, 29.0, 29.0)
    world = World(name="hall", size=(60.0, 60.0), goal_regions=(corner,))
    for task in evaluation_pairs(world, 10, seed=0):
        assert corner.x_min <= task.goal[0] <= corner.x_max
        assert math.dist(task.start[:2], task.goal) <= 20.0


def test_tasks_are_sampled_in_a_narrow_corridor() -> None:
    world = World(name="corridor", size=(8.0, 0.9))
    env = NavigationEnv(world=world, physics="kinematic")
    for seed in range(3):
        _, info = env.reset(seed=seed)
        assert env.task is not None and world.clearance(*env.task.goal) < 0.5
        assert info["min_clearance"] > 0.07
