"""What decides for robots: a policy, a planner or your own, in a simulation and on a robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mpfa_envs.safety.filter import SafetyFilter
    from mpfa_envs.sensing.map_loops import MapArrays
    from mpfa_envs.worlds.shapes import Point
    from mpfa_envs.worlds.world import World

Action = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""A policy: a function from observations, ``[N, O]``, to actions, ``[N, 2]``."""


class Errand(NamedTuple):
    """What a robot has to do, and with what. Places are in the frame of its odometry."""

    start: tuple[float, float, float]
    """Pose (x, y, heading) at which it begins [m, m, rad]."""
    goal: Point
    """Position (x, y) of the goal [m]; :attr:`Senses.goals` follows it if it moves."""
    goal_radius: float
    """Distance from the goal that reaches it [m]."""
    time_step: float
    """Duration of a time step, of which a decision has some [s]."""
    action_repeat: int
    """Time steps for which an action is held."""
    make_filter: Callable[[], SafetyFilter]
    """Gives the filter that keeps this robot off what it sees, each time the same one; raises a
    ValueError for a robot that can have none."""
    map_shape: tuple[int, int] | None = None
    """Columns and rows of its map; None without."""
    world: World | None = None
    """All that is around it, for drivers that may know it; None where nobody does."""
    world_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose (x, y, heading) of the world's frame [m, m, rad]."""


class Senses(NamedTuple):
    """What N robots know when they decide. Places are in the frames of their odometry."""

    robots: NDArray[np.int64]
    """Their numbers, ``[N]``."""
    observations: NDArray[np.float32]
    """What a policy sees, ``[N, O]``."""
    states: NDArray[np.float32]
    """Observations in each of the states in which they may be when the orders act, which a filter
    allows for, ``[N, S, O]``; in a simulation the one above."""
    motions: NDArray[np.float64]
    """Poses (x, y, heading) and speeds (forward, turning) by odometry when the orders act,
    ``[N, 5]`` [m, m, rad, m/s, rad/s]."""
    poses: NDArray[np.float64]
    """Poses (x, y, heading) for drivers that may know the world, ``[N, 3]`` [m, m, rad]: in a
    simulation the true ones of now, on a robot those of the motions."""
    goals: NDArray[np.float64]
    """Positions (x, y) of the goals, ``[N, 2]`` [m]."""
    maps: MapArrays | None
    """The maps, whose rows are the robots' by number; None without ``memory="map"``."""
    find_still: Callable[[], NDArray[np.bool_]] | None = None
    """Gives whether all that is seen in a sector are walls of the plan, ``[N, sectors]``; None
    without a plan."""

    def of(self, chosen: NDArray[np.bool_]) -> Senses:
        """Return the senses of some robots, chosen by ``[N]``."""
        find = self.find_still
        return self._replace(
            robots=self.robots[chosen],
            observations=self.observations[chosen],
            states=self.states[chosen],
            motions=self.motions[chosen],
            poses=self.poses[chosen],
            goals=self.goals[chosen],
            find_still=None if find is None else lambda: find()[chosen],
        )


@runtime_checkable
class Driver(Protocol):
    """What decides for robots; :class:`~mpfa_envs.planners.PredictiveControl` is one.

    :func:`~mpfa_envs.evaluate`, :func:`~mpfa_envs.run_tasks` and a
    :class:`~mpfa_envs.deploy.Pilot` take one in place of a policy, behind a filter and with late
    orders, too.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import evaluate
        >>> class Ahead:
        ...     def begin(self, robot, errand):
        ...         print("to be within", errand.goal_radius)
        ...
        ...     def drive(self, senses):
        ...         return np.ones((len(senses.robots), 2), np.float32)
        >>> results = evaluate(Ahead(), "A", episodes=1, physics="kinematic")
        to be within 0.5
    """

    def begin(self, robot: int, errand: Errand) -> None:
        """Prepare for the errand of a robot by number, which forgets its last one."""

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """Actions of N robots that are on their errands, ``[N, 2]``."""


class ObservationDriver:
    """A policy as a :class:`Driver`, which sees the observations alone."""

    def __init__(self, policy: Action, *, alone: bool = False) -> None:
        self.policy = policy
        self.alone = alone

    def begin(self, robot: int, errand: Errand) -> None:
        """Nothing is prepared."""

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """One action for each observation."""
        observations = senses.observations
        if self.alone:
            action = np.asarray(self.policy(observations[0]), dtype=np.float32)
            if action.shape != (2,):
                raise ValueError(
                    f"policy must give an action of shape (2,) for one observation, got {action!r}"
                )
            return action[None]
        actions = np.asarray(self.policy(observations), dtype=np.float32)
        if actions.shape != (len(observations), 2):
            raise ValueError(
                f"policy must give actions of shape {(len(observations), 2)} for observations of "
                f"shape {observations.shape}, got {actions.shape}; one that takes a single "
                "observation runs with envs_at_once=1"
            )
        return actions


class Filtered:
    """A policy, or a driver, whose actions pass a filter: a :class:`Driver`.

    Args:
        policy: As for :func:`~mpfa_envs.run_tasks`.
        keep: From observations, ``[N, O]``, and actions, ``[N, 2]``, to the actions that are
            carried out, ``[N, 2]``; a :class:`~mpfa_envs.SafetyFilter`, say.

    Examples:
        >>> from mpfa_envs import Filtered, TaskConfig, evaluate
        >>> task = {"robot": "kobuki", "physics": "kinematic"}
        >>> ahead = lambda observations: np.ones((len(observations), 2))
        >>> careful = Filtered(ahead, TaskConfig(**task).make_filter())
        >>> sum(each.collision for each in evaluate(careful, "D", episodes=5, **task))
        0
    """

    def __init__(
        self,
        policy: Action | Driver,
        keep: Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]],
    ) -> None:
        self.policy, self.keep = policy, keep
        self._driver = as_driver(policy)
        self.env_arguments: dict[str, Any] = dict(getattr(policy, "env_arguments", {}))
        """Those of the policy."""

    def begin(self, robot: int, errand: Errand) -> None:
        """Prepare the driver for the errand of a robot."""
        self._driver.begin(robot, errand)

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """The driver's actions, filtered."""
        actions, keep = self._driver.drive(senses), self.keep
        # What comes is all the same to other filters, and finding the walls takes time.
        if senses.find_still is None or not getattr(getattr(keep, "body", None), "approach", 0.0):
            return keep(senses.observations, actions)
        return cast("SafetyFilter", keep)(senses.observations, actions, still=senses.find_still())


def as_driver(policy: Action | Driver, *, alone: bool = False) -> Driver:
    """A policy, or a driver, as a :class:`Driver`."""
    return policy if isinstance(policy, Driver) else ObservationDriver(policy, alone=alone)
