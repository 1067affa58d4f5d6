from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest

from mpfa_envs import Box, NavigationEnv, World, evaluation_pairs, random_world
from mpfa_envs.path import planner_for

SEEDS = range(20)


def gap(one: Box, other: Box) -> float:
    across = max(one.x_min - other.x_max, other.x_min - one.x_max, 0.0)
    up = max(one.y_min - other.y_max, other.y_min - one.y_max, 0.0)
    return math.hypot(across, up)


def wall_gaps(world: World, box: Box) -> list[float]:
    room = world.room
    return [
        box.x_min - room.x_min,
        room.x_max - box.x_max,
        box.y_min - room.y_min,
        room.y_max - box.y_max,
    ]


@pytest.mark.parametrize("passage", [0.6, 0.9])
def test_between_any_two_things_in_a_random_room_there_is_a_passage_or_none_at_all(
    passage: float,
) -> None:
    for seed in SEEDS:
        world = random_world(seed, passage=passage)
        assert all(gap(a, b) >= passage for a, b in combinations(world.boxes, 2))
        for box in world.boxes:
            assert all(way == 0.0 or way >= passage for way in wall_gaps(world, box))


def test_boxes_of_random_rooms_are_as_thick_and_long_as_they_say() -> None:
    for seed in SEEDS:
        for box in random_world(seed).boxes:
            sides = sorted((box.x_max - box.x_min, box.y_max - box.y_min))
            assert 0.5 in (pytest.approx(sides[0]), pytest.approx(sides[1]))
            assert sides[0] >= 0.5 - 1e-9 and sides[1] <= 2.6 + 1e-9


def test_each_side_of_random_rooms_has_boxes_that_make_dead_ends() -> None:
    touching = [0, 0, 0, 0]
    for seed in SEEDS:
        world = random_world(seed)
        for box in world.boxes:
            touching = [
                n + (g == 0.0) for n, g in zip(touching, wall_gaps(world, box), strict=True)
            ]
    # Six of 13 boxes touch a wall: 20 rooms have some 30 at each.
    assert min(touching) > 15


@pytest.mark.parametrize(
    ("seed", "place", "edges"),
    [(7, 0, (4.5, 2.733799, 5.0, 3.380495)), (100, -1, (2.476928, 4.5, 3.871075, 5.0))],
)
def test_a_seed_is_one_room_for_ever(
    seed: int, place: int, edges: tuple[float, float, float, float]
) -> None:
    # Results refer to rooms by their seed. The last box depends on all that were sampled before.
    box = random_world(seed).boxes[place]
    assert (box.x_min, box.y_min, box.x_max, box.y_max) == pytest.approx(edges, abs=2e-6)


def test_another_seed_is_another_room() -> None:
    assert len({random_world(seed).boxes for seed in SEEDS}) == len(SEEDS)


def test_only_the_room_that_a_name_stands_for_has_that_name() -> None:
    assert random_world(7).name == random_world(7, boxes=13, passage=0.9).name == "random-7"
    assert random_world(7, boxes=6, passage=1.5).name == "random-7, 6 boxes, 1.5 m"
    assert random_world(7, passage=0.8).name != "random-7"


def test_every_free_place_of_a_random_room_can_be_reached() -> None:
    rng = np.random.default_rng(0)
    straight = 0
    for seed in range(5):
        world = random_world(seed)
        planner = planner_for(world, 0.4)
        places = [(x, y) for x, y in rng.uniform(-5, 5, (200, 2)) if world.clearance(x, y) > 0.41]
        start, *goals = places[:21]
        assert all(planner.is_reachable(start, goal) for goal in goals)
        straight += sum(planner.is_straight(start, goal) for goal in goals)
    assert straight < 50  # of 100: most of the ways have a bend.


def test_a_random_room_is_asked_for_by_its_name() -> None:
    env = NavigationEnv(world="random-12", physics="kinematic")
    assert env.world == random_world(12)
    env.close()


@pytest.mark.parametrize("name", ["random", "random-", "random--1", "random-1.5", "random-a"])
def test_a_name_that_is_no_random_room_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"world must be .*'NAME-SEED'.* got 'random"):
        evaluation_pairs(name, 1, seed=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed must be an integer of at least 0, got -1"),
        ({"seed": True}, "seed must be an integer of at least 0, got True"),
        ({"seed": 1, "boxes": 0}, "boxes must be a positive integer, got 0"),
        ({"seed": 1, "passage": 0.0}, "passage must be between 0 and 10.0 m, got 0.0"),
        ({"seed": 1, "passage": math.nan}, "passage must be between 0 and 10.0 m, got nan"),
        ({"seed": 1, "boxes": 9, "passage": 4.0}, "boxes = 9 with passage = 4.0 m between them do"),
    ],
)
def test_a_room_that_cannot_be_is_refused(arguments: dict[str, float], message: str) -> None:
    random_world(seed=1)  # A seed of True is refused even after one of 1, which equals it.
    with pytest.raises(ValueError, match=message):
        random_world(**arguments)
