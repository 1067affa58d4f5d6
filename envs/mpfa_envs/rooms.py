"""The navigation task of one robot in a world that is new in each episode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mpfa_envs.checks import check_seed
from mpfa_envs.live_view import LiveView, RenderMode
from mpfa_envs.observation import INFO_TYPES
from mpfa_envs.vector import VectorNavigationEnv

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.episodes import WorldChoice
    from mpfa_envs.tasks import Task
    from mpfa_envs.worlds import World


class RoomsEnv(LiveView, gymnasium.Env["NDArray[np.float32]", "NDArray[np.float32]"]):
    """One robot drives to goals by lidar, each in a world that it has never seen.

    It is a :class:`~mpfa_envs.VectorNavigationEnv` of one robot behind the interface of
    :class:`~mpfa_envs.NavigationEnv`, which has one world. ``gymnasium.make("mpfa/Rooms-v1")`` is
    this class with :data:`~mpfa_envs.ROOMS_TASK`.

    Args:
        world: The name of a generator; or a world, or several, as in
            :class:`~mpfa_envs.VectorNavigationEnv`.
        render_mode: ``"rgb_array"`` to get pictures from :meth:`render`; ``"human"`` for a live
            window in real time, which needs pygame.
        **kwargs: Further arguments of :class:`~mpfa_envs.VectorNavigationEnv`.

    Raises:
        ImportError: If there is no PyBullet and physics is ``"wheels"``.
        ValueError: If an argument is out of its range, or a world has no task.

    Examples:
        >>> from mpfa_envs import ROOMS_TASK, RoomsEnv
        >>> env = RoomsEnv(**ROOMS_TASK)
        >>> observation, info = env.reset(seed=0)
        >>> first = env.world.name
        >>> observation, info = env.reset()
        >>> env.world.name != first
        True
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
        world: WorldChoice = "mixed",
        render_mode: RenderMode | None = None,
        **kwargs: Any,
    ) -> None:
        self.robots = VectorNavigationEnv(
            1,
            world=world,
            render_mode="rgb_array" if render_mode == "human" else render_mode,
            autoreset_mode=AutoresetMode.DISABLED,
            **kwargs,
        )
        """The robot."""
        # The robots show themselves once for each action.
        self._set_view(render_mode, self.robots.time_step * self.robots.action_repeat, 1)
        self.observation_space = self.robots.single_observation_space
        self.action_space = self.robots.single_action_space
        self._running = False

    @property
    def world(self) -> World:
        """The world that the robot is in."""
        return self.robots.worlds[0]

    @property
    def task(self) -> Task | None:
        """Start and goal of the current episode; None before the first."""
        return self.robots.tasks[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in a new world.

        Args:
            seed: Seed of this and all following episodes.
            options: ``{"world": ..., "start": (x, y, heading), "goal": (x, y)}`` [m, m, rad] fixes
                this episode; a world alone its world.

        Returns:
            Observation and info.

        Raises:
            ValueError: If the seed is negative or the options are not a task that can be driven;
                the episode goes on then.
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
        observations, rewards, *ends, infos = self.robots.step(np.asarray(action)[None])
        terminated, truncated = (bool(ended[0]) for ended in ends)
        self._running = not (terminated or truncated)
        if self.render_mode == "human":
            self.render()
        return observations[0], float(rewards[0]), terminated, truncated, _first(infos)

    def render(self) -> NDArray[np.uint8] | None:
        """Render the room from above.

        Returns:
            Picture of shape ``[H, W, 3]``, the longer side 480, or None without a render
            mode or in a window.

        Raises:
            ResetNeeded: If no episode has started.
        """
        pictures = self.robots.render()
        return None if pictures is None else self._show(pictures[0])

    def close(self) -> None:
        """Release the physics server and the window; a second call does nothing."""
        self._running = False
        self._close_window()
        self.robots.close()


def _first(infos: dict[str, Any]) -> dict[str, Any]:
    """The info of the only robot."""
    return {name: infos[name][0].item() for name in INFO_TYPES}
