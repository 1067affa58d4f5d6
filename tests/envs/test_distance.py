from __future__ import annotations

import heapq
import math

import numpy as np
import pytest

from mpfa_envs import WORLDS, Box, Cylinder, Polygon, World, generate_world
from mpfa_envs.paths.distance import DistanceField, FreeGrid, is_reachable
from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE, path_lengths
from mpfa_envs.paths.tasks import sample_task_on_grid
from mpfa_envs.tasks.sampling import sample_task

MIXED = World(
    name="mixed",
    size=(7.3, 5.1),
    boxes=(Box(-3.0, -2.0, -1.0, 0.5), Box(-2.0, -1.0, 0.0, 1.0)),
    cylinders=(Cylinder(1.5, 1.0, 0.7), Cylinder(2.0, 1.2, 0.5)),
    polygons=(
        Polygon(((0.5, -2.0), (2.5, -1.5), (1.2, -1.2), (2.0, -0.5), (0.8, -0.8))),
        Polygon(((2.0, -1.8), (3.0, -1.8), (2.4, -0.9))),
    ),
)
CUT = World(name="cut", boxes=(Box(-0.2, -5.0, 0.2, 5.0),))


def points_of(grid: FreeGrid) -> np.ndarray:
    across, up = np.meshgrid(grid.xs, grid.ys, indexing="ij")
    return np.stack((across.ravel(), up.ravel()), axis=1)


@pytest.mark.parametrize("resolution", [0.1, 0.07])
def test_clearances_of_the_cells_are_those_of_the_world(resolution: float) -> None:
    grid = FreeGrid(MIXED, distance=0.2, resolution=resolution)
    expected = MIXED.clearances(points_of(grid)).reshape(grid.free.shape)
    np.testing.assert_allclose(grid.clearance, expected, atol=1e-6)
    clear = np.abs(expected - 0.2) > 1e-6
    np.testing.assert_array_equal(grid.free[clear], (expected >= 0.2)[clear])
    assert grid.xs[-1] + resolution / 2 >= 3.65 > grid.xs[-1] - resolution / 2
    assert grid.center(*grid.index(1.23, -0.71)) == pytest.approx((1.23, -0.71), abs=resolution / 2)


