from __future__ import annotations

import hashlib
import subprocess
import sys

import pytest

from mpfa_envs import (
    GENERATORS,
    FreeGrid,
    PathPlanner,
    World,
    generate_world,
    generator_tasks,
    random_world,
    split_worlds,
    world_seed,
)
from mpfa_envs.builtin_worlds import resolve_world
from mpfa_envs.distance import has_task

NAMES = list(GENERATORS)


def fingerprint(world: World) -> str:
    """All numbers of a world; what a printer may change with the version is left out."""
    text = repr([part.tolist() for part in world.arrays])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@pytest.mark.parametrize("name", NAMES)
def test_every_seed_has_a_task(name: str) -> None:
    for seed in range(60):
        world = generate_world(name, seed)
        assert has_task(FreeGrid(world, distance=0.25)), world.name


@pytest.mark.parametrize("name", NAMES)
def test_the_planner_finds_the_way_of_each_task(name: str) -> None:
    pairs = generator_tasks(name, "validation", worlds=3, tasks=2)
    assert len(pairs) == 6 and len({world.name for world, _ in pairs}) == 3
    for world, task in pairs:
        planner = PathPlanner(world, radius=0.24)
        assert planner.is_reachable(task.start[:2], task.goal), world.name


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_is_one_world_and_another_seed_another(name: str) -> None:
    worlds = [generate_world(name, seed) for seed in range(20)]
    assert worlds == [generate_world(name, seed) for seed in range(20)]
    assert len({fingerprint(world) for world in worlds}) == 20
    assert [world.name for world in worlds] == [f"{name}-{seed}" for seed in range(20)]


def test_rooms_are_what_random_worlds_were() -> None:
    for seed in (0, 7, 100, 12345):
        assert generate_world("rooms", seed).boxes == random_world(seed).boxes


def test_a_seed_is_the_same_world_in_another_process() -> None:
    code = (
        "from mpfa_envs import generate_world\n"
        "for name in ('clutter', 'bars'):\n"
        "    print([part.tolist() for part in generate_world(name, 5).arrays])"
    )
    expected = "".join(
        f"{[part.tolist() for part in generate_world(name, 5).arrays]}\n"
        for name in ("clutter", "bars")
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert out == expected


def test_splits_share_no_seed_and_no_world() -> None:
    seeds = [world_seed(split, i) for split in ("train", "validation", "test") for i in (0, 999)]
    assert seeds == [0, 999, 10**9, 10**9 + 999, 2 * 10**9, 2 * 10**9 + 999]
    for name in NAMES:
        worlds = [w for s in ("train", "validation", "test") for w in split_worlds(name, s, 5)]
        assert len({fingerprint(world) for world in worlds}) == 15
        assert worlds[-1].name == f"{name}-test-4"


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("ending", ["7", "validation-7", "test-7", "7@0.25", "test-3@1", "0@0"])
def test_a_world_can_be_asked_for_by_its_name(name: str, ending: str) -> None:
    world = resolve_world(f"{name}-{ending}")
    assert world.name == f"{name}-{ending}"
    assert resolve_world(world.name) == world


@pytest.mark.parametrize(
    "name",
    ["bars", "bars-", "bars--1", "bars-1.5", "bars-a", "bars-train-1", "bars-1@2", "barz-1", "-1"],
)
def test_a_name_that_is_no_world_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"world must be .*'NAME-SEED'.* got '"):
        resolve_world(name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bers", 1), r"generator must be one of \['rooms',.*got 'bers' \(did you mean 'bars'\?\)"),
        (("bars", -1), "seed must be an integer of at least 0, got -1"),
        (("bars", True), "seed must be an integer of at least 0, got True"),
        (("bars", 3 * 10**9), "seed must be below 3000000000, got 3000000000"),
    ],
)
def test_a_world_that_cannot_be_is_refused(arguments: tuple[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generate_world(*arguments)


def test_an_impossible_difficulty_is_refused() -> None:
    for difficulty in (-0.1, 1.1, "hard", float("nan")):
        with pytest.raises(ValueError, match="difficulty must be"):
            generate_world("bars", 1, difficulty=difficulty)


def test_splits_and_counts_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="split must be one of"):
        world_seed("tests", 1)
    with pytest.raises(ValueError, match="index must be below 1000000000"):
        world_seed("test", 10**9)
    with pytest.raises(ValueError, match="count must be a positive integer, got 0"):
        split_worlds("bars", "test", 0)
    with pytest.raises(ValueError, match="tasks must be a positive integer, got 0"):
        generator_tasks("bars", "test", worlds=1, tasks=0)


@pytest.mark.parametrize("name", NAMES)
def test_difficulty_means_more_obstacles_in_the_way(name: str) -> None:
    def free_share(difficulty: float) -> float:
        grids = [
            FreeGrid(generate_world(name, seed, difficulty=difficulty), distance=0.25)
            for seed in range(20)
        ]
        return sum(grid.free.mean() for grid in grids) / 20

    shares = [free_share(difficulty) for difficulty in (0.0, 0.5, 1.0)]
    assert shares[0] > shares[1] > shares[2]
    assert shares[2] > 0.1


def test_a_world_that_cannot_be_driven_is_drawn_anew_and_not_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = []

    def closets(rng: object, difficulty: float) -> World:
        made.append(difficulty)
        return World(name="closet", size=(1.0, 1.0) if len(made) < 4 else (5.0, 5.0))

    monkeypatch.setattr("mpfa_envs.generators.GENERATORS", {"closets": closets})
    assert generate_world("closets", 3).size == (5.0, 5.0)
    assert len(made) == 4
    made[:] = [0.0] * -1000
    monkeypatch.setattr(
        "mpfa_envs.generators.GENERATORS",
        {"closets": lambda rng, difficulty: World(name="closet", size=(1.0, 1.0))},
    )
    with pytest.raises(ValueError, match="'closets-3' cannot be made: none of 100 attempts"):
        generate_world("closets", 3)
