"""The navigation task for many robots at once, each in a world of its own."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mpfa_envs.arguments import Physics, Progress, TaskArguments
from mpfa_envs.checks import check_count
from mpfa_envs.episodes import EpisodeSource, WorldChoice
from mpfa_envs.field_batch import FieldBatch
from mpfa_envs.kernels.lidar import cast_rays
from mpfa_envs.kernels.observation import observe_all
from mpfa_envs.kernels.step import (
    DISTANCE,
    MIN_CLEARANCE,
    POSE,
    REWARD,
    SHORTEST_PATH,
    EpisodeArrays,
    judge,
    measure_ways,
    pay,
    stop,
)
from mpfa_envs.observation import INFO_TYPES
from mpfa_envs.reward import PROGRESS_SCALE, RewardFunction, StepOutcome, navigation_reward
from mpfa_envs.robot import RobotModel
from mpfa_envs.tasks import Task, check_task
from mpfa_envs.vector_drives import Drives, make_drives
from mpfa_envs.vector_options import read_mask, read_tasks
from mpfa_envs.world_batch import WorldBatch
from mpfa_envs.worlds import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

FLAGS = tuple(name for name, kind in INFO_TYPES.items() if kind is bool)
"""Flags of the info dictionary, in the order of the tables."""
NUMBERS = tuple(name for name, kind in INFO_TYPES.items() if kind is float)
"""Its numbers, likewise."""
_MASKS = tuple(f"_{name}" for name in INFO_TYPES)
_EMPTY = World(name="empty")


class VectorNavigationEnv(
    TaskArguments, VectorEnv["NDArray[np.float32]", "NDArray[np.float32]", "NDArray[Any]"]
):
    """Many robots drive to goals by lidar, each in a world of its own and without the others.

    It is :class:`~mpfa_envs.NavigationEnv` N times, with the same observations, actions, rewards,
    ends and infos, and a robot drives the same trajectory in it; but all are moved, sensed and
    rewarded together by compiled loops, some thirty times as fast.

    It follows gymnasium's conventions for vector environments: arrays have the robots as their
    first axis, ``infos`` holds an array for each key and a mask ``_key`` beside it, and
    ``autoreset_mode`` says when an episode that has ended gives way to the next.

    Robot i draws from a source of randomness of its own, made of the seed and i alone: its episodes
    are the same for any number of robots and in any process.

    Args:
        num_envs: Number of robots N.
        world: What :class:`~mpfa_envs.NavigationEnv` takes; a sequence of it, robot i driving in
            number ``i % len``; or the name of a generator, ``"rooms"``, ``"bars"`` and so on
            (:data:`~mpfa_envs.GENERATORS`), whose worlds follow one another.
        robot: As there, and so on for the next ones.
        physics: ``"wheels"`` has no bodies of the obstacles, as the shapes say what collides.
        max_steps: Time limit of an episode in time steps.
        time_step: Duration of a time step [s].
        action_repeat: Time steps for which an action is held.
        goal_radius: Distance of the robot's center from the goal that reaches it [m].
        collision_distance: Distance of the center from an obstacle that is a collision [m].
        progress_scale: ε_p of Eq. (25) [1/m].
        progress: What an approach is measured by.
        reward: Computes the reward in place of Eq. (25), robot by robot and hence slowly, unless it
            is a ``functools.partial`` of :func:`~mpfa_envs.navigation_reward`.
        lidar: Arguments of :class:`~mpfa_envs.Lidar` other than its defaults.
        closeness_distance: A range of this or less has closeness one [m].
        min_goal_distance: Least distance between a sampled start and goal [m].
        max_goal_distance: Longest way between them [m].
        detour_chance: Chance that a sampled task must have an obstacle in its way.
        difficulty: Difficulty of a generator's worlds, from 0 to 1; None: each world's own.
        episodes_per_world: Episodes of a robot in a generator's world before it gets another.
        split: Which worlds of a generator: ``"train"`` or ``"validation"``.
        autoreset_mode: When a new episode begins: ``NEXT_STEP`` with the step after the last one,
            whose action is ignored; ``SAME_STEP`` with the last one, whose observation and info go
            to ``infos["final_obs"]`` and ``infos["final_info"]``; ``DISABLED`` when
            ``reset(options={"reset_mask": ...})`` asks for it.
        render_mode: ``"rgb_array"`` to get pictures from :meth:`render`.

    Raises:
        ImportError: If there is no PyBullet and physics is ``"wheels"``.
        ValueError: If an argument is out of its range, or a world has no task; nothing is built
            then.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import VectorNavigationEnv
        >>> env = VectorNavigationEnv(4, world=["A", "D"], physics="kinematic")
        >>> observations, infos = env.reset(seed=0)
        >>> observations, rewards, ended, timeout, infos = env.step(np.ones((4, 2)))
        >>> observations.shape, infos["sim_time"]
        ((4, 24), array([0.2, 0.2, 0.2, 0.2]))
        >>> [world.name for world in env.worlds]
        ['A', 'D', 'A', 'D']
        >>> env.close()
    """

    def __init__(
        self,
        num_envs: int,
        *,
        world: WorldChoice | Sequence[WorldChoice] = "A",
        robot: str | RobotModel = "turtlebot2",
        physics: Physics = "wheels",
        max_steps: int = 500,
        time_step: float = 0.1,
        action_repeat: int = 2,
        goal_radius: float = 0.5,
        collision_distance: float | Literal["contact"] | None = None,
        progress_scale: float = PROGRESS_SCALE,
        progress: Progress = "straight_line",
        reward: RewardFunction | None = None,
        lidar: Mapping[str, Any] | None = None,
        closeness_distance: float | None = None,
        min_goal_distance: float = 2.0,
        max_goal_distance: float = math.inf,
        detour_chance: float = 0.8,
        difficulty: float | None = None,
        episodes_per_world: int = 1,
        split: Literal["train", "validation"] = "train",
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        self.num_envs = check_count("num_envs", num_envs)
        self._set_arguments(
            robot=robot,
            physics=physics,
            max_steps=max_steps,
            time_step=time_step,
            action_repeat=action_repeat,
            goal_radius=goal_radius,
            collision_distance=collision_distance,
            progress_scale=progress_scale,
            progress=progress,
            reward=reward,
            lidar=lidar,
            closeness_distance=closeness_distance,
            min_goal_distance=min_goal_distance,
            detour_chance=detour_chance,
            render_mode=render_mode,
        )
        if autoreset_mode not in tuple(AutoresetMode):
            raise ValueError(
                f"autoreset_mode must be a gymnasium.vector.AutoresetMode, got {autoreset_mode!r}"
            )
        self.autoreset_mode = autoreset_mode
        self.lidar = self._make_lidar(_EMPTY)
        self._source = EpisodeSource(
            world,
            self.num_envs,
            self,
            split=split,
            difficulty=difficulty,
            episodes_per_world=episodes_per_world,
            max_goal_distance=max_goal_distance,
        )
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 10,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = self._make_spaces(
            self.lidar.sectors, self._source.diagonal
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._make_tables()
        self._drives: Drives = make_drives(
            self.physics, self.robot, self.num_envs, time_step=self.time_step
        )

    def _make_tables(self) -> None:
        """Allocate what is known of each robot."""
        count = self.num_envs
        self._tasks: list[Task | None] = [None] * count
        self._rngs: list[np.random.Generator] = []
        self._episodes = EpisodeArrays(
            motions=np.zeros((count, 5)),
            goals=np.zeros((count, 2)),
            numbers=np.zeros((len(NUMBERS), count)),
            flags=np.zeros((len(FLAGS), count), dtype=np.bool_),
            steps=np.zeros(count, dtype=np.int64),
            clearances=np.zeros(count),
            ways=np.zeros((2, count)),
        )
        self._worlds = WorldBatch([self._source.fixed(i) or _EMPTY for i in range(count)])
        self._fields = FieldBatch(count) if self.progress == "shortest_path" else None
        self._running = np.zeros(count, dtype=np.bool_)
        self._trails = np.zeros((count, min(self.max_steps, 500) + 1, 2))
        self._ranges = np.zeros((count, self.lidar.angles.size))
        self._directions = np.stack((np.cos(self.lidar.angles), np.sin(self.lidar.angles)))
        self._observations = np.zeros((count, self.lidar.sectors + 6), dtype=np.float32)
        self._rules = (
            self.robot.radius,
            self.collision_distance,
            self.goal_radius,
            self.time_step,
        )
        self._scales = (
            self.closeness_distance,
            self.robot.max_wheel_speed,
            self.robot.max_angular_speed,
        )
        self._reward_scales = _scales_of(self._reward)

    @property
    def worlds(self) -> list[World]:
        """The world that each robot is in."""
        return list(self._worlds)

    @property
    def worlds_refused(self) -> int:
        """Worlds of the generator that had no task and were drawn anew."""
        return self._source.refused

    @property
    def tasks(self) -> list[Task | None]:
        """Start and goal of each robot's episode; None before the first."""
        return list(self._tasks)

    @property
    def poses(self) -> NDArray[np.float64]:
        """Poses (x, y, heading) [m, m, rad], ``[N, 3]``."""
        return self._episodes.motions[:, :3].copy()

    def trail(self, index: int) -> list[tuple[float, float]]:
        """Positions (x, y) of a robot's episode so far [m].

        Args:
            index: Number of the robot.
        """
        rows = self._trails[index, : self._episodes.steps[index] + 1]
        return [(x, y) for x, y in rows.tolist()]

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode of every robot, or of some.

        Args:
            seed: Seed of these and all following episodes. A sequence has a seed for each robot,
                with which it has the episodes of a :class:`~mpfa_envs.NavigationEnv` of that seed.
            options: ``"reset_mask"``, which robots start, ``[N]`` of bool; ``"tasks"``, a
                :class:`~mpfa_envs.Task` or None for each robot; ``"worlds"``, a world or None for
                each. Both hold for this episode and no later one.

        Returns:
            Observations ``[N, 24]`` and infos; a robot that does not start keeps its own.

        Raises:
            ValueError: If a seed is negative, or the options are not tasks that can be driven; the
                episodes go on then.
        """
        seeded = self._read_seed(seed)
        chosen = read_mask(options, self.num_envs)
        given = read_tasks(options, self.num_envs, self._source.fixed, self._check)
        if not self._rngs and not chosen.all():
            raise ResetNeeded("the first reset must start all robots, got a reset_mask")
        if not self._rngs:
            self._rngs = _generators(np.random.SeedSequence(), self.num_envs)
        for index in np.flatnonzero(chosen).tolist():
            if (rng := seeded[index]) is not None:
                self._rngs[index] = rng
                self._source.forget(index)
            self._begin(index, given[index])
        self._sense(chosen)
        return self._observations.copy(), self._infos(chosen)

    def step(
        self, actions: NDArray[np.float32], *, only: NDArray[np.bool_] | None = None
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Drive until the next actions are due.

        Args:
            actions: Speeds of the left and the right wheels in [-1, 1], ``[N, 2]``.
            only: Which robots drive, ``[N]``; None: all. The others stand still and keep their
                rows, with a reward of zero.

        Returns:
            Observations ``[N, 24]``, rewards, terminations and truncations ``[N]``, and infos.

        Raises:
            ValueError: If the actions are not two numbers for each robot; nothing has moved then.
            ResetNeeded: If there was no reset yet, or a robot's episode has ended and
                autoreset_mode is ``DISABLED``.
        """
        if not self._rngs:
            raise ResetNeeded("no episode is running: call reset() before step()")
        speeds = self._wheel_speeds(actions)
        chosen = np.ones(self.num_envs, dtype=np.bool_) if only is None else only
        waiting = chosen & ~self._running
        if waiting.any() and self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            raise ResetNeeded(
                f"the episodes of robots {np.flatnonzero(waiting).tolist()} have ended: call "
                "reset(options={'reset_mask': ...}) before step()"
            )
        moving = chosen & self._running
        for index in np.flatnonzero(waiting).tolist():
            self._begin(index, None)
        self._advance(speeds, moving)
        self._sense(chosen)
        flags, numbers = self._episodes.flags, self._episodes.numbers
        rewards = np.where(moving, numbers[REWARD : REWARD + 4].sum(axis=0), 0.0)
        terminated, truncated = moving & (flags[0] | flags[1]), moving & flags[2]
        infos: dict[str, Any] = {}
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            infos = self._final(ended)
            for index in np.flatnonzero(ended).tolist():
                self._begin(index, None)
            self._sense(ended)
        return self._observations.copy(), rewards, terminated, truncated, self._infos(None) | infos

    def _advance(self, speeds: NDArray[np.float64], moving: NDArray[np.bool_]) -> None:
        """Hold the wheel speeds ``[N, 2]`` [m/s] until the next action is due."""
        episodes, worlds, running = self._episodes, self._worlds.arrays, moving.copy()
        episodes.numbers[REWARD : REWARD + 4, moving] = 0.0
        self._lengthen_trails(int(episodes.steps.max()) + self.action_repeat)
        for _ in range(self.action_repeat):
            self._drives.move(episodes.motions, running, speeds)
            judge(episodes, worlds, running, self._trails, self._rules, self.max_steps)
            if self._fields is not None:
                measure_ways(episodes, running, self._fields.arrays)
            if self._reward_scales is None:
                self._pay_by_function(running)
            else:
                pay(episodes, running, self._reward_scales)
            if not stop(episodes.flags, running):
                break
        self._running[moving] = running[moving]

    def _pay_by_function(self, running: NDArray[np.bool_]) -> None:
        """Add what a reward of the user's gives, robot by robot."""
        episodes = self._episodes
        for index in np.flatnonzero(running).tolist():
            outcome = StepOutcome(
                float(episodes.ways[1, index]),
                float(episodes.ways[0, index]),
                bool(episodes.flags[0, index]),
                bool(episodes.flags[1, index]),
                float(episodes.clearances[index]),
                *episodes.motions[index, 3:].tolist(),
            )
            episodes.numbers[REWARD : REWARD + 4, index] += self._reward(outcome)

    def _begin(self, index: int, given: tuple[World, Task | None] | None) -> None:
        """Start the next episode of a robot, the given one or one that is drawn."""
        episode = self._source.draw(index, self._rngs[index], given)
        task, episodes = episode.task, self._episodes
        if self._worlds[index] is not episode.world:
            self._worlds[index] = episode.world
        x, y, heading = task.start
        heading = math.remainder(heading, math.tau)
        distance = math.dist((x, y), task.goal)
        way = distance
        if self._fields is not None and episode.field is not None:
            self._fields[index] = episode.field
            way = episode.field.at(x, y)
        clearance = episode.world.clearance(x, y) - self.robot.radius
        self._drives.place(index, x, y, heading)
        self._tasks[index] = task
        episodes.motions[index] = x, y, heading, 0.0, 0.0
        episodes.goals[index] = task.goal
        episodes.flags[:, index] = False
        episodes.steps[index] = 0
        episodes.clearances[index] = clearance
        episodes.ways[:, index] = way
        numbers = episodes.numbers[:, index]
        numbers[:] = 0.0
        numbers[SHORTEST_PATH] = max(episode.shortest_path - self.goal_radius, 0.0)
        numbers[MIN_CLEARANCE] = clearance
        numbers[DISTANCE] = distance
        numbers[POSE : POSE + 3] = x, y, heading
        self._trails[index, 0] = x, y
        self._running[index] = True

    def _sense(self, chosen: NDArray[np.bool_]) -> None:
        """Sense the worlds and build the observations of some robots."""
        lidar, ranges = self.lidar, self._ranges
        cast_rays(
            self._episodes.motions,
            chosen,
            self._worlds.arrays,
            self._directions,
            lidar.max_range,
            ranges,
        )
        if lidar.noise > 0.0:
            for index in np.flatnonzero(chosen).tolist():
                ranges[index] += lidar.noise * self._rngs[index].standard_normal(ranges.shape[1])
            np.clip(ranges, 0.0, lidar.max_range, out=ranges)
        median = lidar.reduction == "median"
        observe_all(self._episodes, chosen, ranges, median, self._scales, self._observations)

    def _infos(self, chosen: NDArray[np.bool_] | None) -> dict[str, Any]:
        """An array for each key of the info, and a mask of the chosen robots, or of all."""
        mask = np.ones(self.num_envs, dtype=np.bool_) if chosen is None else chosen
        infos: dict[str, Any] = dict(zip(FLAGS, self._episodes.flags.copy(), strict=True))
        infos.update(zip(NUMBERS, self._episodes.numbers.copy(), strict=True))
        infos.update(dict.fromkeys(_MASKS, mask))
        return infos

    def _final(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """What the last step of episodes has shown, before new ones begin."""
        seen = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended).tolist():
            seen[index] = self._observations[index].copy()
        return {
            "final_obs": seen,
            "_final_obs": ended,
            "final_info": self._infos(ended),
            "_final_info": ended,
        }

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Render each robot's room from above.

        Returns:
            A picture of shape ``[480, 480, 3]`` for each robot, or None without a render mode.

        Raises:
            ResetNeeded: If no episode has started.
        """
        if self.render_mode is None:
            return None
        if not self._rngs:
            raise ResetNeeded("there is nothing to render: call reset() before render()")
        # Imported here because training does not render.
        from mpfa_envs.render import render_scene

        return tuple(
            render_scene(
                self._worlds[index],
                robot=self.robot,
                pose=(x, y, heading),
                goal=tuple(self._episodes.goals[index].tolist()),
                goal_radius=self.goal_radius,
                trail=self.trail(index),
                rays=(self.lidar.angles, self._ranges[index]),
            )
            for index, (x, y, heading) in enumerate(self.poses.tolist())
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Release the physics server.

        Args:
            **kwargs: None are used.
        """
        self._drives.close()

    def _wheel_speeds(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """Read actions, as :meth:`~mpfa_envs.RobotModel.wheel_speeds` reads one."""
        values = np.asarray(actions, dtype=np.float64)
        if values.shape != (self.num_envs, 2):
            raise ValueError(f"actions must have shape ({self.num_envs}, 2), got {values.shape}")
        if np.isnan(values).any():
            rows = np.flatnonzero(np.isnan(values).any(axis=1)).tolist()
            raise ValueError(f"actions must not hold NaN, got some for robots {rows}")
        slow, fast = self.robot.min_wheel_speed, self.robot.max_wheel_speed
        return (fast + slow) / 2 + (fast - slow) / 2 * np.clip(values, -1.0, 1.0)

    def _read_seed(
        self, seed: int | Sequence[int | None] | None
    ) -> Sequence[np.random.Generator | None]:
        """Make each robot's source of randomness; None where the old one goes on."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, Sequence) and not isinstance(seed, (str, bytes)):
            if len(seed) != self.num_envs:
                raise ValueError(f"seed must have {self.num_envs} entries, got {len(seed)}")
            checked = [None if one is None else check_count("seed", one, least=0) for one in seed]
            return [None if one is None else np.random.default_rng(one) for one in checked]
        sequence = np.random.SeedSequence(check_count("seed", seed, least=0))
        return _generators(sequence, self.num_envs)

    def _check(self, world: World, task: Task | None) -> Task | None:
        """Refuse a world that is too large, or a task that cannot be driven."""
        if world.diagonal > self._source.diagonal:
            raise ValueError(
                f"world {world.name!r} must be at most {self._source.diagonal:.4g} m from corner "
                f"to corner, as the observations are bounded, got {world.diagonal:.4g} m"
            )
        if task is None:
            return None
        start, goal = task
        return check_task(
            world,
            {"start": start, "goal": goal},
            collision_distance=self.collision_distance,
            goal_radius=self.goal_radius,
            radius=self.robot.radius,
        )

    def _lengthen_trails(self, steps: int) -> None:
        """Make room for so many time steps."""
        if steps >= self._trails.shape[1]:
            longer = np.zeros((self.num_envs, 2 * steps + 1, 2))
            longer[:, : self._trails.shape[1]] = self._trails
            self._trails = longer


def _generators(sequence: np.random.SeedSequence, robots: int) -> list[np.random.Generator]:
    """A source of randomness for each robot, which does not depend on how many there are."""
    return [np.random.default_rng(child) for child in sequence.spawn(robots)]


def _scales_of(reward: RewardFunction) -> tuple[float, float, float] | None:
    """Rewards for goal, collision and approach if Eq. (25) pays; None for any other reward."""
    function = reward.func if isinstance(reward, partial) else reward
    if function is not navigation_reward or (isinstance(reward, partial) and reward.args):
        return None
    given = inspect.signature(navigation_reward).bind_partial(
        **(reward.keywords if isinstance(reward, partial) else {})
    )
    given.apply_defaults()
    scales = given.arguments
    return (
        float(scales["goal_reward"]),
        float(scales["collision_reward"]),
        float(scales["progress_scale"]),
    )
