"""The reward of the task, Eq. (25) of the paper, or a function in its place.

The equation is from https://doi.org/10.3389/fnbot.2023.1281166.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from mpfa_envs.checks import check_number, got

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

PROGRESS_SCALE: Final = 5.0
"""ε_p of Eq. (25), reward per meter of approach [1/m]; the paper names no value.

With 15 the path pays more than the arrival, so that a place near the goal is worth less than one
far away, and a critic that is a little too smooth would rather circle than arrive.
"""


def _no_sensors(name: str) -> NDArray[np.floating[Any]]:
    """Reject what an outcome that no robot had is asked for."""
    raise ValueError(f"name must be that of a sensor of the task, got {name!r}")


class StepOutcome(NamedTuple):
    """Results of one time step, the argument of a reward function.

    An action has ``action_repeat`` time steps, two by default, whose rewards add up.
    """

    previous_distance: float
    """Distance to the goal before the step, straight or as ``progress`` measures it [m]."""
    distance: float
    """Distance after the step [m]."""
    success: bool
    """The goal was reached in this step."""
    collision: bool
    """The robot came too near to an obstacle or a wall in this step."""
    clearance: float
    """Distance of the robot's rim from the nearest obstacle or wall [m]."""
    linear_speed: float
    """Forward speed after the step [m/s]."""
    angular_speed: float
    """Turning speed after the step, to the left [rad/s]."""
    sense: Callable[[str], NDArray[np.floating[Any]]] = _no_sensors
    """Senses after the step with a further sensor of the robot, by name; gives its values,
    ``[width]``."""


class RewardTerms(NamedTuple):
    """The parts of a reward; the reward is their sum."""

    goal: float = 0.0
    collision: float = 0.0
    progress: float = 0.0
    other: float = 0.0
    """A term of your own in addition to the paper's three."""

    @property
    def total(self) -> float:
        """The reward."""
        return self.goal + self.collision + self.progress + self.other


RewardFunction = Callable[[StepOutcome], RewardTerms]
"""The type of the ``reward`` argument of :class:`~mpfa_envs.NavigationEnv`."""


def reward_terms(
    success: bool,
    collision: bool,
    approach: float,  # [m]
    payments: tuple[float, float, float, float],  # goal, collision, meter, cost of a step
) -> tuple[float, float, float, float]:
    """Terms of Eq. (25), the last case with its sign corrected, and the cost of a step."""
    goal, hit, meter, cost = payments
    if success:
        return goal, 0.0, 0.0, 0.0
    if collision:
        return 0.0, hit, 0.0, 0.0
    return 0.0, 0.0, meter * approach, -cost


def navigation_reward(
    outcome: StepOutcome,
    *,
    progress_scale: float = PROGRESS_SCALE,
    goal_reward: float = 10.0,
    collision_reward: float = -5.0,
    step_cost: float = 0.0,
) -> RewardTerms:
    r"""Reward one step by Eq. (25), with the sign that rewards an approach.

    .. math::

        R = \begin{cases} 10 & \text{goal} \\ -5 & \text{collision} \\
        \varepsilon_p (d_{t-1} - d_t) & \text{otherwise} \end{cases}

    The paper prints :math:`d_t - d_{t-1}`, which pays a robot for leaving; its text, "motivating
    the robot to navigate closer", asks for the opposite, and so do we.

    Args:
        outcome: What the step led to.
        progress_scale: ε_p, reward per meter of approach [1/m].
        goal_reward: Reward for the goal.
        collision_reward: Reward for a collision.
        step_cost: What any other time step costs, for robots that can stand still; none in the
            paper.

    Returns:
        The terms. As in the equation only one of the first three is not zero, and the goal comes
        first.

    Examples:
        >>> from mpfa_envs import StepOutcome, navigation_reward
        >>> step = StepOutcome(2.0, 1.96, False, False, 1.0, 0.4, 0.0)
        >>> round(navigation_reward(step).total, 6)
        0.2
    """
    payments = float(goal_reward), float(collision_reward), float(progress_scale), float(step_cost)
    approach = float(outcome.previous_distance - outcome.distance)
    return RewardTerms(*reward_terms(outcome.success, outcome.collision, approach, payments))


REWARDS: Final[dict[str, RewardFunction]] = {"navigation": navigation_reward}
"""Rewards by the names that tasks and settings may have for them."""


def named_reward(name: str) -> RewardFunction:
    """Find a reward by its name."""
    if name not in REWARDS:
        raise ValueError(
            f"reward must be callable, None or a name in REWARDS, {sorted(REWARDS)}, "
            f"{got(name, REWARDS)}: register it first, in scripts by a plugin"
        )
    return REWARDS[name]


def resolve_reward(
    reward: RewardFunction | None, *, progress: str, progress_scale: float
) -> RewardFunction:
    """Find the function that rewards a task."""
    if reward is None:
        return partial(
            navigation_reward, progress_scale=0.0 if progress == "none" else progress_scale
        )
    if not callable(reward):
        raise ValueError(f"reward must be callable or None, got {reward!r}")
    if payments_of(reward) is not None and progress == "none":
        equation: Callable[..., RewardTerms] = reward
        return partial(equation, progress_scale=0.0)
    return reward


def read_terms(terms: Any) -> RewardTerms:
    """Check the terms that a reward function returned."""
    try:
        goal, collision, progress, other = terms
        # It takes no text, which float would read as a number.
        sound = all(map(math.isfinite, (goal, collision, progress, other)))
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise ValueError(f"reward must give RewardTerms of four finite numbers, got {terms!r}")
    return RewardTerms(float(goal), float(collision), float(progress), float(other))


def payments_of(reward: RewardFunction) -> tuple[float, float, float, float] | None:
    """Eq. (25): rewards for goal, collision and a meter, cost of a step; None for another one."""
    function = reward.func if isinstance(reward, partial) else reward
    if function is not navigation_reward or (isinstance(reward, partial) and reward.args):
        return None
    keywords = reward.keywords if isinstance(reward, partial) else {}
    try:
        given = inspect.signature(navigation_reward).bind_partial(**keywords)
    except TypeError as error:
        raise ValueError(f"reward must have keywords of navigation_reward: {error}") from error
    given.apply_defaults()
    goal, collision, progress, cost = (
        check_number(name, given.arguments[name])
        for name in ("goal_reward", "collision_reward", "progress_scale", "step_cost")
    )
    return goal, collision, progress, cost
