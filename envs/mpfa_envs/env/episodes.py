"""The source of many robots' episodes, and the state of an environment: how they have gone."""

from __future__ import annotations

import copy
import hashlib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from mpfa_envs.checks import check_count, check_share, got, plain
from mpfa_envs.generators.generate import (
    GENERATORS,
    generate_world,
    resolve_world,
    world_of_name,
    world_seed,
)
from mpfa_envs.paths.distance import DistanceField, FreeGrid, grid_for, shortest_length
from mpfa_envs.paths.tasks import LONGEST_PATH, sample_task_on_grid
from mpfa_envs.safety.filter import CLEARANCE
from mpfa_envs.tasks.sampling import cell_share, check_task, sample_task, warn_of_parts
from mpfa_envs.walkers.batch import start_walkers
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.world import Task, World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.walkers.batch import WalkerStarts

WorldChoice: TypeAlias = "str | os.PathLike[str] | World"
"""A built-in world's name, the path of a world file, or a world."""
GENERATED_DIAGONAL: Final = 50.0
"""No world of a generator is longer than this from corner to corner [m]."""
_WORLDS: Final = 50
"""Worlds of a generator that are tried before an error is raised."""


class Episode(NamedTuple):
    """A task in its world, and the measure of its robot's progress."""

    world: World
    """The world."""
    task: Task
    """Start and goal."""
    shortest_path: float
    """The shortest path to the goal's center [m]."""
    field: DistanceField | None
    """Lengths of the paths to the goal, if the progress is along the shortest path."""
    walkers: WalkerStarts
    """Starts of the walkers."""


class EpisodeState(NamedTuple):
    """Where an episode came from: its random state and world, unless a reset gave them."""

    generator: Mapping[str, Any]
    """State of the robot's random generator."""
    left: int
    """Episodes that were left in the world before."""
    kept: World | None
    """That world, of a generator of worlds."""
    given: bool
    """The options of a reset gave the world or the task."""


def generator_at(state: Mapping[str, Any]) -> np.random.Generator:
    """Make a random generator of a state."""
    generator = np.random.default_rng(0)
    generator.bit_generator.state = state
    return generator


def distance_field(world: World, distance: float, goal: tuple[float, float]) -> DistanceField:
    """Measure the paths to a goal that keep a distance [m]; on a map only around the goal."""
    longest = math.inf if world.occupancy is None else LONGEST_PATH
    return DistanceField(grid_for(world, distance, cell_share(world)), goal, longest)


