"""The navigation task for many robots at once, each in its own world."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box as BoxSpace
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mpfa_envs.checks import check_count
from mpfa_envs.env.config import TaskConfig, check_names
from mpfa_envs.env.episodes import EpisodeSource, WorldChoice, read_state, robot_to_plain
from mpfa_envs.env.errands import errand_of, senses_of
from mpfa_envs.env.reset_options import (
    read_mask,
    read_reset_mask,
    read_seed,
    read_tasks,
    read_view,
    spawn_generators,
)
from mpfa_envs.env.robots import RobotBatch
from mpfa_envs.env.step_loops import outcomes
from mpfa_envs.env.team import check_starts, check_team
from mpfa_envs.worlds.world import Task, World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.driver import Errand, Senses

_EMPTY = World(name="empty")


class VectorNavigationEnv(VectorEnv["NDArray[np.float32]", "NDArray[np.float32]", "NDArray[Any]"]):
    """Many robots drive to goals by lidar, each in its own world, or several in one.

    It is :class:`~mpfa_envs.NavigationEnv` N times, with the same observations, actions, rewards,
    ends and infos, and a robot drives the same trajectory in it; but compiled loops move, sense and
    reward all robots together, some thirty times as fast.

    It follows gymnasium's conventions for vector environments: arrays have the robots as their
    first axis, ``infos`` holds an array for each key and its mask ``_key``, and
    ``autoreset_mode`` says when the next episode follows one that has ended.

    Robot i has its own source of randomness, made of the seed and i alone: its episodes are the
    same for any number of robots and in any process.

    Args:
        num_envs: Number of robots N.
        world: What :class:`~mpfa_envs.NavigationEnv` takes; a sequence of it, robot i driving in
            number ``i % len``; or the name of a generator, ``"rooms"``, ``"bars"`` and so on
            (:data:`~mpfa_envs.GENERATORS`), whose worlds follow one another.
        difficulty: Difficulty of a generator's worlds, from 0 to 1; None: each world's own.
        episodes_per_world: Episodes of a robot in a generator's world before it gets another.
        split: Which worlds of a generator: ``"train"`` or ``"validation"``.
        max_goal_distance: Longest path between a sampled start and goal [m].
        autoreset_mode: When a new episode begins: ``NEXT_STEP`` with the step after the last one,
            whose action is ignored; ``SAME_STEP`` with the last one, whose observation and info go
            to ``infos["final_obs"]`` and ``infos["final_info"]``; ``DISABLED`` when
            ``reset(options={"reset_mask": ...})`` asks for it.
        render_mode: ``"rgb_array"`` to get pictures from :meth:`render`.
        team: Robots in a world: the first so many, the next, and so on. Each is a moving obstacle
            of the others, and stays where its episode ended. Such an environment takes
            ``autoreset_mode=DISABLED`` and the tasks of all robots (:mod:`mpfa_envs.tasks.teams`).
        **task: Fields of :class:`~mpfa_envs.TaskConfig`. On wheels there are no bodies of the
            obstacles, as the shapes say what collides.

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

    # Gymnasium declares it as an instance variable.
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    single_observation_space: BoxSpace[np.float32]

    def __init__(
        self,
        num_envs: int,
        *,
        world: WorldChoice | Sequence[WorldChoice] = "A",
        max_goal_distance: float = math.inf,
        difficulty: float | None = None,
        episodes_per_world: int = 1,
        split: Literal["train", "validation"] = "train",
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: Literal["rgb_array"] | None = None,
        team: int = 1,
        **task: Any,
    ) -> None:
        self.num_envs = check_count("num_envs", num_envs)
        check_names(task, signature(VectorNavigationEnv).parameters)
        self.config = TaskConfig(**task)
        """The settings of the task."""
        self.metadata = read_view(self.metadata, render_mode, self.config.action_time)
        self.render_mode = render_mode
        if autoreset_mode not in tuple(AutoresetMode):
            raise ValueError(
                f"autoreset_mode must be a gymnasium.vector.AutoresetMode, got {autoreset_mode!r}"
            )
        self.autoreset_mode = autoreset_mode
        self.team = check_team(team, self.num_envs, autoreset_mode)
        """Number of robots in a world."""
        self.lidar = self.config.make_lidar()
        """The robots' lidar, in an empty world."""
        self._source = EpisodeSource(
            world,
            self.num_envs,
            self.config,
            split=split,
            difficulty=difficulty,
            episodes_per_world=episodes_per_world,
            max_goal_distance=max_goal_distance,
        )
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self.single_observation_space, self.single_action_space = self.config.make_spaces(
            self._source.diagonal
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._batch = self._make_batch()
        self._rngs: list[np.random.Generator] = []
        self._seeded: dict[int, np.random.Generator] = {}
        """Sources of randomness of the episodes that begin next, where seeds were given."""
        self._begun = False

    def _make_batch(self) -> RobotBatch:
        """Make robots whose episodes have not begun."""
        worlds = [self._source.fixed(index) or _EMPTY for index in range(self.num_envs)]
        return RobotBatch(self.config, self.lidar, worlds, self.team)

    @property
    def worlds(self) -> list[World]:
        """The present world of each robot."""
        return list(self._batch.worlds)

    @property
    def worlds_rejected(self) -> int:
        """Number of worlds of the generator that were replaced, as they had no task."""
        return self._source.rejected

    @property
    def tasks(self) -> list[Task | None]:
        """Start and goal of each robot's episode; None before the first."""
        return list(self._batch.tasks)

    @property
    def motions(self) -> NDArray[np.float64]:
        """Poses (x, y, heading) and speeds (forward, turning), ``[N, 5]``."""
        return self._batch.episodes.motions.copy()

    @property
    def poses(self) -> NDArray[np.float64]:
        """Poses (x, y, heading) [m, m, rad], ``[N, 3]``."""
        return self._batch.episodes.motions[:, :3].copy()

    @property
    def observations(self) -> NDArray[np.float32]:
        """The last observations, ``[N, O]``."""
        return self._batch.observations.copy()

    @property
    def measurements(self) -> NDArray[np.float64]:
        """State that hindsight relabeling needs, ``[N, 12 + rays]`` [m, m/s, rad]."""
        return self._batch.measurements()

    @property
    def info_tables(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """The infos as two tables, ``[3, N]`` and ``[15, N]``: the rows are flags and numbers."""
        return self._batch.episodes.flags.copy(), self._batch.episodes.numbers.copy()

    def errand(self, index: int) -> Errand:
        """What a robot has to do in the present episode, as a driver is told it.

        Args:
            index: Number of the robot.

        Returns:
            The errand; it knows the world.

        Raises:
            ResetNeeded: If no episode has started.
        """
        return errand_of(self._batch, self.config, index)

    def senses(self, robots: NDArray[np.int64]) -> Senses:
        """What some robots know now, as a driver is told it.

        Args:
            robots: Their numbers, ``[N]``.

        Returns:
            The senses. The maps change as the robots drive, the rest is a copy.
        """
        return senses_of(self._batch, self.config, robots)

    def check_task(
        self,
        index: int,
        start: Sequence[float],
        goal: Sequence[float],
        world: WorldChoice | None = None,
    ) -> tuple[World, Task]:
        """Read a task of a robot.

        Args:
            index: Number of the robot.
            start: Pose (x, y, heading) [m, m, rad].
            goal: Position (x, y) [m].
            world: By name, file or object; None: the one that the robot always drives in.

        Returns:
            The world and the task.

        Raises:
            ValueError: If it cannot be driven.
        """
        chosen = self._source.world(index, world)
        return chosen, self._source.check_task(chosen, start, goal)

    def trail(self, index: int) -> list[tuple[float, float]]:
        """Positions (x, y) of a robot's episode so far [m]."""
        return self._batch.trail(index)

    def walkers(self, index: int) -> NDArray[np.float64]:
        """Walkers, then the other robots of its team, around a robot, ``[K, 5]``.

        Rows have (x, y), velocity and radius [m, m/s, m].
        """
        return self._batch.moving(index)

    def set_seed(self, seed: int | Sequence[int | None]) -> None:
        """Seed the episodes that begin from now on, without beginning any.

        Args:
            seed: As in :meth:`reset`.

        Raises:
            ValueError: If a seed is negative, or there are not as many as robots.
        """
        self._seeded |= read_seed(seed, self.num_envs)

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
            Observations ``[N, O]`` and infos; a robot that does not start keeps its own.

        Raises:
            ValueError: If a seed is negative, or the options are not tasks that can be driven; the
                episodes continue then.
        """
        seeded = read_seed(seed, self.num_envs)
        chosen = read_reset_mask(options, self.num_envs)
        given = read_tasks(options, self.num_envs, self._source)
        if self.team > 1:
            check_starts(chosen, given, self.team, self.config.robot.radius)
        if not self._begun and not chosen.all():
            raise ResetNeeded("the first reset must start all robots, got a reset_mask")
        self._begin(chosen, self._seeded | seeded, given)
        self._begun = True
        self._batch.sense(chosen, self._rngs)
        return self._batch.observations.copy(), self._batch.infos(chosen)

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
            Observations ``[N, O]``, rewards, terminations and truncations ``[N]``, and infos.

        Raises:
            ValueError: If the actions are not two numbers for each robot, or only is no mask of
                them; nothing has moved then.
            ResetNeeded: If there was no reset yet, or a robot's episode has ended and
                autoreset_mode is ``DISABLED``.
        """
        if not self._begun:
            raise ResetNeeded("no episode is running: call reset() before step()")
        speeds = self._batch.wheel_speeds(actions)
        chosen = read_mask("only", only, self.num_envs)
        moving = chosen & self._batch.running
        waiting = chosen & ~moving
        if waiting.any():
            if self.autoreset_mode is not AutoresetMode.NEXT_STEP:
                raise ResetNeeded(
                    f"the episodes of robots {np.flatnonzero(waiting).tolist()} have ended: call "
                    "reset(options={'reset_mask': ...}) before step()"
                )
            self._begin(waiting, self._seeded)
        self._batch.advance(speeds, moving, self._rngs)
        self._batch.sense(chosen, self._rngs)
        rewards, terminated, truncated = outcomes(self._batch.episodes, moving)
        infos: dict[str, Any] = {}
        ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            infos = self._batch.final_infos(ended)
            self._begin(ended, self._seeded)
            self._batch.sense(ended, self._rngs)
        infos = self._batch.infos(None) | infos
        return self.observations, rewards, terminated, truncated, infos

    def _begin(
        self,
        chosen: NDArray[np.bool_],
        seeded: Mapping[int, np.random.Generator],
        given: Sequence[tuple[World, Task | None] | None] | None = None,
    ) -> None:
        """Start the next episodes of some robots, ``[N]``, or none if one of them has none."""
        robots = np.flatnonzero(chosen).tolist()
        if not robots:
            return
        rngs = list(self._rngs) or spawn_generators(np.random.SeedSequence(), self.num_envs)
        renewed = [index for index in robots if index in seeded]
        for index in renewed:
            rngs[index] = seeded[index]
        episodes = self._source.sample(robots, rngs, given, renewed)
        self._rngs = rngs
        for index, episode in zip(robots, episodes, strict=True):
            self._seeded.pop(index, None)
            self._batch.begin(index, episode, rngs[index])
        if self._batch.team is not None:
            self._batch.team.begin(self._batch.episodes, chosen)

    def _describe(self) -> dict[str, Any]:
        """Plain values by name: the arguments that decide what happens next."""
        own = {"num_envs": self.num_envs, "autoreset_mode": self.autoreset_mode.value}
        return {**own, **self.config.describe(), **self._source.describe()}

    def state_dict(self) -> dict[str, Any]:
        """Return the state from which another environment can continue these episodes.

        Returns:
            Plain values and arrays: for each robot the random state where its episode began, the
            name of a world that it keeps, and the actions since.

        Raises:
            ValueError: If the options of a reset gave an episode its world or task.
        """
        robots = range(self.num_envs) if self._begun else ()
        begins, driven = self._source.begins, self._batch.driven
        return {
            "arguments": self._describe(),
            "rejected": self._source.rejected,
            "seeded": [
                self._seeded[index].bit_generator.state if index in self._seeded else None
                for index in range(self.num_envs)
            ],
            "robots": [robot_to_plain(begins[index], driven(index)) for index in robots],
            "positions": self._batch.episodes.motions[:, :2].copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where another environment with the same arguments was.

        The episodes so far are sampled and driven again, and what follows is the same to the bit;
        on wheels for up to 32 robots. Loading takes as long as the steps of the longest episode. A
        reward function of your own is called again, too.

        Args:
            state: What :meth:`state_dict` gave.

        Raises:
            ValueError: If it is of an environment with other arguments, the first of which is
                named, of an earlier version, or no state, or ends elsewhere when it is driven
                again; nothing has changed then.
        """
        begins, driven, seeded = read_state(state, self._describe(), self.config, self._source)
        source, episodes, rngs = self._source.sample_again(begins, rejected=state["rejected"])
        batch = self._make_batch()
        batch.drive_again(episodes, driven, rngs, state["positions"])
        self._batch.drives.close()
        self._batch, self._source, self._begun = batch, source, bool(episodes)
        self._rngs, self._seeded = rngs, {i: rng for i, rng in enumerate(seeded) if rng}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Render each robot's world from above.

        Returns:
            A picture for each robot, ``[H, W, 3]``, 480 the longer side; None without a mode.

        Raises:
            ResetNeeded: If no episode has started.
        """
        if self.render_mode is None:
            return None
        return tuple(snapshot() for snapshot in self.snapshots())

    def snapshots(self) -> tuple[Callable[[], NDArray[np.uint8]], ...]:
        """Keep how each robot's world is now, to render it later or never.

        Returns:
            A function for each robot, which gives the picture of :meth:`render`.

        Raises:
            ResetNeeded: If no episode has started.
        """
        if not self._begun:
            raise ResetNeeded("there is nothing to render: call reset() before render()")
        return self._batch.snapshots()

    def close_extras(self, **kwargs: Any) -> None:
        """Release the physics server; keyword arguments are not used."""
        # gymnasium 1.2 also closes an environment whose arguments were rejected.
        if hasattr(self, "_batch"):
            self._batch.drives.close()
