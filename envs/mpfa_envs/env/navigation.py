"""The navigation task as a gymnasium environment of one robot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mpfa_envs.checks import check_seed
from mpfa_envs.env.reset_options import read_view
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.sensing.observation import INFO_TYPES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.episodes import WorldChoice
    from mpfa_envs.scene.scene import Window
    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.worlds.world import Task, World


class NavigationEnv(gymnasium.Env["NDArray[np.float32]", "NDArray[np.float32]"]):
    """A two-wheeled robot drives to goals by lidar, in one world or in new ones.

    It is a :class:`~mpfa_envs.VectorNavigationEnv` of one robot behind gymnasium's interface of
    single environments. ``gymnasium.make("mpfa/Navigation-D-v1")`` is this class in world D,
    ``"mpfa/Rooms-v1"`` with :data:`~mpfa_envs.ROOMS_TASK`, a new world in each episode. For many
    robots ``gymnasium.make_vec`` gives the vector, several times as fast as as many of these.

    **Observation**, ``Box`` of shape ``[24]``, float32 (:data:`OBSERVATION` names the slices):

    ====== ================ ==================================================== ==========
    index  name             meaning                                              range
    ====== ================ ==================================================== ==========
    0-17   lidar            closeness ``min(closeness_distance / range, 1)`` of  [0, 1]
                            18 sectors of 10 degrees over the front, left to
                            right
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
    index  name             meaning                                              range
    ====== ================ ==================================================== ==========
    24-25  way_direction    cosine and sine of the direction, in the robot's     [-1, 1]
                            frame, of the path to the goal on its map
    26     way_length       ``length / 10 m``, longer where it is narrow         [0, 1.5]
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
        world: ``"A"`` to ``"D"``, ``"validation"``, ``"test"``, the path of a YAML file, a
            :class:`~mpfa_envs.World`, or the name of a generator (:data:`~mpfa_envs.GENERATORS`),
            whose worlds follow one another.
        render_mode: ``"rgb_array"`` to get pictures from :meth:`render`; ``"human"`` for a live
            window in real time, which needs pygame and shows the robot at each decision.
        **kwargs: Further arguments of :class:`~mpfa_envs.VectorNavigationEnv`, the fields of
            :class:`~mpfa_envs.TaskConfig` above all: ``NavigationEnv(world="D", **PAPER_TASK)``.

    Raises:
        ImportError: If there is no PyBullet and physics is ``"wheels"``.
        ValueError: If an argument is out of its range, or a world has no task; nothing is built
            then.

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
        world: WorldChoice = "A",
        render_mode: Literal["human", "rgb_array"] | None = None,
        **kwargs: Any,
    ) -> None:
        self.robots = VectorNavigationEnv(
            1,
            world=world,
            autoreset_mode=AutoresetMode.DISABLED,
            **kwargs,
        )
        """The robot."""
        self.metadata = read_view(self.metadata, render_mode, self.config.action_time)
        self.render_mode = render_mode
        self.robots.render_mode = render_mode and "rgb_array"
        self.observation_space = self.robots.single_observation_space
        self.action_space = self.robots.single_action_space
        self._running = False
        self._window: Window | None = None

    @property
    def config(self) -> TaskConfig:
        """The settings of the task."""
        return self.robots.config

    @property
    def lidar(self) -> Lidar:
        """The robot's lidar, in its present world."""
        return self.config.make_lidar(self.world)

    @property
    def world(self) -> World:
        """The robot's present world."""
        return self.robots.worlds[0]

    @property
    def task(self) -> Task | None:
        """Start and goal of the current episode; None before the first."""
        return self.robots.tasks[0]

    @property
    def motion(self) -> tuple[float, ...]:
        """Pose (x, y, heading) [m, m, rad], forward and turning speed [m/s, rad/s]."""
        return tuple(self.robots.motions[0].tolist())

    @property
    def trail(self) -> list[tuple[float, float]]:
        """Positions (x, y) of the current episode so far [m]."""
        return self.robots.trail(0)

    @property
    def walkers(self) -> NDArray[np.float64]:
        """The walkers: (x, y), their speeds in both directions, and their radii, ``[K, 5]``."""
        return self.robots.walkers(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of this and all following episodes.
            options: ``{"world": ..., "start": (x, y, heading), "goal": (x, y)}`` [m, m, rad] fixes
                this episode; a world alone its world.

        Returns:
            Observation and info.

        Raises:
            ValueError: If the seed is negative or the options are not a task that can be driven;
                the episode continues then.
        """
        given = self._read(options or {})
        if seed is not None:
            seed = check_seed(seed)
        observations, infos = self.robots.reset(
            seed=None if seed is None else [seed], options=given
        )
        super().reset(seed=seed)
        self._running = True
        if self.render_mode == "human":
            self.render()
        return observations[0], _first(infos)

    def _read(self, options: dict[str, Any]) -> dict[str, Any]:
        """The options of the robots."""
        for name in options:
            if name not in ("world", "start", "goal"):
                raise ValueError(
                    f"options must have keys among ['world', 'start', 'goal'], got {name!r}"
                )
        if ("start" in options) != ("goal" in options):
            raise ValueError(f"options must have start and goal, or neither, got {options}")
        world = options.get("world")
        if "start" not in options:
            return {"worlds": [world]}
        world, task = self.robots.check_task(0, options["start"], options["goal"], world)
        return {"worlds": [world], "tasks": [task]}

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
        if np.shape(action) != (2,):
            raise ValueError(f"action must have shape (2,), got {np.shape(action)}")
        observations, rewards, *ends, infos = self.robots.step(np.asarray(action)[None])
        terminated, truncated = (bool(ended[0]) for ended in ends)
        self._running = not (terminated or truncated)
        if self.render_mode == "human":
            self.render()
        return observations[0], float(rewards[0]), terminated, truncated, _first(infos)

    def render(self) -> NDArray[np.uint8] | None:
        """Render the world from above.

        Returns:
            Picture of shape ``[H, W, 3]``, the longer side 480, or None without a render
            mode or in a window.

        Raises:
            ResetNeeded: If no episode has started.
        """
        pictures = self.robots.render()
        if pictures is None:
            return None
        if self.render_mode != "human":
            return pictures[0]
        if self._window is None:
            # Imported here because it needs pygame.
            from mpfa_envs.scene.scene import Window

            self._window = Window(type(self).__name__, fps=self.metadata["render_fps"])
        self._window.show(pictures[0])
        return None

    def close(self) -> None:
        """Release the physics server and the window; a second call does nothing."""
        self._running = False
        if self._window is not None:
            self._window.close()
            self._window = None
        self.robots.close()


def _first(infos: dict[str, Any]) -> dict[str, Any]:
    """The info of the only robot."""
    return {name: infos[name][0].item() for name in INFO_TYPES}