class EpisodeSource:
    """Samples the episodes of each robot: a task in its world, or in a new world."""

    def __init__(
        self,
        world: WorldChoice | Sequence[WorldChoice],
        robots: int,
        config: TaskConfig,
        *,
        split: Literal["train", "validation"] = "train",
        difficulty: float | None = None,
        episodes_per_world: int = 1,
        max_goal_distance: float = math.inf,
    ) -> None:
        self.rejected = 0
        """Worlds of the generator that had no task."""
        self._config = config
        least, most = config.min_goal_distance, plain(max_goal_distance)
        if isinstance(most, bool) or not isinstance(most, (int, float)) or not most > least:
            raise ValueError(
                f"max_goal_distance must be above min_goal_distance = {least}, got {most!r}"
            )
        self._max_goal_distance = float(most)
        self._episodes_per_world = check_count("episodes_per_world", episodes_per_world)
        if split not in ("train", "validation"):
            raise ValueError(f"split must be 'train' or 'validation', got {split!r}")
        self._split = split
        self._generator = _generator_of(world)
        if difficulty is not None:
            difficulty = check_share("difficulty", difficulty)
            if self._generator is None:
                raise ValueError(
                    "difficulty must be None unless world is the name of a generator, got "
                    f"{difficulty!r}"
                )
        self._difficulty = difficulty
        fixed = [] if self._generator else _resolve_worlds(world)
        kept = max(config.collision_distance - config.robot.radius, CLEARANCE)
        for place in dict.fromkeys(fixed):
            warn_of_parts(place, config.robot, kept)
        self._worlds = [fixed[i % len(fixed)] if fixed else None for i in range(robots)]
        self._left = [0] * robots
        self.begins: dict[int, EpisodeState] = {}
        """Where each robot's episode came from."""
        driven = fixed[:robots]
        self.diagonal = max((each.diagonal for each in driven), default=GENERATED_DIAGONAL)
        """Longest distance in the worlds [m]."""
        self._check_there_are_tasks(driven)

    def _check_there_are_tasks(self, worlds: Sequence[World]) -> None:
        """Sample an episode in each world, or in one of the generator, before anything runs."""
        rng = np.random.default_rng(0)
        for world in worlds or (None,):
            self._sample(world, rng)
        self.rejected = 0

    def sample(
        self,
        robots: Sequence[int],
        rngs: Sequence[np.random.Generator],  # of all robots
        given: Sequence[tuple[World, Task | None] | None] | None = None,  # of all, for once
        renewed: Iterable[int] = (),  # in a new world, as after a seed
    ) -> list[Episode]:
        """Sample the next episodes of some robots, or none if one of them has none."""
        sampled = copy.copy(self)
        sampled._left, sampled._worlds = list(self._left), list(self._worlds)
        for robot in renewed:
            sampled._left[robot] = 0
        begins = {
            robot: EpisodeState(
                rngs[robot].bit_generator.state,
                sampled._left[robot],
                sampled._worlds[robot] if self._generator else None,
                given is not None and given[robot] is not None,
            )
            for robot in robots
        }
        try:
            episodes = [
                sampled._sample_next(robot, rngs[robot], None if given is None else given[robot])
                for robot in robots
            ]
        except BaseException:
            for robot, begin in begins.items():
                rngs[robot].bit_generator.state = begin.generator
            raise
        self.rejected, self._left, self._worlds = sampled.rejected, sampled._left, sampled._worlds
        self.begins.update(begins)
        return episodes

    def sample_again(
        self, begins: Sequence[EpisodeState], *, rejected: int
    ) -> tuple[EpisodeSource, list[Episode], list[np.random.Generator]]:
        """Sample episodes from the beginnings of all robots, or of none, in a copy."""
        rngs = [generator_at(begin.generator) for begin in begins]
        source = copy.copy(self)
        source.begins = {}
        source._left = [begin.left for begin in begins] or [0] * len(self._left)
        if self._generator:
            source._worlds = [begin.kept for begin in begins] or [None] * len(self._left)
        episodes = source.sample(range(len(begins)), rngs)
        source.rejected = rejected
        return source, episodes, rngs

    def _sample_next(
        self, robot: int, rng: np.random.Generator, given: tuple[World, Task | None] | None
    ) -> Episode:
        """Sample the next episode of a robot."""
        if given is not None:
            return self._sample_in(given[0], rng, given[1])
        kept = self._worlds[robot] if self._generator is None or self._left[robot] else None
        episode = self._sample(kept, rng)
        if self._generator:
            new = episode.world is not kept
            self._left[robot] = (self._episodes_per_world if new else self._left[robot]) - 1
            self._worlds[robot] = episode.world
        return episode

    def fixed(self, robot: int) -> World | None:
        """The world that a robot always drives in; None with a generator."""
        return None if self._generator else self._worlds[robot]

    def describe(self) -> dict[str, Any]:
        """Plain values by name: the arguments that decide which episodes come."""
        world: str | list[str] | None = self._generator
        if world is None:
            names = {id(each): _fingerprint(each) for each in self._worlds if each is not None}
            world = [names[id(each)] for each in self._worlds]
            world = world[0] if len(names) == 1 else world
        return {
            "world": world,
            "max_goal_distance": self._max_goal_distance,
            "difficulty": self._difficulty,
            "episodes_per_world": self._episodes_per_world,
            "split": self._split,
        }

    def check_world(self, world: World) -> None:
        """Reject a world that is too large."""
        if world.diagonal > self.diagonal:
            raise ValueError(
                f"world {world.name!r} must be at most {self.diagonal:.4g} m from corner to "
                f"corner, as the observations are bounded, got {world.diagonal:.4g} m"
            )

    def world(self, robot: int, choice: WorldChoice | None) -> World:
        """Look up the world that a robot is to drive in; None is the one that it always has."""
        world = self.fixed(robot) if choice is None else resolve_world(choice)
        if world is None:
            raise ValueError("world must be given where the worlds are a generator's, got None")
        self.check_world(world)
        return world

    def check_task(self, world: World, start: Sequence[float], goal: Sequence[float]) -> Task:
        """Read a task in a world, and reject one that cannot be driven."""
        config = self._config
        return check_task(
            world,
            start,
            goal,
            collision_distance=config.collision_distance,
            goal_radius=config.goal_radius,
            radius=config.robot.radius,
        )

    def _sample(self, world: World | None, rng: np.random.Generator) -> Episode:
        """Sample an episode in a world, in a new one where it is None or has no task."""
        if self._generator is None and world is not None:
            return self._sample_in(world, rng)
        reason: ValueError | None = None
        for _ in range(_WORLDS):
            try:
                return self._sample_on_grid(world or self._new_world(rng), rng)
            except ValueError as error:
                self.rejected += 1
                world, reason = None, error
        raise ValueError(
            f"world = {self._generator!r} cannot be driven: {_WORLDS} of its worlds in a row have "
            f"no task; the last one: {reason}"
        ) from reason

    def _new_world(self, rng: np.random.Generator) -> World:
        """The next world of the generator."""
        seed = world_seed(self._split, int(rng.integers(10**9)))
        world = generate_world(str(self._generator), seed, difficulty=self._difficulty)
        self.check_world(world)
        return world

    def _sample_in(
        self, world: World, rng: np.random.Generator, task: Task | None = None
    ) -> Episode:
        """Sample an episode in a fixed world, with a task of its own or the given one."""
        if task is None and math.isfinite(self._max_goal_distance):
            return self._sample_on_grid(world, rng)
        config = self._config
        distance = config.collision_distance
        task = task or sample_task(
            world,
            rng,
            collision_distance=distance,
            min_goal_distance=config.min_goal_distance,
            detour_chance=config.detour_chance,
        )
        ends = task.start[:2], task.goal
        length = shortest_length(world, config.robot.radius, *ends, cell_share(world))
        along = config.progress == "shortest_path"
        field = distance_field(world, distance, task.goal) if along else None
        return Episode(world, task, length, field, start_walkers(world, task.start[:2], rng))

    def _sample_on_grid(self, world: World, rng: np.random.Generator) -> Episode:
        """Sample an episode over the cells of a grid, in milliseconds even in crowded worlds."""
        config = self._config
        distance = config.collision_distance
        # A generator's worlds do not come again.
        if self._generator:
            grid = FreeGrid(world, distance=distance)
        else:
            grid = grid_for(world, distance, cell_share(world))
        task, field = sample_task_on_grid(
            grid,
            rng,
            min_goal_distance=config.min_goal_distance,
            max_goal_distance=self._max_goal_distance,
            detour_chance=config.detour_chance,
        )
        length = field.at(*task.start[:2])
        kept = field if config.progress == "shortest_path" else None
        return Episode(world, task, length, kept, start_walkers(world, task.start[:2], rng))


