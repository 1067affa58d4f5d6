"""Episodes as they would have been with another goal: one that the robot did reach."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from mpfa_envs.sensing.map_memory import MapMemory
from mpfa_envs.sensing.observation import observe_goals
from mpfa_envs.tasks.reward import payments_of
from mpfa_envs.worlds.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from tensordict import TensorDictBase
    from tensordict.utils import NestedKey
    from torch import Tensor

    from mpfa_envs.env.config import TaskConfig

_NO_PATHS = np.zeros((0, 3))


class GoalRelabeling:
    """Gives an episode the goal that the robot was at after one of its steps.

    The rows are those that the environment itself would have given: direction and distance of the
    new goal, with ``memory="map"`` the path to it on the map that the robot had at that time, and
    the goal's reward and end where the robot first comes within its radius. What follows in the
    episode is left out.

    The environment pays and ends an episode after each time step, this after each action: a robot
    that is within the radius between two actions and not after them drives on here, and where the
    goal is reached the cost of an action's earlier time steps is left out.

    Args:
        config: The settings of the task.

    Raises:
        ValueError: If the reward has a progress, which another goal would change, or is a function
            of your own.

    Examples:
        >>> from mpfa_envs import GoalRelabeling, NavigationTorchEnv
        >>> env = NavigationTorchEnv(
        ...     world="B", physics="kinematic", progress="none", hindsight=True
        ... )
        >>> _ = env.set_seed(0), torch.manual_seed(0)  # The actions are random.
        >>> relabel = GoalRelabeling(env.env.config)
        >>> rows = relabel(env.rollout(60), torch.tensor([10]))
        >>> rows["next", "reward"][-1].item(), rows["next", "terminated"].sum().item()
        (10.0, 1)
        >>> env.close()
    """

    entries: ClassVar[tuple[NestedKey, ...]] = ("hindsight", ("next", "hindsight"))
    """Entries that it reads, other than observation, reward and ends; its rows lack them."""

    def __init__(self, config: TaskConfig) -> None:
        payments = payments_of(config.reward_function)
        if payments is None:
            raise ValueError(
                f"reward must be None or navigation_reward with goals in hindsight, got "
                f"{getattr(config.reward, '__name__', config.reward)!r}"
            )
        if payments[2] != 0:
            raise ValueError(
                "progress must be 'none' with goals in hindsight, as progress to one goal is none "
                f"to another, got {config.progress!r}"
            )
        if config.plan == "known":
            raise ValueError(
                "plan must be 'unknown' with goals in hindsight, whose maps begin empty, got "
                f"{config.plan!r}"
            )
        self._config, self._lidar, self._goal_reward = config, config.make_lidar(), payments[0]

    def __call__(self, episode: TensorDictBase, steps: Tensor) -> TensorDictBase:
        """Relabel an episode, once for each of some goals.

        Args:
            episode: Its transitions in their order, batch size ``[T]``, with :attr:`entries`.
            steps: Numbers of the steps after which the robot was at the goals, ``[K]``.

        Returns:
            Transitions to one goal after the other, batch size ``[R]``; none to a goal that the
            robot was within the radius of when the episode began.
        """
        measurements = _joined(episode, "hindsight").numpy()
        positions, motions = measurements[:, :2], measurements[:, 4:9]
        goals = positions[steps.cpu().numpy() + 1]
        away = np.linalg.norm(goals[:, None] - positions, axis=2)
        ends = np.argmax(away <= self._config.goal_radius, axis=1)
        goals, ends = goals[ends > 0], ends[ends > 0]
        paths = self._paths(measurements, goals, ends)
        before = np.concatenate([np.arange(end) for end in ends] or [np.arange(0)])
        of_goal = np.repeat(np.arange(len(ends)), ends)
        last = torch.from_numpy(np.cumsum(ends) - 1)
        rows = episode.exclude(*self.entries)[torch.from_numpy(before)]
        seen = _joined(episode, "observation")
        for key, at in (("observation", before), (("next", "observation"), before + 1)):
            to = goals[of_goal] - motions[at, :2]
            observations = seen[torch.from_numpy(at)].numpy()
            observe_goals(
                motions[at],
                goals[of_goal],
                np.hypot(*to.T),
                np.ones(len(at), dtype=np.bool_),
                _NO_PATHS if paths is None else paths[at, of_goal],
                self._lidar.sectors,
                observations,
            )
            rows.set(key, torch.from_numpy(observations))
        following = rows["next"]
        for key, value in (("reward", self._goal_reward), ("terminated", 1), ("done", 1)):
            following[key][last] = value
        if (truncated := following.get("truncated", None)) is not None:
            truncated[last] = False
        return rows

    def _paths(
        self, measurements: NDArray[np.float64], goals: NDArray[np.float64], ends: NDArray[np.int64]
    ) -> NDArray[np.float64] | None:
        """Paths on the robot's map, ``[T + 1, K, 3]``: it is made once more, for each goal."""
        if self._config.memory != "map":
            return None
        count, (width, depth) = len(goals), measurements[0, 2:4].tolist()
        world = World(name="hindsight", size=(width, depth))
        memory = MapMemory(count, self._config.robot, self._lidar)
        for index in range(count):
            memory.begin(index, world)
        paths = np.zeros((len(measurements), count, 3))
        for step in range(int(ends.max(initial=-1)) + 1):
            now, taken, scans = (
                np.broadcast_to(
                    measurements[step, part], (count, measurements[step, part].size)
                ).copy()
                for part in (slice(4, 9), slice(9, 12), slice(12, None))
            )
            paths[step] = memory.remember(now, goals, scans, ends >= step, taken=taken)
        return paths


def _joined(episode: TensorDictBase, key: str) -> Tensor:
    """An entry at the beginning of the episode and after each of its steps, ``[T + 1, ...]``."""
    return torch.cat((episode[key], episode["next", key][-1:]))
