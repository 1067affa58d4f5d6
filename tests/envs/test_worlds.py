from __future__ import annotations

import math
import pickle

import numpy as np
import pytest

from mpfa_envs import WORLDS, Box, Cylinder, NavigationEnv, Polygon, Walker, World
from mpfa_envs.paths.distance import is_reachable
from mpfa_envs.tasks.sampling import evaluation_pairs, sample_task
from tests.envs.paper import drive_to_end, full_speed
from tests.envs.process import run
from tests.envs.shapes import distance


def test_the_training_maps_are_those_of_the_public_course() -> None:
    assert [len(WORLDS[name].boxes) for name in "ABCD"] == [0, 4, 4, 6]
    assert WORLDS["C"].boxes[0] == Box(-1.5, 1.5, 1.5, 2.0)
    assert all(world.size == (10.0, 10.0) for world in WORLDS.values())


def test_the_test_world_is_denser_than_the_densest_of_training() -> None:
    dense, test = WORLDS["D"], WORLDS["test"]
    assert len(test.boxes) > len(dense.boxes) and test.covered_area > dense.covered_area
    assert not set(test.boxes) & {box for name in "ABCD" for box in WORLDS[name].boxes}
    assert not set(test.boxes) & set(WORLDS["validation"].boxes)


@pytest.mark.parametrize("name", ["validation", "test"])
def test_most_unseen_tasks_need_a_detour_and_all_can_be_solved(name: str) -> None:
    pairs = evaluation_pairs(name, 200, seed=0)
    world = WORLDS[name]
    assert all(is_reachable(world, 0.35, pair.start[:2], pair.goal) for pair in pairs)
    blocked = [world.clearance_along(pair.start[:2], pair.goal) < 0.18 for pair in pairs]
    assert sum(blocked) > 120


@pytest.mark.parametrize("name", WORLDS)
def test_starts_and_goals_keep_their_margins(name: str) -> None:
    world, rng = WORLDS[name], np.random.default_rng(0)
    headings = []
    for _ in range(60):
        start, goal = sample_task(world, rng, collision_distance=0.35)
        assert world.clearance(*start[:2]) >= 0.5
        assert world.clearance(*goal) >= 0.5
        assert math.dist(start[:2], goal) >= 2.0
        headings.append(start[2])
    assert min(headings) < -2.5 and max(headings) > 2.5


@pytest.mark.parametrize("name", ["B", "C", "D"])
def test_a_detour_has_an_obstacle_on_its_line(name: str) -> None:
    world, rng = WORLDS[name], np.random.default_rng(0)
    for chance, low, high in ((1.0, 1.0, 1.0), (0.5, 0.6, 0.95), (0.0, 0.3, 0.8)):
        sampled = [
            sample_task(world, rng, collision_distance=0.25, detour_chance=chance)
            for _ in range(80)
        ]
        least = [world.clearance_along(start[:2], goal) for start, goal in sampled]
        assert low <= sum(each < 0.25 for each in least) / len(least) <= high
        # A line that comes near an obstacle without crossing it takes a detour as well.
        assert any(0.0 < each < 0.25 for each in least)


def test_a_world_without_detours_has_tasks_all_the_same() -> None:
    corner = World(name="corner", boxes=(Box(4.9, 4.9, 5.0, 5.0),))
    for world in (WORLDS["A"], corner):
        sample_task(world, np.random.default_rng(0), collision_distance=0.25, detour_chance=1.0)


def test_a_longer_list_of_evaluation_pairs_starts_the_same() -> None:
    assert evaluation_pairs("test", 5, seed=1) == evaluation_pairs("test", 8, seed=1)[:5]
    assert evaluation_pairs("test", 5, seed=1) != evaluation_pairs("test", 5, seed=2)
    for n in (0, True, 1.5):
        with pytest.raises(ValueError, match="n must be a positive integer, got"):
            evaluation_pairs("test", n, seed=0)


def test_a_fixed_task_is_driven_as_it_was_given() -> None:
    env = NavigationEnv(world="test", physics="kinematic")
    for pair in evaluation_pairs("test", 5, seed=3):
        _, info = env.reset(options=pair._asdict())
        assert (info["x"], info["y"], info["heading"]) == pytest.approx(pair.start)
        assert env.task == pair


