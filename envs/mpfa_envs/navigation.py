"""The navigation task as a gymnasium environment."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, Literal

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding

from mpfa_envs.arguments import Physics, Progress, TaskArguments
from mpfa_envs.builtin_worlds import resolve_world
from mpfa_envs.checks import check_seed
from mpfa_envs.drives import Drive, KinematicDrive, Motion, WheelDrive
from mpfa_envs.episodes import draw_episode, keeping
from mpfa_envs.live_view import RenderMode
from mpfa_envs.noise import RobotNoise
from mpfa_envs.observation import INFO_TYPES, Memory
from mpfa_envs.reward import PROGRESS_SCALE, RewardFunction, RewardTerms, StepOutcome, read_terms
from mpfa_envs.robot import RobotModel
from mpfa_envs.senses import Senses
from mpfa_envs.tasks import Task, check_task
from mpfa_envs.walkers import no_encounters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.distance import DistanceField
    from mpfa_envs.local_field import LocalField
    from mpfa_envs.walker_batch import WalkerBatch
    from mpfa_envs.worlds import World

_ALONE: Final = np.ones(1, dtype=np.bool_)
_NOBODY: Final = np.zeros((0, 5))


class NavigationEnv(TaskArguments, gymnasium.Env["NDArray[np.float32]", "NDArray[np.float32]"]):
    """A two-wheeled robot drives to a goal by lidar, without a map.

    **Observation**, ``Box`` of shape ``[24]``, float32 (:data:`OBSERVATION` names the slices):

    ====== ================ ==================================================== ==========
    index  name             meaning                                              range
    ====== ================ ==================================================== ==========
    0-17   lidar            closeness ``min(closeness_distance / range, 1)`` of  [0, 1]
                            18 sectors of 10 degrees, left to right over the front
    18-19  goal_direction   cosine and sine of the goal's direction in the       [-1, 1]
                            robot's frame: an angle would jump at ±π
    20     goal_closeness   ``clip(0.3 / d, 0, 1)`` for the goal's distance d    [0, 1]
    21     goal_distance    ``d / 10 m``                                         [0, 1.42]
    22     linear_speed     forward speed over the robot's fastest               [-2, 2]
    23     angular_speed    turning speed over the robot's fastest, left is      [-2, 2]
                            positive
    ====== ================ ==================================================== ==========

    With ``memory="map"`` it has shape ``[27]``:

    ====== ================ ==================================================== ==========
    24-25  way_direction    cosine and sine of the direction, in the robot's     [-1, 1]
                            frame, of the way to the goal on its map
    26     way_length       ``length / 10 m``, longer where it is narrow         [0, 10]
    ====== ================ ==================================================== ==========

    With ``history=K`` there are ``18 K`` more at the end, ``lidar_history``: the lidar's sectors at
    the K decisions before, the newest first, and when an episode begins the first ones K times.

    **Action**, ``Box(-1, 1)`` of shape ``[2]``, float32: speed of the left and the right wheel,
    from the robot's slowest (0.05 m/s for the TurtleBot2) to its fastest (0.5 m/s). It neither
    stops nor reverses. Actions are clipped to the box.

    **Reward**: Eq. (25) of the paper, see :func:`~mpfa_envs.navigation_reward`.

    **Episode end**: ``terminated`` at the goal or at a collision; ``truncated`` after ``max_steps``
    time steps. An episode that reaches the goal in the time step of its collision counts as a
    success, as the cases of Eq. (25) are ordered.

    **Info**, the same keys after every reset and step (:data:`INFO_TYPES`): ``success``,
    ``collision``, ``timeout``; ``sim_time`` [s]; ``path_length`` driven so far [m];
    ``shortest_path`` [m], the shortest path that ends the episode: from the start to the goal's
    center for a disc of the robot's radius, less the goal's radius, so that
    ``success * shortest_path / max(path_length, shortest_path)`` is the SPL; ``min_clearance`` [m],
    the least distance so far between the robot's rim and an obstacle, wall or walker; ``distance``
    to the goal's center [m]; the pose ``x``, ``y`` [m], ``heading`` [rad]; the terms of the reward,
    ``reward_goal``, ``reward_collision``, ``reward_progress``, ``reward_other``; and of the
    walkers, so far: ``walker_distance`` [m], the least distance between the robot's rim and theirs,
    ``intrusion_time`` [s], for which it was below 0.5 m, and ``time_to_collision`` [s], the least
    time after which robot and walker would have touched had both kept their velocities; without
    walkers, or far from all of them, they are 10 m, zero and 10 s.

    Args:
        world: ``"A"`` to ``"D"``, ``"validation"``, ``"test"``, the path of a YAML file or a
            :class:`~mpfa_envs.World`.
        robot: A name in :data:`~mpfa_envs.ROBOTS`, or a :class:`~mpfa_envs.RobotModel`.
        physics: ``"wheels"`` simulates motors and friction in PyBullet; ``"kinematic"`` moves on
            exact arcs, several times faster, and needs no PyBullet. Lidar, clearance and
            collisions are computed from the same shapes in both.
        max_steps: Time limit of an episode in time steps.
        time_step: Duration of a time step [s]; the robot must not drive collision_distance in less.
        action_repeat: Time steps for which an action is held. Their rewards add up, and the episode
            may end after any of them. The default is half as many decisions as time steps.
        goal_radius: Distance of the robot's center from the goal that reaches it, walls or not [m].
        collision_distance: Distance of the robot's center from an obstacle or wall that is a
            collision [m]. None: the robot's radius and 0.07 m, 0.25 m for the TurtleBot2.
            ``"contact"``: the robot's radius.
        progress_scale: The paper's ε_p in Eq. (25), reward per meter of approach [1/m].
        progress: What an approach is measured by: ``"straight_line"``, the distance to the goal as
            in Eq. (25); ``"shortest_path"``, the way to it that keeps the collision distance
            (:class:`~mpfa_envs.DistanceField`); or ``"none"``, only goal and collision count.
        reward: Computes the reward in place of Eq. (25), and without progress_scale;
            ``functools.partial(navigation_reward, goal_reward=20.0)``, say. Another function pays
            as it likes; with ``progress="none"`` it is told the straight distances.
        lidar: Arguments of :class:`~mpfa_envs.Lidar` other than its defaults, ``{"noise": 0.02}``.
        memory: ``"map"``: the robot keeps a map of what its lidar hit in this episode and senses
            the way to the goal that is open on it (:class:`~mpfa_envs.MapMemory`); ``"none"``: it
            senses what is before it and nothing else.
        history: How many earlier scans it senses beside the last one, sector by sector: those of
            the decisions before, the newest first, by which it may tell what moves.
        noise: Errors of the lidar, the wheels, the time and the odometry, none by default: a
            :class:`~mpfa_envs.RobotNoise` or its numbers by name.
        closeness_distance: A range of this or less has closeness one [m]. None: the default of
            collision_distance, whatever that is.
        min_goal_distance: Least distance between a sampled start and goal [m].
        detour_chance: Chance that a sampled task must have an obstacle in its way; 0: no condition.
        render_mode: ``"rgb_array"`` to get pictures from :meth:`render`; ``"human"`` for a live
            window in real time, which needs pygame.

    The defaults are the task that the study trains on. :data:`PAPER_TASK` holds what the paper says
    or suggests where that differs: ``NavigationEnv(world="D", **PAPER_TASK)``.

    Raises:
        ImportError: If there is no PyBullet and physics is ``"wheels"``.
        ValueError: If an argument is out of its range; nothing is built then.

    Examples:
        >>> from mpfa_envs import NavigationEnv
        >>> env = NavigationEnv(world="B", physics="kinematic")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step([1.0, 1.0])
        >>> observation.shape, info["sim_time"]
        ((24,), 0.2)
        >>> env.close()
    """

    # Gymnasium declares it as an instance variable.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        *,
        world: str | os.PathLike[str] | World = "A",
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
        memory: Memory = "none",
        history: int = 0,
        noise: RobotNoise | Mapping[str, Any] | None = None,
        closeness_distance: float | None = None,
        min_goal_distance: float = 2.0,
        detour_chance: float = 0.8,
        render_mode: RenderMode | None = None,
    ) -> None:
        self.world = resolve_world(world)
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
            memory=memory,
            history=history,
            noise=noise,
            closeness_distance=closeness_distance,
            min_goal_distance=min_goal_distance,
            detour_chance=detour_chance,
            render_mode=render_mode,
        )
        self.lidar = self._make_lidar(self.world)
        self.observation_space, self.action_space = self._make_spaces(
            self.lidar.sectors, self.world.diagonal
        )
        self._task: Task | None = None
        self._field: DistanceField | LocalField | None = None
        self._running = False
        self._trail: list[tuple[float, float]] = []
        self._senses = Senses(self, self.lidar)
        self._walkers = self._make_walkers() if self.world.walkers else None
        self._noise = self._make_noise(1)
        self._drive: Drive = (
            KinematicDrive(self.robot, time_step=self.time_step)
            if physics == "kinematic"
            else WheelDrive(self.robot, self.world, time_step=self.time_step)
        )

    @property
    def task(self) -> Task | None:
        """Start and goal of the current episode; None before the first."""
        return self._task

    @property
    def trail(self) -> list[tuple[float, float]]:
        """Positions (x, y) of the current episode so far [m]."""
        return list(self._trail)

    @property
    def walkers(self) -> NDArray[np.float64]:
        """The walkers: (x, y), their speeds in both directions, and their radii, ``[K, 5]``."""
        return _NOBODY if self._walkers is None else self._walkers.of(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of this and all following episodes.
            options: ``{"start": (x, y, heading), "goal": (x, y)}`` [m, m, rad] fixes the task; None
                samples one.

        Returns:
            Observation and info.

        Raises:
            ValueError: If the seed is negative or the options are not a task that can be driven;
                the episode goes on then.
        """
        if seed is not None:
            seed = check_seed(seed)
        task = self.check_task(options) if options else None
        source = (self.np_random, self.np_random_seed) if seed is None else seeding.np_random(seed)
        with keeping(source[:1]):
            _, task, length, self._field, walkers = draw_episode(self, self.world, source[0], task)
        self._np_random, self._np_random_seed = source
        self._task = task
        self._goal = task.goal
        self._shortest_path = max(length - self.goal_radius, 0.0)
        self._steps = 0
        self._path_length = 0.0
        self._motion = self._drive.place(*task.start)
        self._distance = math.dist(task.start[:2], task.goal)
        self._way = self._way_from(*task.start[:2])
        if self._walkers is not None:
            self._walkers.begin(0, walkers)
        self._encounters = np.array(no_encounters())[:, None]
        self._min_clearance = self._to_obstacle(*task.start[:2]) - self.robot.radius
        self._trail = [task.start[:2]]
        self._running = True
        if self._noise is not None:
            self._noise.begin(0, self._motion[:3], self.np_random)
        self._senses.begin(self.world)
        observation = self._observe()
        if self.render_mode == "human":
            self.render()
        return observation, self._info(False, False, False, RewardTerms())

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive until the next action is due.

        Args:
            action: Speeds of the left and the right wheel, shape ``[2]``, in [-1, 1].

        Returns:
            Observation, reward, terminated, truncated and info.

        Raises:
            ValueError: If the action is not two numbers; nothing has moved then.
            ResetNeeded: If no episode is running.
        """
        if not self._running:
            raise ResetNeeded("no episode is running: call reset() before step()")
        left, right = self.robot.wheel_speeds(action)
        success, collision, truncated, terms = self._advance(left, right)
        for _ in range(self.action_repeat - 1):
            if not self._running:
                break
            success, collision, truncated, more = self._advance(left, right)
            terms = RewardTerms(*map(sum, zip(terms, more, strict=True)))
        info = self._info(success, collision, truncated, terms)
        return self._observe(), float(terms.total), success or collision, truncated, info

    def _advance(self, left: float, right: float) -> tuple[bool, bool, bool, RewardTerms]:
        """Hold the wheel speeds [m/s] for one time step.

        Returns:
            Whether the goal was reached, the robot collided, or time is up; and the reward.
        """
        if self._walkers is not None:
            self._walkers.move(_ALONE, np.array([self._motion]))
        if self._noise is not None:
            told = np.array([[left, right]])
            left, right = self._noise.drive(told, _ALONE, [self.np_random])[0].tolist()
        motion = self._drive.move(left, right)
        if self._noise is not None:
            self._noise.measure(np.array([motion]), _ALONE)
        if self._walkers is not None:
            self._walkers.count_encounters(np.array([motion]), _ALONE, self._encounters)
        self._steps += 1
        self._path_length += math.dist(motion[:2], self._motion[:2])
        self._motion = motion
        self._trail.append((motion.x, motion.y))
        previous = self._way
        self._distance = math.dist(self._goal, motion[:2])
        self._way = self._way_from(motion.x, motion.y)
        to_obstacle = self._to_obstacle(motion.x, motion.y)
        clearance = to_obstacle - self.robot.radius
        self._min_clearance = min(self._min_clearance, clearance)
        success = self._distance <= self.goal_radius
        collision = not success and to_obstacle <= self.collision_distance
        speeds = motion.linear_speed, motion.angular_speed
        outcome = StepOutcome(previous, self._way, success, collision, clearance, *speeds)
        terms = read_terms(self.reward(outcome))
        truncated = not (success or collision) and self._steps >= self.max_steps
        self._running = not (success or collision or truncated)
        if self.render_mode == "human":
            self.render()
        return success, collision, truncated, terms

    def _to_obstacle(self, x: float, y: float) -> float:
        """Distance to the nearest obstacle, wall or walker [m]."""
        walker = math.inf if self._walkers is None else self._walkers.clearance(0, x, y)
        return min(self.world.clearance(x, y), walker)

    def _way_from(self, x: float, y: float) -> float:
        """What is left of the way to the goal, as the progress is measured [m]."""
        return self._distance if self._field is None else self._field.at(x, y)

    def render(self) -> NDArray[np.uint8] | None:
        """Render the room from above.

        Returns:
            Picture, ``[H, W, 3]``, 480 the longer side; None without a render mode or in a window.

        Raises:
            ResetNeeded: If no episode has started.
        """
        if self.render_mode is None:
            return None
        if self._task is None:
            raise ResetNeeded("there is nothing to render: call reset() before render()")
        # Imported here because training does not render.
        from mpfa_envs.render import render_scene

        motion, walkers = self._motion, self.walkers
        ranges = self.lidar.cast(*motion[:3], moving=walkers[:, [0, 1, 4]])
        picture = render_scene(
            self.world,
            robot=self.robot,
            pose=motion[:3],
            goal=self._task.goal,
            goal_radius=self.goal_radius,
            trail=self._trail,
            rays=(self.lidar.angles, ranges),
            sketch=self._senses.sketch(motion.x, motion.y),
            walkers=walkers,
        )
        return self._show(picture)

    def close(self) -> None:
        """Release the physics server and the window; a second call does nothing."""
        self._running = False
        self._close_window()
        self._drive.close()

    def _make_walkers(self) -> WalkerBatch:
        """What moves around the robot."""
        # Imported here because it needs Numba, which takes half a second.
        from mpfa_envs.walker_batch import WalkerBatch
        from mpfa_envs.world_batch import WorldBatch

        worlds = WorldBatch([self.world])
        return WalkerBatch(worlds, radius=self.robot.radius, time_step=self.time_step)

    def _observe(self) -> NDArray[np.float32]:
        """Sense the world and build the observation."""
        motion = self._motion
        odometry = motion
        if self._noise is not None and self._noise.has_odometry:
            odometry = Motion(*self._noise.odometry[0].tolist())
        rng = self.np_random if self.lidar.is_noisy else None
        return self._senses.observe(motion, odometry, self._goal, walkers=self._walkers, rng=rng)

    def _info(
        self, success: bool, collision: bool, timeout: bool, terms: RewardTerms
    ) -> dict[str, Any]:
        """Build the info dictionary; its keys are those of :data:`INFO_TYPES`."""
        numbers = (
            *terms,
            self._steps * self.time_step,
            self._path_length,
            self._shortest_path,
            self._min_clearance,
            self._distance,
            *self._motion[:3],
            *self._encounters[:, 0].tolist(),
        )
        return dict(zip(INFO_TYPES, (success, collision, timeout, *numbers), strict=True))

    def check_task(self, options: dict[str, Any]) -> Task:
        """Read a task from the options of a reset.

        Args:
            options: ``{"start": (x, y, heading), "goal": (x, y)}`` [m, m, rad].

        Returns:
            The task.

        Raises:
            ValueError: If it cannot be driven in this world by this robot.
        """
        return check_task(
            self.world,
            options,
            collision_distance=self.collision_distance,
            goal_radius=self.goal_radius,
            radius=self.robot.radius,
        )
