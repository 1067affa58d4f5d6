from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

import mpfa_envs
from mpfa_envs import WORLDS, Box, NavigationEnv, Polygon, World, world_tasks
from mpfa_envs.paths.distance import is_reachable, shortest_length
from mpfa_envs.tasks.sampling import evaluation_pairs

BLOCK = World(name="block", boxes=(Box(-1.0, -2.0, 1.0, 2.0),))


def turned(box: Box, turn: float) -> Polygon:
    """A box turned around the origin."""
    x0, y0, x1, y1 = box.bounds
    cosine, sine = math.cos(turn), math.sin(turn)
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    return Polygon(tuple((cosine * x - sine * y, sine * x + cosine * y) for x, y in corners))


def around_a_corner(radius: float) -> float:
    """Length from (-3, 0) to (3, 0) around the block: tangents, two arcs and a straight [m]."""
    reach = math.hypot(2.0, 2.0)
    tangent = math.sqrt(reach**2 - radius**2)
    # The tangent leaves at this angle from the x axis and the arc turns it into the x axis.
    turn = math.atan2(2.0, 2.0) + math.asin(radius / reach)
    return 2 * tangent + 2 * radius * turn + 2.0


@pytest.mark.parametrize(("world", "seed"), [("test", 0), ("validation", 1)])
def test_lengths_of_published_tasks_are_those_of_the_file(world: str, seed: int) -> None:
    file = Path(mpfa_envs.__file__).parent / "assets" / "tasks" / "lengths.csv"
    rows = [row for row in csv.reader(file.read_text().splitlines()) if row[0] == world]
    tasks = [each.task for each in world_tasks(world, seed=seed)]
    assert [[*task.start[:2], *task.goal] for task in tasks] == [
        [float(number) for number in row[1:5]] for row in rows
    ]
    lengths = [float(row[5]) for row in rows]
    assert [
        shortest_length(WORLDS[world], 0.18, task.start[:2], task.goal) for task in tasks
    ] == lengths
    # The field of another disc, of a world without fixed lengths, is near to them.
    renamed = WORLDS[world].renamed("other")
    measured = [shortest_length(renamed, 0.18, task.start[:2], task.goal) for task in tasks]
    np.testing.assert_allclose(measured, lengths, rtol=0.045)
    assert measured != lengths
    empty = World(name=world)
    assert shortest_length(empty, 0.18, tasks[0].start[:2], tasks[0].goal) < lengths[0]
    assert shortest_length(WORLDS[world], 0.2, tasks[0].start[:2], tasks[0].goal) != lengths[0]


def test_a_published_task_has_its_fixed_length_in_an_episode() -> None:
    env = NavigationEnv(world="test", physics="kinematic")
    task = evaluation_pairs("test", 1, seed=0)[0]
    _, info = env.reset(options=task._asdict())
    assert info["shortest_path"] == 9.133817045730046 - env.config.goal_radius


@pytest.mark.parametrize("radius", [0.05, 0.18, 0.35])
@pytest.mark.parametrize("turn", [None, 0.4, 1.0, 2.5])
def test_the_path_around_a_box_is_near_the_optimum(turn: float | None, radius: float) -> None:
    world, angle = BLOCK, turn or 0.0
    if turn is not None:
        world = World(name="turned", polygons=(turned(BLOCK.boxes[0], turn),))
    ends = [(3 * s * math.cos(angle), 3 * s * math.sin(angle)) for s in (-1, 1)]
    length = shortest_length(world, radius, *ends)
    assert length == pytest.approx(around_a_corner(radius), rel=0.03)


def test_a_passage_narrower_than_a_cell_is_found_on_shorter_cells() -> None:
    gap = World(name="gap", boxes=(Box(-0.1, -5.0, 0.1, -0.2), Box(-0.1, 0.2, 0.1, 5.0)))
    ends = (-2.0, 1.0), (2.0, -1.0)
    assert 4.4 < shortest_length(gap, 0.18, *ends) < 4.9 and is_reachable(gap, 0.18, *ends)
    assert shortest_length(gap, 0.21, *ends) == math.inf and not is_reachable(gap, 0.21, *ends)


@pytest.mark.parametrize("ends", [((-1.1, 0.0), (3.0, 0.0)), ((3.0, 0.0), (0.0, 0.0))])
def test_there_is_no_path_from_or_to_within_a_margin(ends: tuple[tuple[float, float], ...]) -> None:
    assert shortest_length(BLOCK, 0.18, *ends) == math.inf
    assert not is_reachable(BLOCK, 0.18, *ends)


def test_a_gap_between_corners_that_touch_is_a_path_only_where_a_disc_fits() -> None:
    # Free cells that touch at a corner are joined: a move leads from one to the other.
    for gap, fits in ((0.3, False), (0.5, True)):
        boxes = Box(-5.0, -5.0, -gap / 2, 0.0), Box(gap / 2, 0.0, 5.0, 5.0)
        world = World(name="corners", boxes=boxes)
        ends = (-3.0, 3.0), (3.0, -3.0)
        assert is_reachable(world, 0.18, *ends) == fits
        assert math.isfinite(shortest_length(world, 0.18, *ends)) == fits


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