def oracle(grid: FreeGrid, goal: tuple[int, int]) -> dict[tuple[int, int], float]:
    """Dijkstra's algorithm, cell by cell, from a cell."""
    found: dict[tuple[int, int], float] = {}
    queue = [(1e-12, goal)]

    def free(i: int, j: int) -> bool:
        return 0 <= i < grid.free.shape[0] and 0 <= j < grid.free.shape[1] and grid.free[i, j]

    while queue:
        length, (i, j) = heapq.heappop(queue)
        if (i, j) in found:
            continue
        found[i, j] = length
        for a in range(-2, 3):
            for b in range(-2, 3):
                if math.gcd(a, b) != 1 or not free(i + a, j + b):
                    continue
                if abs(a) == 2:
                    passed = [(a // 2, 0), (a // 2, b)]
                elif abs(b) == 2:
                    passed = [(0, b // 2), (a, b // 2)]
                else:
                    passed = []
                if all(free(i + c, j + d) for c, d in passed):
                    step = math.sqrt(a * a + b * b) * (grid.resolution * STEP_SCALE)
                    heapq.heappush(queue, (length + step, (i + a, j + b)))
    return found


@pytest.mark.parametrize("world", [MIXED, CUT, WORLDS["test"]], ids=lambda world: world.name)
def test_lengths_of_a_field_are_those_of_plain_dijkstra_to_the_bit(world: World) -> None:
    grid = FreeGrid(world, distance=0.2, resolution=0.15)
    cell = tuple(grid.cells[len(grid.cells) // 3].tolist())
    values = DistanceField(grid, grid.center(*cell)).lengths
    found = oracle(grid, cell)
    assert len(found) > 100
    for index in np.ndindex(values.shape):
        assert values[index] == found.get(index, math.inf)
    seeds, gaps = np.array([cell]), np.array([1e-12])
    step = grid.resolution * STEP_SCALE
    near = path_lengths(grid.free, seeds, gaps, MOVES, step, 3.0)
    np.testing.assert_array_equal(near, np.where(values <= 3.0, values, math.inf))


def test_a_field_up_to_a_position_has_the_lengths_that_a_path_from_there_needs() -> None:
    grid, goal = FreeGrid(MIXED, distance=0.2), (-0.5, 2.0)
    whole = DistanceField(grid, goal)
    for start in ((-3.4, -2.3), (3.2, 2.2), (0.0, 2.0)):
        part = DistanceField(grid, goal, until=start)
        known = np.isfinite(part.lengths)
        assert part.length_from(start) == whole.length_from(start)
        np.testing.assert_array_equal(part.lengths[known], whole.lengths[known])
        assert whole.lengths[~known].min() >= whole.at(*start)
        beyond = part.lengths[known].max() - part.lengths[grid.index(*start)]
        assert beyond <= 3.0 * STEP_SCALE * grid.resolution + 1e-9


def test_cells_that_touch_at_their_corners_are_joined() -> None:
    ends = [(-0.35, -0.35), (0.35, 0.35)]
    for cut in (False, True):
        grid = FreeGrid(World(name="small", size=(1.0, 1.0)), distance=0.1)
        grid.free[:] = np.eye(10, dtype=np.bool_)
        grid.free[5, 5] = not cut
        expected = math.inf if cut else STEP_SCALE * math.dist(*ends)
        assert grid.joins(*ends) != cut and grid.length(*ends) == pytest.approx(expected)


def test_positions_off_the_free_cells_are_joined_by_the_nearest() -> None:
    assert FreeGrid(WORLDS["B"], distance=0.25).joins((0.0, 0.0), (0.0, 3.75))
    cut = FreeGrid(CUT, distance=0.25)
    assert cut.joins((-0.15, 0.0), (-3.0, 0.0)) and not cut.joins((-0.15, 0.0), (0.15, 0.0))
    full = FreeGrid(World(name="closet", size=(0.3, 0.3)), distance=0.2)
    assert (
        not full.joins((0.0, 0.0), (0.0, 0.0)) and full.length((0.0, 0.0), (0.1, 0.0)) == math.inf
    )


def test_cells_without_a_path_take_the_nearest_length() -> None:
    grid = FreeGrid(MIXED, distance=0.2)
    field = DistanceField(grid, (-0.5, 2.0))
    known = np.argwhere(np.isfinite(field.lengths))
    for i, j in np.argwhere(np.isinf(field.lengths))[::7].tolist():
        gaps = np.hypot(*(known - (i, j)).T)
        # Of several that are nearly as near, it may take any.
        near = known[gaps < gaps.min() + 0.5]
        assert np.isclose(field.lengths[near[:, 0], near[:, 1]], field.filled[i, j]).any()
    finite = np.isfinite(field.lengths)
    np.testing.assert_allclose(field.filled[finite], field.lengths[finite], rtol=1e-6)


def test_positions_are_read_bilinearly() -> None:
    field = DistanceField(FreeGrid(MIXED, distance=0.2), (-0.5, 2.0))
    grid = field.grid
    assert field.at(*grid.center(30, 40)) == pytest.approx(field.filled[30, 40], abs=1e-6)
    x, y = grid.center(30, 40)
    square = field.filled[30:32, 40:42].tolist()
    expected = 0.7 * 0.6 * square[0][0] + 0.3 * 0.6 * square[1][0]
    expected += 0.7 * 0.4 * square[0][1] + 0.3 * 0.4 * square[1][1]
    assert field.at(x + 0.03, y + 0.04) == pytest.approx(expected, abs=1e-6)


def test_tasks_keep_regions_distances_and_clearances() -> None:
    world = World(
        name="sides",
        boxes=WORLDS["test"].boxes,
        start_regions=(Box(-4, -4, -1, 4),),
        goal_regions=(Box(1, -4, 4, 4), Box(-1, 3, 1, 4)),
    )
    rng = np.random.default_rng(0)
    grid = FreeGrid(world, distance=0.25)
    for _ in range(40):
        task, field = sample_task_on_grid(grid, rng, min_goal_distance=3.0, max_goal_distance=7.0)
        assert task.start[0] <= -0.95 and (task.goal[0] >= 0.95 or task.goal[1] >= 2.95)
        assert math.dist(task.start[:2], task.goal) >= 3.0
        assert field.at(*task.start[:2]) <= 7.05
        assert world.clearance(*task.start[:2]) >= 0.4 - 1e-6
        assert world.clearance(*task.goal) >= 0.4 - 1e-6
        assert is_reachable(world, 0.24, task.start[:2], task.goal)
        assert field.goal == task.goal


def test_tasks_are_detours_as_often_as_asked() -> None:
    rng = np.random.default_rng(0)
    grid = FreeGrid(generate_world("bars", 3, difficulty=0.7), distance=0.25)
    for chance, low, high in ((1.0, 1.0, 1.0), (0.5, 0.5, 0.95), (0.0, 0.1, 0.8)):
        around = []
        for _ in range(60):
            task, field = sample_task_on_grid(grid, rng, detour_chance=chance)
            direct = math.dist(task.start[:2], task.goal)
            around.append(field.at(*task.start[:2]) > 1.05 * direct)
        assert low <= np.mean(around) <= high
    open_room = FreeGrid(WORLDS["A"], distance=0.25)
    sample_task_on_grid(open_room, rng, detour_chance=1.0)


@pytest.mark.parametrize(("chance", "share"), [(1.0, 1.0), (0.0, 0.3)])
def test_tasks_of_any_distance_are_detours_as_often_as_asked(chance: float, share: float) -> None:
    rng, world = np.random.default_rng(0), generate_world("bars", 3, difficulty=0.7)
    tasks = [
        sample_task(world, rng, collision_distance=0.25, detour_chance=chance) for _ in range(30)
    ]
    blocked = [world.clearance_along(task.start[:2], task.goal) < 0.25 for task in tasks]
    assert np.mean(blocked) == pytest.approx(share, abs=0.15)


def test_a_task_lies_on_one_side_of_a_closed_wall() -> None:
    rng = np.random.default_rng(0)
    for chance in (0.0, 1.0):
        for _ in range(20):
            task, _ = sample_task_on_grid(CUT, rng, distance=0.25, detour_chance=chance)
            assert task.start[0] * task.goal[0] > 0.0
