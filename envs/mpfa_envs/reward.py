"""The reward of the task, Eq. (25) of the paper, and the seam for another one.

The equation is from https://doi.org/10.3389/fnbot.2023.1281166.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

PROGRESS_SCALE: Final = 5.0
"""ε_p of Eq. (25), reward per meter of approach [1/m]; the paper names no value.

With 15 the way pays more than the arrival, so that a place near the goal is worth less than one
far away, and a critic that is a little too smooth would rather circle than arrive.
"""


class StepOutcome(NamedTuple):
    """What a reward may look at after one step."""

    previous_distance: float
    """Way to the goal before the step, straight or as ``progress`` measures it [m]."""
    distance: float
    """The same after the step [m]."""
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


class RewardTerms(NamedTuple):
    """The parts of a reward; the reward is their sum."""

    goal: float = 0.0
    collision: float = 0.0
    progress: float = 0.0
    other: float = 0.0
    """What a reward of your own adds beside the paper's three terms."""

    @property
    def total(self) -> float:
        """The reward."""
        return self.goal + self.collision + self.progress + self.other


RewardFunction = Callable[[StepOutcome], RewardTerms]
"""The type of the ``reward`` argument of :class:`~mpfa_envs.NavigationEnv`."""


def navigation_reward(
    outcome: StepOutcome,
    *,
    progress_scale: float = PROGRESS_SCALE,
    goal_reward: float = 10.0,
    collision_reward: float = -5.0,
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

    Returns:
        The terms. As in the equation only one of them is not zero, and the goal comes first.

    Examples:
        >>> from mpfa_envs import StepOutcome, navigation_reward
        >>> step = StepOutcome(2.0, 1.96, False, False, 1.0, 0.4, 0.0)
        >>> round(navigation_reward(step).total, 6)
        0.2
    """
    if outcome.success:
        return RewardTerms(goal=goal_reward)
    if outcome.collision:
        return RewardTerms(collision=collision_reward)
    # Eq. (25), last case, with its sign corrected.
    return RewardTerms(progress=progress_scale * (outcome.previous_distance - outcome.distance))


def payments_of(reward: RewardFunction) -> tuple[float, float, float] | None:
    """Read what Eq. (25) pays.

    Args:
        reward: A reward function.

    Returns:
        Rewards for the goal, for a collision and per meter of approach; None if the function is
        neither :func:`~mpfa_envs.navigation_reward` nor a ``functools.partial`` of it by keywords.
    """
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
