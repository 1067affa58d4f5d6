"""The settings of the navigation task, which all its environments share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property, partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from gymnasium.spaces import Box as BoxSpace

from mpfa_envs.checks import (
    check_bool,
    check_choice,
    check_count,
    check_not_negative,
    check_number,
    check_positive,
    check_share,
    did_you_mean,
)
from mpfa_envs.robots.drives import LateOrders, Physics
from mpfa_envs.robots.model import PAPER_CLEARANCE, ROBOTS, TRAINING_CLEARANCE, RobotModel
from mpfa_envs.robots.noise import NoisyMotion, RobotNoise, resolve_noise
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.safety.filter import CLEARANCE, SafetyFilter
from mpfa_envs.sensing.lidar import Lidar
from mpfa_envs.sensing.observation import Memory, observation_bounds, observation_slices
from mpfa_envs.sensing.sensors import Sensor, describe_sensors, resolve_sensors
from mpfa_envs.tasks.reward import (
    PROGRESS_SCALE,
    RewardFunction,
    named_reward,
    payments_of,
    resolve_reward,
)
from mpfa_envs.worlds.world import World

if TYPE_CHECKING:
    from mpfa_envs.robots.discrete import WheelPairs
    from mpfa_envs.sensing.mirror import RandomMirror

Progress = Literal["straight_line", "shortest_path", "none"]
"""Measure of the reward's progress."""

Knowledge = Literal["unknown", "known"]
"""What a robot's map knows when an episode begins."""

PAPER_TASK: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "max_steps": 500,
        "action_repeat": 1,
        "progress_scale": 15.0,
        "clearance": PAPER_CLEARANCE,
        "detour_chance": 0.0,
    }
)
"""Settings of the paper's task, for its TurtleBot2, that differ from the defaults.

The paper gives no ε_p; its curves, about 0.5 reward a step of 0.05 m at most, suggest 10 to 20.
"""
FARTHEST: Final = 105.0
"""Distance that a robot drives at full speed within its time limit, unless another is given [m]."""
_MOST_STEPS: Final = 1_000_000
"""Most time steps of an episode."""
_CHECKS: Final[Mapping[str, Callable[[str, Any], Any]]] = {
    "contact": check_bool,
    "physics": partial(check_choice, kinds=Physics),
    "progress": partial(check_choice, kinds=Progress),
    "plan": partial(check_choice, kinds=Knowledge),
    "progress_scale": check_number,
    "clearance": check_not_negative,
    "max_steps": partial(check_count, most=_MOST_STEPS),
    "time_step": check_positive,
    "action_repeat": check_count,
    "goal_radius": check_positive,
    "closeness_distance": check_positive,
    "min_goal_distance": check_positive,
    "detour_chance": check_share,
}
_MOST_LATENCY: Final = 2.0
"""Greatest latency [s]: where a robot will be later than that is hardly known."""
_EMPTY: Final = World(name="empty")
_OF_THE_LIDAR: Final = ("reduction", "max_range", "noise", "field_of_view", "dropout")
_DESCRIBED: Final = (
    "robot",
    "clearance",
    "contact",
    "reward",
    "progress_scale",
    "lidar",
    "sensors",
)
"""Fields that a description has in another form."""
_MOST_RAYS: Final = 3
"""Rays of a sector in training; the nearest of more differs little, and each takes time."""
_DERIVED: Final = {
    "collision_distance": "give clearance, counted from the robot's rim, or contact=True",
}
"""What to say of properties that are given as arguments."""
_PAYMENTS: Final = ("goal_reward", "collision_reward", "progress_scale", "step_cost")


def lidar_arguments(field_of_view: float) -> dict[str, Any]:
    """Arguments of a lidar with a field of view [deg] in sectors of 10 degrees."""
    return {"field_of_view": field_of_view, "sectors": max(round(field_of_view / 10.0), 1)}


