"""Worlds, paths, planners, generators, evaluation and pictures: calls that are rejected."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    WORLDS,
    Box,
    Cylinder,
    Polygon,
    Walker,
    World,
    evaluate,
    generate_world,
    make_planner,
    register_generator,
    run_tasks,
    summarize,
    world_tasks,
)
from mpfa_envs.generators.generate import generator_tasks, resolve_world, split_worlds, world_seed
from mpfa_envs.paths.distance import DistanceField, FreeGrid
from mpfa_envs.paths.tasks import sample_task_on_grid
from mpfa_envs.planners import AntColony, DynamicWindow
from mpfa_envs.render import (
    Panel,
    plot_histograms,
    plot_seeds,
    render_methods,
    render_samples,
    render_traces,
    render_trajectories,
    render_values,
    tiled,
    write_animation,
)
from mpfa_envs.worlds.barn import barn_world

Rows = list[tuple[Callable[[], object], str]]


def around(count: int, turn: float = 1.0) -> tuple[tuple[float, float], ...]:
    """Corners on a circle, each turned from the one before [rad]."""
    return tuple((math.cos(i * turn), math.sin(i * turn)) for i in range(count))


def ahead(observation: np.ndarray) -> np.ndarray:
    return np.ones((*observation.shape[:-1], 2))


def evaluated(policy: Any = ahead, **arguments: Any) -> object:
    return evaluate(policy, **{"world": "A", "physics": "kinematic", **arguments})


def pillars(source: object, difficulty: float) -> World:
    return World(name="pillars")


OF_NO_WORLD = ("bars", "bars-", "bars--1", "bars-1.5", "bars-a", "bars-train-1", "bars-1@2")
CLOSET = World(name="closet", size=(0.3, 0.3))
GRID = partial(FreeGrid, WORLDS["A"])
SAMPLE = partial(sample_task_on_grid, rng=np.random.default_rng(0))
IN_A = partial(SAMPLE, WORLDS["A"], distance=0.3)
BLACK = np.zeros((40, 40, 3), np.uint8)
FIELD = partial(render_values, "A", goal=(3.0, 3.0), spacing=2.0)
PLACES = np.zeros((2, 2))
EDGES = np.geomspace(1e-2, 1e2, 5)

SHAPES: Rows = [
    (lambda: Box(1, 0, 1, 2), "box must have x_min < x_max"),
    (lambda: Box(0, 0, math.nan, 2), "box must have finite edges"),
    (lambda: Cylinder(0, 0, 0), "cylinder must have a positive radius"),
    (lambda: World(name="x", size=(0, 1)), r"size must be two positive lengths, got \(0, 1\)"),
    (lambda: World(name="x", boxes=(Box(4, 0, 6, 1),)), "boxes must lie in the room"),
    (lambda: World(name="x", cylinders=(Cylinder(5, 0, 1),)), "cylinders must lie in the room"),
    (lambda: World(name="x", goal_regions=(Box(4, 0, 6, 1),)), "goal_regions must lie in"),
    (lambda: Cylinder(None, 0, 1), "cylinder must have finite numbers, got .*None"),
    (lambda: Polygon(3), "polygon must have a list of vertices, got 3"),
    (lambda: Polygon(((0, 0), (1, 1))), "3 to 100 vertices, got 2"),
    (lambda: Polygon(around(101)), "3 to 100 vertices, got 101"),
    (lambda: Polygon(((0, 0), (1, 1), (1, math.inf))), "two finite numbers a vertex"),
    (lambda: Polygon(((0, 0), (1, 1), (2, 2))), "must have an area"),
    (lambda: Polygon(((0, 0), (1, 1), (1, 0), (0, 1))), "does not cross"),
    (
        lambda: Polygon(((0, 0), (2, 0), (2, 2), (1, 2), (1, -1), (0, 1))),
        "does not cross or touch itself",
    ),
    (lambda: Polygon(((0, 0), (2, 0), (2, 2), (1, 0), (0, 2))), "does not cross or touch"),
    (lambda: Polygon(((0, 0), (2, 0), (1, 0), (1, 2))), "does not cross or touch itself"),
    # A pentagram turns left at each of its points, twice around.
    (lambda: Polygon(around(5, 2.513)), "does not cross"),
    (
        lambda: World(name="x", polygons=(Polygon(((4, 0), (5.1, 0), (4, 1))),)),
        "polygons must lie in the room",
    ),
    (lambda: World(name=None), "name must be text, got None"),
    (lambda: World(name="x", size=8), "size must be two positive lengths, got 8"),
    (lambda: World(name="x", boxes=Box(0, 0, 1, 1)), "boxes must be a tuple of Box, got Box"),
    (lambda: World(name="x", cylinders=(Box(0, 0, 1, 1),)), "cylinders must be a tuple of Cyl"),
    (lambda: World(name="x", walkers=Walker()), "walkers must be a tuple of Walker, got"),
    (lambda: World(name="x", occupancy=3), "occupancy must be an OccupancyGrid, got 3"),
]
PATHS: Rows = [
    (partial(GRID, distance=0.0), "distance must be positive"),
    (partial(GRID, distance=0.25, resolution=-0.1), "resolution must be positive"),
    (partial(GRID, distance=0.05, resolution=0.1), "at most the distance, 0.05 m, got 0.1"),
    (partial(GRID, distance=0.25, resolution=0.0001), "at most 40000000 cells"),
    (
        lambda: DistanceField(FreeGrid(CLOSET, distance=0.2), (0.0, 0.0)),
        "grid must have a free cell, and 'closet' has none",
    ),
    (partial(SAMPLE, WORLDS["A"]), "distance must be given for a world, got None"),
    (
        lambda: SAMPLE(FreeGrid(WORLDS["A"], distance=0.3), distance=0.2),
        "distance must be None for a",
    ),
    (partial(IN_A, min_goal_distance=0), "min_goal_distance must be pos"),
    (partial(IN_A, max_goal_distance=1.0), "max_goal_distance must be a"),
    (partial(IN_A, detour_chance=2), r"detour_chance must be in \[0, 1\]"),
    (partial(IN_A, min_goal_distance=30), "'A' has no start and goal"),
    (partial(SAMPLE, CLOSET, distance=0.3), "'closet' has no start and"),
]
DRIVERS: Rows = [
    (
        partial(make_planner, "djikstra"),
        "name must be one of .*got 'djikstra' .did you mean 'dijkstra'",
    ),
    (partial(make_planner, "astar", memory="map"), "memory must be 'none' for astar.*'map'"),
    (partial(make_planner, "dwa", robot="burgr"), "robot must be .*did you mean 'burger'"),
    (partial(AntColony, ants=0), "ants must be a positive integer, got 0"),
    (partial(AntColony, evaporation=1.5), r"evaporation must be in \[0, 1\], got 1\.5"),
    (partial(AntColony, seed=-1), "seed must be an integer of at least 0, got -1"),
    (partial(AntColony, time_limit=0.0), r"time_limit must be positive, got 0\.0"),
    (partial(DynamicWindow, memory="x"), "memory must be one of .*got 'x'"),
    (partial(DynamicWindow, samples=1), "samples must be an integer of at least 2, got 1"),
    (partial(DynamicWindow, length=0.0), r"length must be positive, got 0\.0"),
    (partial(DynamicWindow, acceleration=-1.0), r"acceleration must be positive, got -1\.0"),
    (partial(DynamicWindow(), np.zeros(27)), r"shape \[..., 24\], got \(27,\)"),
    (partial(DynamicWindow(), np.full(24, np.nan)), "observation must be finite"),
]
MADE: Rows = [
    *(
        (partial(resolve_world, name), r"world must be .*'NAME-SEED'.* got '")
        for name in (*OF_NO_WORLD, "barz-1", "-1")
    ),
    (
        partial(generate_world, "bers", 1),
        r"generator must be one of \['rooms',.*got 'bers' \(did you mean 'bars'\?\)",
    ),
    (partial(generate_world, "bars", -1), "seed must be an integer of at least 0, got -1"),
    (partial(generate_world, "bars", 3 * 10**9), "seed must be at most 2999999999, got 300"),
    *(
        (partial(generate_world, "bars", 1, difficulty=each), "difficulty must be")
        for each in (-0.1, 1.1, "hard", math.nan)
    ),
    (partial(world_seed, "tests", 1), "split must be one of"),
    (partial(world_seed, "test", 10**9), "index must be at most 999999999, got 1000000000"),
    (partial(split_worlds, "bars", "test", 0), "count must be a positive integer, got 0"),
    (
        partial(generator_tasks, "bars", "test", worlds=1, tasks=0),
        "tasks must be a positive integer, got 0",
    ),
    *(
        (partial(register_generator, name, pillars), f"not be that of a built-in .*'{name}'")
        for name in ("rooms", "crowd", "validation", "barn")
    ),
    *(
        (partial(register_generator, name, pillars), f"lower-case letters a to z, got {name!r}")
        for name in ("", "Pillars", "two words", "pillars-7", "pillars2")
    ),
    *((partial(barn_world, index), "index must be") for index in (-1, 20, True, 1.5)),
    *(
        (partial(resolve_world, f"barn-{index}"), "'barn-0' to 'barn-19'")
        for index in (-1, 20, True, 1.5)
    ),
    (partial(register_generator, "pillars", None), "generator must be callable, got None"),
]
DRIVEN: Rows = [
    *(
        (partial(world_tasks, name), f"world must be .*got '{name}'")
        for name in ("bars", "bars:train", "bras:test")
    ),
    (partial(evaluated, episodes=0), "episodes must be a positive integer, got 0"),
    (
        partial(evaluated, envs_at_once=1.5),
        "envs_at_once must be a positive integer, got 1.5",
    ),
    (partial(world_tasks, "maze:test"), "NAME:test .*got 'maze:test' .did you mean 'mazes'"),
    (partial(evaluated, world=["A", "tets"]), "world must be .*did you mean 'test'"),
    (partial(evaluated, physics="magic"), "physics must be one of .*got 'magic'"),
    # A policy of one observation is asked for two.
    (
        partial(evaluated, lambda _: np.zeros(2), episodes=2, envs_at_once=2),
        r"shape \(2, 2\) for observations of shape \(2, 24\)",
    ),
    *(
        (
            partial(evaluated, lambda _, action=action: action, episodes=1),
            r"policy must give an action of shape \(2,\) .*got array",
        )
        for action in (np.ones(1), np.ones((1, 2)), np.float64(1.0))
    ),
    *(
        (
            partial(run_tasks, ahead, world_tasks("A", episodes=1), **{name: value}),
            f"{name} must be left to the tasks",
        )
        for name, value in (("world", "B"), ("num_envs", 3), ("autoreset_mode", "next_step"))
    ),
    (partial(summarize, []), "results must hold at least one episode"),
]
PICTURES: Rows = [
    (
        partial(render_trajectories, "A", [], [(0, 0)], []),
        "must have one entry per episode, got 0, 1 and 0",
    ),
    (
        partial(render_trajectories, "A", [[(0, 0)]], [(0, 0)], ["lost"]),
        "outcomes must be among .*got 'lost'",
    ),
    (
        partial(render_trajectories, "A", [], [], [], size=3),
        "size must be an integer of at least 32, got 3",
    ),
    (partial(render_trajectories, "A", [], [], [], most=0), "most must be .*got 0"),
    (
        partial(render_methods, "A", {"one": [[]]}, [(1, 1)], {"two": ["success"]}),
        r"same methods, got .'one'. and .'two'.",
    ),
    (partial(tiled, []), "pictures must not be empty"),
    (partial(write_animation, [], "b.gif"), "frames must not be empty"),
    (partial(FIELD, values=lambda _: np.zeros(3)), "values must give a finite number for each"),
    (
        partial(FIELD, values=lambda seen: np.full(len(seen), np.nan)),
        "values must give a finite number",
    ),
    (partial(FIELD, actions=lambda _: np.zeros((2, 2))), "actions must have shape"),
    (partial(FIELD, values=len, spacing=0.0), "spacing must be"),
    (partial(FIELD, values=len, heading="north"), "heading must be"),
    (partial(render_samples, "A", np.zeros((0, 2)), [], []), "positions must have shape"),
    (partial(render_samples, "A", PLACES, [1.0], [1, 1]), "priorities must have shape"),
    (partial(render_samples, "A", PLACES, [1.0, 1.0], [2]), "sampled must be numbers below 2"),
    (partial(render_samples, "A", PLACES, [1.0, 1.0], [0.5]), "sampled must be 2 counts or"),
    (
        partial(render_traces, [Panel("Q", {"": []})], 0, step_time=0.2),
        "equally long and not empty",
    ),
    (partial(plot_seeds, {}, "b.png"), "runs must hold a curve"),
    (partial(plot_seeds, {"one": [([0, 1], [0.0])]}, "b.png"), "must be equally many"),
    (partial(plot_seeds, {"one": [([0, 0], [0.0, 1.0])]}, "b.png"), "steps of a run must rise"),
    (
        partial(plot_seeds, {"one": [([0], [0.0])]}, "b.png", band="range"),
        "band must be 'interval' or 'runs', got 'range'",
    ),
    (
        partial(plot_histograms, {"priority": ([0, 1], EDGES, np.zeros((20, 4)))}, "b.png"),
        r"counts of 'priority' must have shape \(2, 4\)",
    ),
    (partial(plot_histograms, {}, "b.png"), "histories must not be empty"),
]


@pytest.mark.parametrize(
    ("call", "message"), [*SHAPES, *PATHS, *DRIVERS, *MADE, *DRIVEN, *PICTURES]
)
def test_a_rejected_call_names_the_argument_and_writes_nothing(
    call: Callable[[], object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        call()
    assert not list(tmp_path.iterdir())
