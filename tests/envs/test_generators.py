from __future__ import annotations

import hashlib
import math
import random
from collections import Counter

import numpy as np
import pytest

from benchmarks.speed.worlds import measure
from mpfa_envs import (
    GENERATORS,
    Cylinder,
    NavigationEnv,
    VectorNavigationEnv,
    World,
    evaluate,
    generate_world,
    register_generator,
)
from mpfa_envs.generators.generate import generator_tasks, resolve_world, split_worlds, world_seed
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.tasks import sample_task_on_grid

NAMES = list(GENERATORS)
PINNED = {
    "rooms": ("3e882fba5b92", "792ac77905ff"),
    "clutter": ("7d517f39f07f", "05f1476961fb"),
    "bars": ("95bee62eb266", "78103f2b46ff"),
    "fields": ("050b0f4a3b85", "2ffc4e86d6b2"),
    "halls": ("937971d5560e", "c893ea64c501"),
    "mazes": ("382b054aa625", "4624390959b7"),
    "mixed": ("8b6268b6671e", "9467986caa96"),
    "crowd": ("08e7dcdb63cd", "de2e7de11388"),
}
"""World 7 for training, and world 7 of the test at full difficulty."""


def fingerprint(world: World) -> str:
    """All numbers of a world; what a printer may change with the version is left out."""
    text = repr([part.tolist() for part in world.arrays])
    if world.walkers:
        text += repr(
            [[w.radius, w.speed, w.behavior, list(map(list, w.waypoints))] for w in world.walkers]
        )
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@pytest.mark.parametrize("name", NAMES)
def test_a_task_is_found_in_each_of_many_worlds(name: str) -> None:
    rng = np.random.default_rng(0)
    for split in ("train", "validation", "test"):
        for index in range(6):
            world = generate_world(name, world_seed(split, 100 + index))
            grid = FreeGrid(world, distance=0.25)
            task, field = sample_task_on_grid(grid, rng, detour_chance=0.8)
            assert math.dist(task.start[:2], task.goal) >= 2.0
            # A path over free cells, and 0.07 m to spare for a robot of 0.18 m.
            assert math.isfinite(field.lengths[grid.index(*task.start[:2])]), world.name
            assert min(world.clearance(*task.start[:2]), world.clearance(*task.goal)) > 0.2499


@pytest.mark.parametrize(("name", "expected"), PINNED.items())
def test_the_world_of_a_seed_never_changes(name: str, expected: tuple[str, str]) -> None:
    # Results refer to worlds by their names.
    found = generate_world(name, 7), generate_world(name, world_seed("test", 7), difficulty=1.0)
    assert tuple(fingerprint(world) for world in found) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rooms", (-0.7066, 3.2507, -1.4663, 3.8691, -0.4614)),
        ("fields", (1.2038, -2.0168, 2.3047, -0.9531, -2.3814)),
        ("halls", (2.45, 4.8494, 2.2954, 2.6136, -6.0002)),
        ("mazes", (3.0771, 2.84, -0.3046, 3.9075, -3.9064)),
    ],
)
def test_the_tasks_of_a_generator_never_change(name: str, expected: tuple[float, ...]) -> None:
    pairs = generator_tasks(name, "test", worlds=2, tasks=2)
    assert pairs[:2] == generator_tasks(name, "test", worlds=1, tasks=2)
    start, goal = pairs[1][1]
    assert (*start, *goal) == pytest.approx(expected, abs=1e-4)


def test_splits_share_no_seed_and_no_world() -> None:
    seeds = [world_seed(split, i) for split in ("train", "validation", "test") for i in (0, 999)]
    assert seeds == [0, 999, 10**9, 10**9 + 999, 2 * 10**9, 2 * 10**9 + 999]
    for name in NAMES:
        worlds = [w for s in ("train", "validation", "test") for w in split_worlds(name, s, 5)]
        assert len({fingerprint(world) for world in worlds}) == 15
        assert worlds[-1].name == f"{name}-test-4"


@pytest.mark.parametrize(
    ("name", "ending"),
    [
        *(
            ("bars", ending)
            for ending in ("7", "validation-7", "test-7", "7@0.25", "test-3@1", "0@0")
        ),
        ("mazes", "7@0.0000001"),
        ("mazes", "7@0.3333333333333333"),
    ],
)
def test_a_generated_world_is_found_by_its_name(name: str, ending: str) -> None:
    world = resolve_world(f"{name}-{ending}")
    assert world.name == f"{name}-{ending}"
    assert resolve_world(world.name) == world