def _generator_of(world: object) -> str | None:
    """The name of a generator, or None for fixed worlds."""
    if not isinstance(world, str):
        return None
    if world in GENERATORS:
        return world
    if world.isidentifier() and world not in WORLDS:
        known = [*GENERATORS, *WORLDS]
        raise ValueError(
            "world must be a World, the path of a .yaml file, a sequence of these, or one of "
            f"{known}, {got(world, known)}"
        )
    return None


def _resolve_worlds(world: WorldChoice | Sequence[WorldChoice]) -> list[World]:
    """Look up the fixed worlds."""
    if isinstance(world, Sequence) and not isinstance(world, str):
        if not world:
            raise ValueError("world must hold at least one world, got an empty sequence")
        return [resolve_world(each) for each in world]
    return [resolve_world(world)]


def _fingerprint(world: World) -> str:
    """Name and hash of a world, which differs even from worlds with its name."""
    cells = b"" if world.occupancy is None else world.occupancy.digest
    regions = [
        [tuple(map(float, region.bounds)) for region in some]
        for some in (world.start_regions, world.goal_regions)
    ]
    walkers = [
        (float(one.radius), float(one.speed), one.behavior, one.waypoints) for one in world.walkers
    ]
    # 1 and 1.0 are the same number, but not the same text.
    numbers = [part.tolist() for part in world.arrays], regions, walkers
    digest = hashlib.sha256(repr(numbers).encode() + cells)
    return f"{world.name} ({digest.hexdigest()[:8]})"


