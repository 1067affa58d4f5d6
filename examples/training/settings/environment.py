"""The settings of the navigation task; its parts check those that have no rule here."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchrl_mpfa.checks import NOT_NEGATIVE, POSITIVE
from training.settings.rules import at_least, between, setting


@dataclass
class NoiseSettings:
    """Errors as a robot has them, in training: those of :class:`mpfa_envs.RobotNoise`."""

    range_noise: float = 0.0
    """Standard deviation of each ray of the lidar [m]."""
    dropout: float = 0.0
    """Chance that a ray reports the greatest range."""
    slip: float = 0.0
    """Mean share of its path that a wheel loses, up to 0.45."""
    latency: int = 0
    """Time steps of 0.1 s after which an action reaches the wheels."""
    drift: float = 0.0
    """Standard deviation of the share of the error of odometry in distances, and in turns."""


@dataclass
class EnvironmentSettings:
    """The navigation task."""

    robot: str = "turtlebot2"
    """``turtlebot2``, the paper's, which can neither stop nor reverse; ``kobuki``, the same body
    with its real wheels, ``turtlebot4``, ``burger`` or ``waffle``."""
    physics: str = "wheels"
    """``wheels``: simulated motors; ``kinematic``: exact arcs, several times faster."""
    max_steps: int = 500
    """Time limit of an episode [0.1 s]."""
    action_repeat: int = 2
    """Time steps of 0.1 s for which an action is held. With one, rewards are twice as many actions
    away, and DDPG is less reliable (``docs/tuning.md``)."""
    progress_scale: float = setting(5.0, NOT_NEGATIVE)
    """eps_p of Eq. 25, not given in the paper. With 15 a place near the goal is worth less than one
    far away, and a critic that is a little too smooth would rather circle than arrive."""
    step_cost: float = setting(0.0, NOT_NEGATIVE)
    """Cost of a time step of 0.1 s, so that a robot that can stand still does not."""
    clearance: float = setting(0.07, NOT_NEGATIVE)
    """Clearance below which training counts a collision [m]. With 0.17 m, 0.35 m from the robot's
    center, a passage of 0.9 m has 0.2 m left to drive in, and robots turn away from it."""
    detour_chance: float = 0.8
    """Chance that start and goal of an episode must have an obstacle between them. Without, up to a
    half of the goals can be driven at blindly."""
    progress: str = "straight_line"
    """Measure of approach in Eq. 25: ``straight_line`` (the paper), ``shortest_path``, or
    ``none``, the goal and the collision alone."""
    max_goal_distance: float | None = setting(None, POSITIVE)
    """Longest path of a sampled task [m]; null: no limit."""
    episodes_per_world: int = setting(1, at_least(1))
    """Episodes of a robot in a world of a generator before it gets another one."""
    memory: str = "none"
    """``map``: the robot maps the hits of its lidar and observes the path to the goal that the map
    leaves open; ``none``: it observes only the current scan."""
    history: int = setting(0, at_least(0))
    """Earlier scans of the lidar that it observes, which show what moves."""
    field_of_view: float | None = setting(None, between(10.0, 360.0, "from 10 to 360 [deg]"))
    """Angle that the lidar sees [deg], in sectors of 10 degrees; null: the robot's own. A robot
    that must keep moving is run into from behind by people unless it sees all 360."""
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    """Errors as a robot has them."""
    filter: float = setting(0.0, between(0.0, 1.0, "from 0 to 1"))
    """Share of the robots whose actions pass the filter that keeps them off what their lidar sees
    (:class:`mpfa_envs.SafetyFilter`); the buffer stores the actions that were carried out. With
    some, a policy learns from long drives and from collisions; with 1, it needs the filter. DQN and
    Q learning, which choose among a few actions, have none."""
    mirror: bool = True
    """Show the learner half of what it samples in the mirror: left and right are alike."""