def pillars(source: random.Random, difficulty: float) -> World:
    """A room with one pillar, the wider the more difficult."""
    pillar = Cylinder(source.uniform(-4, 4), source.uniform(-4, 4), 0.1 + difficulty)
    return World(name="pillars", cylinders=(pillar,))


# A harder crowd has more walkers.
@pytest.mark.parametrize("name", [name for name in NAMES if name != "crowd"])
def test_difficulty_means_more_obstacles(name: str) -> None:
    def free_share(difficulty: float) -> float:
        grids = [
            FreeGrid(generate_world(name, seed, difficulty=difficulty), distance=0.25)
            for seed in range(12)
        ]
        return sum(grid.free.mean() for grid in grids) / 12

    shares = [free_share(difficulty) for difficulty in (0.0, 0.5, 1.0)]
    assert shares[0] > shares[1] > shares[2]
    assert shares[2] > 0.1


def test_a_world_without_a_task_is_sampled_again_but_not_forever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = []

    def closets(rng: object, difficulty: float) -> World:
        made.append(difficulty)
        return World(name="closet", size=(1.0, 1.0) if len(made) < 4 else (5.0, 5.0))

    monkeypatch.setattr("mpfa_envs.generators.generate.GENERATORS", {"closets": closets})
    assert generate_world("closets", 3).size == (5.0, 5.0)
    assert len(made) == 4
    made[:] = [0.0] * -1000
    monkeypatch.setattr(
        "mpfa_envs.generators.generate.GENERATORS",
        {"closets": lambda rng, difficulty: World(name="closet", size=(1.0, 1.0))},
    )
    with pytest.raises(ValueError, match="'closets-3' cannot be made: none of 100 attempts"):
        generate_world("closets", 3)


def test_a_crowd_has_two_to_ten_walkers_six_by_default() -> None:
    numbers = {
        at: {len(generate_world("crowd", seed, difficulty=at).walkers) for seed in range(8)}
        for at in (0.0, 0.5, 1.0, None)
    }
    assert numbers == {0.0: {2}, 0.5: {6}, 1.0: {10}, None: {6}}
    walkers = [walker for seed in range(20) for walker in generate_world("crowd", seed).walkers]
    behaviors = Counter(walker.behavior for walker in walkers)
    assert set(behaviors) == {"straight", "waypoints"} and min(behaviors.values()) > 50
    assert all(0.1 <= walker.speed <= 0.3 and 0.2 <= walker.radius <= 0.3 for walker in walkers)


def test_the_benchmark_measures_a_new_world_and_its_field() -> None:
    entries = {found["name"]: found for found in measure(quick=True, names=["rooms"])}
    assert set(entries) == {"world_and_field", "world_rooms", "field_rooms"}
    values = {name: found["value"] for name, found in entries.items()}
    assert values["world_and_field"] == values["world_rooms"] + values["field_rooms"]
    # A training run makes thousands. Far above what is measured: the machine may be busy.
    assert values["world_and_field"] < 60.0


def test_a_registered_generator_works_like_a_built_in_one() -> None:
    register_generator("pillars", pillars)
    worlds = split_worlds("pillars", "validation", 2)
    assert [world.name for world in worlds] == ["pillars-validation-0", "pillars-validation-1"]
    assert worlds[0].cylinders != worlds[1].cylinders
    assert generate_world("pillars", 3, difficulty=1.0).cylinders[0].radius == 1.1
    env = NavigationEnv(world="pillars-7", physics="kinematic")
    assert env.world == generate_world("pillars", 7)
    robots = VectorNavigationEnv(3, world="pillars", physics="kinematic")
    robots.reset(seed=0)
    first = [world.name for world in robots.worlds]
    robots.reset()
    names = {*first, *(world.name for world in robots.worlds)}
    assert len(names) == 6
    assert all(name.startswith("pillars-") for name in names)
    ahead = evaluate(lambda _: np.ones(2), "pillars:test", episodes=2, physics="kinematic")
    assert [result.world for result in ahead] == ["pillars-test-0", "pillars-test-0"]


def test_rooms_beyond_the_bounds_of_observations_are_rejected() -> None:
    register_generator("long", lambda source, difficulty: World(name="long", size=(60.0, 3.0)))
    with pytest.raises(ValueError, match=r"world 'long-.*' must be at most 50 m .* got 60\.07 m"):
        VectorNavigationEnv(1, world="long", physics="kinematic")


def test_the_error_names_a_generator_that_returns_no_world() -> None:
    register_generator("nothing", lambda source, difficulty: None)
    with pytest.raises(TypeError, match="generator 'nothing' must give a World, got NoneType"):
        generate_world("nothing", 0)