def robot_to_plain(begin: EpisodeState, speeds: NDArray[np.float64]) -> dict[str, Any]:
    """Turn the beginning of an episode, and the wheel speeds since, into plain values."""
    if begin.given:
        raise ValueError(
            "an episode cannot be saved whose world or task the options of a reset gave: save "
            "after the next reset() without them"
        )
    return {
        "generator": copy.deepcopy(begin.generator),
        "left": begin.left,
        "kept": begin.kept.name if begin.kept and begin.left else None,
        "speeds": speeds,
    }


def read_state(
    state: Any, arguments: Mapping[str, Any], config: TaskConfig, source: EpisodeSource
) -> tuple[list[EpisodeState], list[NDArray[np.float64]], list[np.random.Generator | None]]:
    """Check a state: beginnings, wheel speeds since, and generators of the next episodes."""
    try:
        for name, value in arguments.items():
            if (found := state["arguments"].get(name)) != value:
                raise ValueError(
                    f"it must be of an environment with {name} = {value!r}, got one with {found!r}"
                )
        robots, count = state["robots"], arguments["num_envs"]
        if len(robots) not in (0, count) or len(state["seeded"]) != count:
            raise ValueError(f"robots and seeded must have {count} entries, got {len(robots)}")
        if np.shape(np.array(state["positions"], dtype=np.float64)) != (count, 2):
            raise ValueError(f"positions must have shape ({count}, 2)")
        check_count("rejected", state["rejected"], least=0, most=math.inf)
        driven = [_read_speeds(robot["speeds"], config) for robot in robots]
        seeded = [None if seed is None else generator_at(seed) for seed in state["seeded"]]
        return _read_states(robots, source), driven, seeded
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        reason = error if isinstance(error, ValueError) else f"no state_dict() gave it, {error!r}"
        raise ValueError(f"state cannot be loaded: {reason}") from error


def _read_states(robots: list[dict[str, Any]], source: EpisodeSource) -> list[EpisodeState]:
    """Check where the episodes of a state began."""
    begins = []
    for robot in robots:
        left = check_count("left", robot["left"], least=0)
        kept = world_of_name(str(robot["kept"])) if left else None
        if left and kept is None:
            raise ValueError(f"kept must name a generator's world, got {robot['kept']!r}")
        if kept is not None:
            source.check_world(kept)
        begin = generator_at(robot["generator"]).bit_generator.state
        begins.append(EpisodeState(begin, left, kept, given=False))
    return begins


def _read_speeds(values: Any, config: TaskConfig) -> NDArray[np.float64]:
    """Check the wheel speeds of a robot's actions [m/s], ``[A, 2]``."""
    speeds = np.array(values, dtype=np.float64).reshape(len(values), 2)
    low, high = min(config.robot.wheel_limits.slow, 0.0), config.robot.wheel_limits.fast
    most = math.ceil(config.max_steps / config.action_repeat)
    # NaN is not above anything.
    inside = (speeds > low - 1e-9) & (speeds < high + 1e-9)
    if not inside.all() or len(speeds) > most:
        raise ValueError(
            f"speeds must be at most {most} pairs from {low} to {high} m/s, got {len(speeds)}, "
            f"others of which are {speeds[~inside].tolist()}"
        )
    return speeds