def lidar_of(robot: RobotModel) -> dict[str, Any]:
    """Arguments of the lidar of a robot: at most three rays in each sector, and at least one."""
    found = lidar_arguments(robot.field_of_view)
    if robot.lidar_rays is not None:
        found["sectors"] = min(found["sectors"], robot.lidar_rays)
        found["rays_per_sector"] = min(robot.lidar_rays // found["sectors"], _MOST_RAYS)
    return found


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """The navigation task: robot, senses, reward, and when an episode ends.

    :class:`~mpfa_envs.NavigationEnv`, :class:`~mpfa_envs.VectorNavigationEnv` and
    :func:`~mpfa_envs.make_navigation_env` take its fields as keyword arguments and keep it as
    ``env.config``. The defaults are the task that the study trains on; :data:`PAPER_TASK` holds
    what the paper says or suggests where that differs.

    A field has the type that it has afterwards: names, None and mappings may be given where their
    meaning says so.

    Raises:
        ValueError: If a field is out of its range.

    Examples:
        >>> from mpfa_envs import TaskConfig
        >>> TaskConfig(robot="burger", max_steps=200).robot.radius
        0.105
    """

    robot: RobotModel = ROBOTS["turtlebot2"]
    """A :class:`~mpfa_envs.RobotModel`, its fields by name, the path of a YAML file
    (:func:`~mpfa_envs.load_robot`), or a name in :data:`~mpfa_envs.ROBOTS`."""
    physics: Physics = "wheels"
    """``"wheels"`` simulates motors and friction in PyBullet; ``"kinematic"`` moves on exact arcs,
    several times faster, and needs no PyBullet. Lidar, clearance and collisions are computed from
    the same shapes in both."""
    max_steps: int = None  # type: ignore[assignment]
    """Time limit of an episode in time steps. None: the time in which the robot drives
    :data:`FARTHEST` at full speed, 150 s for a Kobuki."""
    time_step: float = 0.1
    """Duration of a time step [s], in which the robot must not drive farther than its
    :attr:`collision_distance`."""
    action_repeat: int = 2
    """Time steps for which an action is held. Their rewards add up, and the episode may end after
    any of them. The default is half as many decisions as time steps."""
    goal_radius: float = 0.5
    """Distance of the robot's center from the goal that reaches it, walls or not [m]."""
    clearance: float = TRAINING_CLEARANCE
    """Clearance of the robot's rim from obstacles and walls, below which an episode ends with a
    collision [m]."""
    contact: bool = False
    """True if only a rim that touches is a collision, as in evaluations."""
    progress_scale: float = PROGRESS_SCALE
    """The paper's ε_p in Eq. (25), reward per meter of approach [1/m]."""
    progress: Progress = "straight_line"
    """Measure of an approach: ``"straight_line"``, the distance to the goal as in Eq.
    (25); ``"shortest_path"``, the path to it that keeps the collision distance
    (``DistanceField``); or ``"none"``, only goal and collision count."""
    reward: RewardFunction | None = None
    """Computes the reward in place of Eq. (25), robot by robot and hence slowly, and without
    progress_scale: a function, or its name in :data:`~mpfa_envs.REWARDS`.
    ``functools.partial(navigation_reward, goal_reward=20.0)``, say, is as fast. Another function
    pays as it likes; with ``progress="none"`` it gets the straight distances."""
    lidar: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of :class:`~mpfa_envs.Lidar`, ``{"noise": 0.02}``. Unless they say so, range, rays
    and field of view are the robot's, in sectors of 10 degrees."""
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    """Sensors beside the lidar, each a further part of the observation, behind all others: a
    :class:`~mpfa_envs.Sensor` by name, ``{"rear": LidarSensor(...)}``, or names in
    :data:`~mpfa_envs.SENSORS`."""
    memory: Memory = "none"
    """``"map"``: the robot keeps a map of what its lidar hit in this episode and senses the path to
    the goal that is open on it (``MapMemory``); ``"none"``: it senses what is
    before it and nothing else."""
    plan: Knowledge = "unknown"
    """``"known"``: the robot's map begins with all obstacles and walls that stand, as a robot that
    was given the plan of its building; ``"unknown"``: it begins empty."""
    history: int = 0
    """Number of earlier scans that it senses in addition to the last one, sector by sector: those
    of the decisions before, the newest first, which show what moves."""
    noise: RobotNoise = field(default_factory=RobotNoise)
    """Errors of the lidar, the wheels and the odometry, none by default: a
    :class:`~mpfa_envs.RobotNoise` or its numbers by name."""
    latency: tuple[float, float] = None  # type: ignore[assignment]
    """Time from a scan to the moment at which the wheels take the order that follows from it [s]: a
    number, or the least and the greatest, between which it is sampled for each episode; rounded to
    time steps. The
    observation is that of the state to which the orders under way bring the robot, as a
    :class:`~mpfa_envs.deploy.Pilot` observes it. None: that of the robot."""
    closeness_distance: float = None  # type: ignore[assignment]
    """A range of this or less has closeness one [m]. None: the least distance from the lidar to
    the robot's rim and the clearance, with ``contact`` too."""
    min_goal_distance: float = 2.0
    """Least distance between a sampled start and goal [m]."""
    detour_chance: float = 0.8
    """Chance that a sampled task must have an obstacle in its path; 0: no condition."""

    def __post_init__(self) -> None:
        """Check all fields; the first that is out of its range is named."""
        robot = resolve_robot(self.robot)
        self._set("robot", robot)
        if self.closeness_distance is None:
            clearance = check_not_negative("clearance", self.clearance)
            self._set("closeness_distance", round(robot.lidar_to_rim + clearance, 9))
        self._set("noise", resolve_noise(self.noise))
        self._set("latency", _read_latency(robot.latency if self.latency is None else self.latency))
        check_positive("time_step", self.time_step)
        if self.max_steps is None:
            limit = FARTHEST / (robot.max_wheel_speed * self.time_step)
            self._set("max_steps", min(round(limit), _MOST_STEPS))
        for name, check in _CHECKS.items():
            self._set(name, check(name, getattr(self, name)))
        if not self.min_goal_distance > self.goal_radius:
            raise ValueError(
                f"min_goal_distance must be above goal_radius = {self.goal_radius}, "
                f"got {self.min_goal_distance}"
            )
        if self.plan == "known" and self.memory != "map":
            raise ValueError(
                f"plan must be 'unknown' without a map (memory='map'), got {self.plan!r} with "
                f"memory={self.memory!r}"
            )
        # Collisions are checked at the end of each time step. A robot that drives no farther than
        # the collision distance in one cannot get its center into an obstacle in between.
        fastest = max(abs(robot.min_wheel_speed), abs(robot.max_wheel_speed))
        if self.time_step * fastest > self.collision_distance:
            raise ValueError(
                f"time_step must be at most {self.collision_distance / fastest:.4g} s, in which "
                f"{robot.name!r} drives no farther than collision_distance = "
                f"{self.collision_distance:g} m at its fastest, got {self.time_step}"
            )
        self._set("lidar", self._read_lidar())
        self._set("sensors", resolve_sensors(self.sensors))
        if isinstance(self.reward, str):
            self._set("reward", named_reward(self.reward))
        # Building these checks the fields that they are made from.
        _ = self.reward_function, self.observation_slices

    @property
    def collision_distance(self) -> float:
        """Distance of the robot's center from an obstacle or wall that is a collision [m]."""
        return self.robot.radius + (0.0 if self.contact else self.clearance)

    @property
    def action_time(self) -> float:
        """Time for which an action is held [s]."""
        return self.time_step * self.action_repeat

    def _set(self, name: str, value: Any) -> None:
        """Set a field of the frozen dataclass, before it is used."""
        object.__setattr__(self, name, value)

    def _read_lidar(self) -> dict[str, Any]:
        """The arguments of the lidar, with its noise."""
        if not isinstance(self.lidar, Mapping | None):
            raise ValueError(f"lidar must hold arguments of Lidar, got {self.lidar!r}")
        arguments = dict(self.lidar or {})
        if not {"field_of_view", "sectors"} & set(arguments):
            arguments = lidar_of(self.robot) | arguments
        arguments.setdefault("max_range", self.robot.lidar_range)
        for name, value in (("noise", self.noise.range_noise), ("dropout", self.noise.dropout)):
            if value > 0.0:
                if name in arguments:
                    raise ValueError(
                        f"lidar must not hold {name!r} together with noise={self.noise}"
                    )
                arguments[name] = value
        return arguments

    def make_lidar(self, world: World = _EMPTY) -> Lidar:
        """Make the lidar, in a world."""
        try:
            return Lidar(world, **self.lidar, mount=self.robot.lidar_mount[:2])
        except TypeError as error:
            raise ValueError(
                f"lidar must hold arguments of Lidar, got {self.lidar!r}: {error}"
            ) from error

    def make_filter(self, *, clearance: float = CLEARANCE, approach: float = 0.0) -> SafetyFilter:
        """Make the filter that keeps the robot off what its lidar sees.

        Args:
            clearance: Clearance of the rim to be kept [m].
            approach: Speed at which things may come, before which the robot stands [m/s].

        Raises:
            ValueError: If one is negative, or the robot cannot stop before what comes.
        """
        lidar = self.make_lidar()
        return SafetyFilter(
            self.robot,
            angles=lidar.angles,
            sectors=lidar.sectors,
            max_range=lidar.max_range,
            closeness_distance=self.closeness_distance,
            memory=self.memory,
            history=self.history,
            further=sum(sensor.width for sensor in self.sensors.values()),
            time_step=self.time_step,
            action_repeat=self.action_repeat,
            clearance=clearance,
            approach=approach,
            latency=self.latency[1],
        )

    def make_mirror(self, *, pairs: WheelPairs | None = None) -> RandomMirror:
        """Make the transform that shows a learner half of its transitions in the mirror.

        Front and rear are swapped as well if robot and lidar have them alike: wheels that are as
        fast backwards, and a whole turn of sectors around the center.

        Args:
            pairs: As for :class:`~mpfa_envs.Mirror`; with these front and rear stay.

        Raises:
            ValueError: If a pair has no mirror image among them, or the lidar is at a side.
        """
        # Most of what a task is for needs no PyTorch.
        from mpfa_envs.sensing.mirror import RandomMirror

        lidar, robot = self.make_lidar(), self.robot
        all_around = lidar.field_of_view == 360.0 and lidar.sectors % 2 == 0
        if lidar.mount[1]:
            raise ValueError(
                f"mirror must be False for {robot.name!r}, whose lidar is {lidar.mount[1]:g} m to "
                "the left of its axis (lidar_mount): left and right differ"
            )
        alike = all_around and robot.reverse and robot.min_wheel_speed == -robot.max_wheel_speed
        alike = alike and not lidar.mount[0] and not self.sensors
        further: list[int] = []
        for name, sensor in self.sensors.items():
            if sensor.mirrored is None:
                raise ValueError(
                    f"mirror must be False with the sensor {name!r}, which has no mirror image"
                )
            further += [len(further) + place for place in sensor.mirrored]
        return RandomMirror(
            sectors=lidar.sectors,
            memory=self.memory,
            history=self.history,
            pairs=pairs,
            front_rear=alike and pairs is None,
            further=further,
        )

    def make_noise(self, robots: int) -> NoisyMotion | None:
        """Make the errors of some robots' motion, if there are any."""
        if not self.noise.is_in_motion:
            return None
        base, step = self.robot.wheel_base, self.time_step
        return NoisyMotion(self.noise, robots, wheel_base=base, time_step=step)

    def make_orders(self, robots: int) -> LateOrders | None:
        """Make the orders under way to some robots, if they are late."""
        if round(self.latency[1] / self.time_step) == 0:
            return None
        step = self.time_step
        return LateOrders(self.robot, robots, latency=self.latency, time_step=step)

    @cached_property
    def reward_function(self) -> RewardFunction:
        """The reward of a time step: the user's, or Eq. (25)."""
        progress, scale = self.progress, self.progress_scale
        return resolve_reward(self.reward, progress=progress, progress_scale=scale)

    @cached_property
    def observation_slices(self) -> Mapping[str, slice]:
        """The parts of an observation by name."""
        sectors = self.make_lidar().sectors
        parts = observation_slices(sectors, memory=self.memory, history=self.history)
        for name, sensor in self.sensors.items():
            if name in parts:
                raise ValueError(f"sensors must have names of their own, got {name!r}")
            last = max(part.stop for part in parts.values())
            parts[name] = slice(last, last + sensor.width)
        return parts

    def make_spaces(self, diagonal: float) -> tuple[BoxSpace[np.float32], BoxSpace[np.float32]]:
        """Make the spaces of one robot's observations and actions in worlds of a diagonal [m]."""
        sectors = self.make_lidar().sectors
        low, high = observation_bounds(sectors, diagonal, memory=self.memory, history=self.history)
        for sensor in self.sensors.values():
            ends = np.full((2, sensor.width), np.reshape(sensor.bounds, (2, 1)), dtype=np.float32)
            low, high = np.append(low, ends[0]), np.append(high, ends[1])
        return BoxSpace(low, high, dtype=np.float32), BoxSpace(-1.0, 1.0, (2,), np.float32)

    def describe(self) -> dict[str, Any]:
        """Plain values by name: the settings that saved states must share."""
        described = {
            each.name: getattr(self, each.name)
            for each in fields(self)
            if each.name not in _DESCRIBED
        }
        described["collision_distance"] = self.collision_distance
        robot = asdict(self.robot)
        described["robot"] = robot.pop("name")
        described.update(
            # The lidar is described below, as the task has it.
            (f"robot.{name}", None if value is None else float(value))
            for name, value in robot.items()
            if not name.startswith("lidar_") and name != "latency"
        )
        described["latency"] = list(self.latency) if self.latency[1] > 0.0 else None
        described["noise"] = None if self.noise == RobotNoise() else asdict(self.noise)
        described["sensors"] = describe_sensors(self.sensors)
        described["reward"] = "a function of your own"
        if payments := payments_of(self.reward_function):
            described["reward"] = "navigation_reward"
            described.update(zip(_PAYMENTS, payments, strict=True))
        lidar = self.make_lidar()
        described.update(rays=lidar.angles.size, sectors=lidar.sectors)
        described["lidar.mount"] = list(lidar.mount)
        return described | {f"lidar.{name}": getattr(lidar, name) for name in _OF_THE_LIDAR}


def _read_latency(value: Any) -> tuple[float, float]:
    """Read a latency, or the least and the greatest [s]."""
    try:
        low, high = value if isinstance(value, Sequence) else (value, value)
        found = check_number("latency", low), check_number("latency", high)
    except (TypeError, ValueError):
        found = (-1.0, -1.0)
    if not 0.0 <= found[0] <= found[1] <= _MOST_LATENCY:
        raise ValueError(
            f"latency must be seconds in [0, {_MOST_LATENCY:g}], or the least and the greatest, "
            f"got {value!r}"
        )
    return found


def check_names(task: Mapping[str, Any], others: Iterable[str]) -> None:
    """Raise if an argument is neither a field of the task nor one of the others."""
    own = {each.name for each in fields(TaskConfig)}
    for name in task.keys() - own:
        said = _DERIVED.get(name) or did_you_mean(name, [*own, *others])
        hint = f": {said}" if said else ""
        # In Python's words, by which TorchRL knows that an environment takes no `frameskip`.
        raise TypeError(f"got an unexpected keyword argument {name!r}{hint}")
