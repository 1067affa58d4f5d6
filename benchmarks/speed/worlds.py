"""Measure the cost of a new world, and picture the worlds.

python -m benchmarks.speed.worlds                         # a table of the generators
python -m benchmarks.speed.worlds --pictures docs/images  # twelve worlds of each, from easy to hard
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.timing import Call, Entry, entry, take_turns
from mpfa_envs import GENERATORS, NavigationEnv, World, generate_world
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.tasks import sample_task_on_grid
from mpfa_envs.render import render_trajectories, tiled
from mpfa_envs.worlds.barn import barn_world

DISTANCE = 0.25
"""Distance of paths from obstacles: a TurtleBot2's radius and 0.07 m [m]."""
WORLDS = 60
"""Worlds of a generator that are measured in turn."""
_MILLISECONDS = 1e3
_FIELD = 5.0
"""Length of a BARN world's field, with half a meter of the corridor before it [m]."""


def _new_world(name: str) -> Call:
    """A call that makes the next world."""
    seeds = count()
    return lambda: generate_world(name, next(seeds) % WORLDS)


def _new_task(name: str) -> Call:
    """A call that makes grid, goal, field and start in the next world."""
    worlds = [generate_world(name, seed) for seed in range(WORLDS)]
    turns, rng = count(), np.random.default_rng(0)

    def sample() -> object:
        grid = FreeGrid(worlds[next(turns) % WORLDS], distance=DISTANCE)
        return sample_task_on_grid(grid, rng, detour_chance=0.8)[1].filled

    return sample


def measure(*, quick: bool, names: Sequence[str] = ("mixed",)) -> list[Entry]:
    """Measure a new world and its field; ``world_and_field`` is the sum for the first generator."""
    calls: dict[str, Call] = {}
    for name in names:
        calls |= {f"world_{name}": _new_world(name), f"field_{name}": _new_task(name)}
    timings = take_turns(calls, rounds=3 if quick else 9, seconds=0.1 if quick else 0.5)
    medians = {name: timing.median * _MILLISECONDS for name, timing in timings.items()}
    total = medians[f"world_{names[0]}"] + medians[f"field_{names[0]}"]
    return [
        entry("world_and_field", total, "ms"),
        *(entry(name, median, "ms") for name, median in medians.items()),
    ]


def describe(name: str, milliseconds: dict[str, float]) -> dict[str, Any]:
    """Return figures of a generator, with its times [ms], by the heading of their column."""
    worlds = [generate_world(name, seed) for seed in range(WORLDS)]
    obstacles = [world.obstacle_count for world in worlds]
    sides = [side for world in worlds for side in world.size]
    free = [FreeGrid(world, distance=DISTANCE).free.mean() for world in worlds]
    return {
        "generator": f"`{name}`",
        "sides [m]": f"{min(sides):.0f} to {max(sides):.0f}",
        "obstacles": f"{min(obstacles)} to {max(obstacles)}",
        "free": f"{statistics.mean(free):.0%}",
        "world [ms]": f"{milliseconds[f'world_{name}']:.1f}",
        "task and field [ms]": f"{milliseconds[f'field_{name}']:.1f}",
    }


def render_all(
    worlds: Sequence[World], *, side: int = 224, columns: int = 3
) -> np.ndarray[Any, Any]:
    """Render worlds row by row, each with this longer side [px], walkers at their starts."""
    tiles = []
    for world in worlds:
        env = NavigationEnv(world=world, physics="kinematic")
        env.reset(seed=0)
        tiles.append(
            render_trajectories(world, [], [], [], title=world.name, walkers=env.walkers, size=side)
        )
    return tiled(tiles, columns=columns)


def course_of(world: World) -> World:
    """A world of BARN, cut to the field across its corridor, which is empty before it."""
    centers = np.array([(each.x, each.y) for each in world.cylinders])
    low, high = centers.min(axis=0), centers.max(axis=0)
    low[1] = high[1] - _FIELD
    x, y = (low + high) / 2
    width, depth = high - low + 0.4
    inside = [each for each in world.cylinders if each.y >= low[1]]
    moved = tuple(replace(each, x=each.x - x, y=each.y - y) for each in inside)
    return World(name=world.name, size=(width, depth), cylinders=moved)


def save_pictures(folder: Path, names: Sequence[str] = ()) -> None:
    """Write ``generator-NAME.png`` for each generator, by default all, and ``barn.png``."""
    from PIL import Image

    for name in names or GENERATORS:
        steps = [round(step / 11, 2) for step in range(12)]
        worlds = [generate_world(name, seed, difficulty=step) for seed, step in enumerate(steps)]
        Image.fromarray(render_all(worlds)).quantize(64).save(folder / f"generator-{name}.png")
    if names:
        return
    worlds = [course_of(barn_world(index)) for index in range(8, 20)]
    Image.fromarray(render_all(worlds, columns=4)).quantize(64).save(folder / "barn.png")


def main() -> None:
    """Print the table, or write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=Path, help="render the worlds into this folder instead")
    parser.add_argument("--names", nargs="+", choices=GENERATORS, default=[], help="only these")
    arguments = parser.parse_args()
    if arguments.pictures:
        save_pictures(arguments.pictures, arguments.names)
        return
    milliseconds = {
        found["name"]: found["value"] for found in measure(quick=False, names=list(GENERATORS))
    }
    for number, name in enumerate(GENERATORS):
        row = describe(name, milliseconds)
        if number == 0:
            print("| " + " | ".join(row) + " |\n|---" + "|---" * (len(row) - 1) + "|")
        print("| " + " | ".join(row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