def test_regions_hold_the_starts_and_the_goals() -> None:
    left, right = Box(-4, -4, -2, 4), Box(2, -4, 4, 4)
    world = World(name="sides", start_regions=(left,), goal_regions=(right,))
    rng = np.random.default_rng(0)
    for _ in range(20):
        start, goal = sample_task(world, rng, collision_distance=0.35)
        assert start[0] <= -2 and goal[0] >= 2


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World(name="closet", size=(0.7, 0.7)), "'closet' has no free start"),
        (World(name="small", size=(2.2, 2.2)), "'small' has no start and goal"),
        (
            World(
                name="cut",
                boxes=(Box(-0.1, -5, 0.1, 5),),
                start_regions=(Box(-4, -4, -2, 4),),
                goal_regions=(Box(2, -4, 4, 4),),
            ),
            "'cut' has no start and goal",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:1 of 2 parts of 'cut'")
def test_a_world_without_a_task_raises_an_error(world: World, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NavigationEnv(world=world, physics="kinematic")


def test_equal_worlds_are_one_key_a_renamed_one_another() -> None:
    one, same = (World(name="x", boxes=(Box(0, 0, 1, 1),)) for _ in range(2))
    assert one == same and hash(one) == hash(same) and {one: 1}[same] == 1
    other = one.renamed("y")
    assert other.name == "y" and one.name == "x" and other != one
    assert other.boxes == one.boxes and {one: 1}.get(other) is None
    assert hash(World(name="x")) != hash(one)


@pytest.mark.filterwarnings("ignore:1 of 2 parts of 'gap'")
def test_a_task_with_a_too_narrow_path_is_rejected() -> None:
    gap = World(name="gap", boxes=(Box(-0.1, -5.0, 0.1, -0.2), Box(-0.1, 0.2, 0.1, 5.0)))
    task = {"start": (-2.0, 0.0, 0.0), "goal": (2.0, 0.0)}
    with (
        NavigationEnv(world=gap, physics="kinematic") as env,
        pytest.raises(ValueError, match=r"goal must be .* collision_distance = 0.25 m .*\(2.0, 0"),
    ):
        env.reset(options=task)
    with NavigationEnv(world=gap, physics="kinematic", contact=True) as env:
        env.reset(options=task)


def test_a_goal_beside_a_wall_can_be_reached() -> None:
    with NavigationEnv(physics="kinematic", clearance=0.17) as env:
        assert drive_to_end(env, full_speed, goal=(4.8, 0.0))[-1]["success"]


def test_a_world_of_lists_equals_one_of_tuples() -> None:
    parts = {
        "size": (8.0, 9.0),
        "boxes": (Box(0, 0, 1, 1),),
        "start_regions": (Box(-3, -3, -2, -2),),
        "walkers": (Walker(),),
    }
    world = World(name="x", **parts)
    listed = World(name="x", **{name: list(values) for name, values in parts.items()})
    assert listed == world and hash(listed) == hash(world)
    with NavigationEnv(world=listed, physics="kinematic") as env:
        env.reset(seed=0)


def test_equal_worlds_have_one_hash_across_processes() -> None:
    code = (
        "import pickle\n"
        "from mpfa_envs import Walker, World\n"
        "world = World(name='x', walkers=(Walker(),))\n"
        "hash(world)\n"
        "print(pickle.dumps(world).hex())"
    )
    # Of the seeds one at least is not this process's own.
    for seed in "12":
        world = pickle.loads(bytes.fromhex(run(code, PYTHONHASHSEED=seed)))
        assert {World(name="x", walkers=(Walker(),)): 1}.get(world) == 1


def test_clearances_of_many_points_are_those_of_plain_geometry() -> None:
    world = World(
        name="both",
        size=(10.0, 6.0),
        boxes=(Box(-4.0, -2.0, -1.0, 2.0), Box(-2.0, -1.0, 0.0, 1.0)),
        cylinders=(Cylinder(2.0, 0.0, 1.0),),
        polygons=(Polygon(((0.5, -2.5), (4.0, -2.0), (2.0, -1.5), (4.0, 2.5), (0.5, 1.0))),),
    )
    points = np.random.default_rng(0).uniform(-6.0, 6.0, (500, 2))
    found = world.clearances(points)
    expected = [distance(x, y, world) for x, y in points.tolist()]
    # In a box the one says 0, the other how deep.
    np.testing.assert_allclose(np.where(np.array(expected) == 0.0, 0.0, found), expected)
    assert world.clearances(np.array([[-3.0, 0.5]])) == pytest.approx(-1.0)
    assert world.clearances(np.empty((0, 2))).shape == (0,)
