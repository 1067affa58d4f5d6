"""The settings of the navigation task.

The task itself has the defaults, and checks what has no rule here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mpfa_envs import RobotNoise, TaskConfig
from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE
from training.settings.rules import at_least, between, setting


@dataclass
class NoiseSettings:
    """Errors as a robot has them, in training: those of :class:`mpfa_envs.RobotNoise`."""

    range_noise: float = RobotNoise.range_noise
    """Standard deviation of each ray of the lidar [m]."""
    dropout: float = RobotNoise.dropout
    """Chance that a ray reports the greatest range."""
    slip: float = RobotNoise.slip
    """Mean share of its path that a wheel loses, up to 0.45."""
    drift: float = RobotNoise.drift
    """Standard deviation of the share of the error of odometry in distances, and in turns."""


@dataclass
class EnvironmentSettings:
    """The navigation task."""

    robot: Any = TaskConfig.robot.name
    """``turtlebot2``, the paper's, which can neither stop nor reverse; ``kobuki``, the same body
    with its real wheels, ``turtlebot4``, ``burger`` or ``waffle``; or the path of a YAML file of
    your own (``docs/howto/robot.md``), whose values a run keeps in its place."""
    physics: str = TaskConfig.physics
    """``wheels``: simulated motors; ``kinematic``: exact arcs, several times faster."""
    max_steps: int | None = None
    """Time limit of an episode [0.1 s]; null: the time in which the robot drives 105 m at full
    speed, as in evaluations."""
    action_repeat: int | None = TaskConfig.action_repeat
    """Time steps of 0.1 s for which an action is held. DDPG is less reliable with one
    (``docs/tuning.md``). Null: the time in which the robot drives 0.14 m at full speed, at least
    0.2 s."""
    progress_scale: float = setting(TaskConfig.progress_scale, NOT_NEGATIVE)
    """eps_p of Eq. 25, not given in the paper. With 15 robots circle near the goal."""
    step_cost: float = setting(0.0, NOT_NEGATIVE)
    """Cost of a time step of 0.1 s, for robots that can stand still."""
    clearance: float = setting(TaskConfig.clearance, NOT_NEGATIVE)
    """Clearance below which training counts a collision [m]. With 0.17 m a passage of 0.9 m has
    0.2 m left to drive in."""
    detour_chance: float = TaskConfig.detour_chance
    """Chance that a task must have an obstacle between start and goal."""
    progress: str = TaskConfig.progress
    """Measure of approach in Eq. 25: ``straight_line`` (the paper), ``shortest_path``, or ``none``:
    goal and collision alone."""
    reward: str | None = None
    """Name of a reward in :data:`mpfa_envs.REWARDS`, which a plugin registers; it takes the place
    of Eq. 25 with ``progress_scale`` and ``step_cost``. Null: Eq. 25."""
    goal_radius: float = setting(TaskConfig.goal_radius, between(0.1, 1.5, "from 0.1 to 1.5 [m]"))
    """Distance from the goal at which the robot has arrived [m]."""
    max_goal_distance: float | None = setting(None, POSITIVE)
    """Longest path of a sampled task [m]; null: no limit."""
    episodes_per_world: int = setting(1, at_least(1))
    """Episodes of a robot in a world of a generator."""
    memory: str = TaskConfig.memory
    """``map``: the robot observes the path to the goal on a map of its lidar's hits; ``none``: the
    current scan alone."""
    plan: str = TaskConfig.plan
    """``known``: the robot's map begins with all obstacles and walls that stand; ``unknown``: it
    begins empty. A policy that learned without a plan drives with it as well."""
    history: int = setting(TaskConfig.history, at_least(0))
    """Earlier scans in the observation, which show what moves."""
    field_of_view: float | None = setting(None, between(10.0, 360.0, "from 10 to 360 [deg]"))
    """Angle that the lidar sees [deg], in sectors of 10 degrees; null: the robot's own."""
    sensors: list[str] = field(default_factory=list)
    """Names of further sensors in :data:`mpfa_envs.SENSORS`, which a plugin registers. A policy
    with them drives in evaluations, and no robot."""
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    """Errors as a robot has them."""
    latency: Any = None
    """Time from a scan to the moment at which the wheels take the order [s], or the least and the
    greatest, ``[0.0,0.2]``, between which each episode has its own; null: the robot's."""
    filter: float = setting(0.0, between(0.0, 1.0, "from 0 to 1"))
    """Share of the robots whose actions pass the filter that keeps them off obstacles
    (:class:`mpfa_envs.SafetyFilter`); ``filter_cost`` says which action is stored. With 1
    evaluations have the filter, too, and a policy needs it. Episodes still end, as collisions, at
    ``clearance``: the filter lets a robot pass by at 0.01 m. DQN and Q learning have none."""
    filter_cost: float | None = setting(None, NOT_NEGATIVE)
    """Cost of an action that the filter changes, times the larger change of the two wheels; also of
    0 the buffer stores the action that was chosen, so that the critic learns what the filter
    refuses. Null: it stores what was carried out. No difference was found
    (``docs/results/sparse.md``)."""
    mirror: bool = True
    """Show the learner half of its samples in the mirror, which also swaps front and rear where a
    robot has them alike."""
