"""Two-wheeled robots: their measures, their speeds and their URDF."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import (
    check_bool,
    check_count,
    check_meant,
    check_not_negative,
    check_number,
    check_positive,
    did_you_mean,
    keep,
)
from mpfa_envs.robots.motion_loops import WheelLimits, scale_actions

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray


TRAINING_CLEARANCE: Final = 0.07
"""Clearance of the robot's rim below which training counts a collision [m]."""
PAPER_CLEARANCE: Final = 0.17
"""Clearance of the paper, 0.35 m from the center of a TurtleBot2 [m].

A passage of 0.9 m then has 0.2 m left to drive in, and robots turn away from it.
"""

_NEAREST: Final = 0.05
"""Least distance at which ranges can be told apart [m]."""
_CHECKED: Final = ("lidar_rays", "lidar_mount", "reverse")
"""Fields with checks of their own."""
_LEVEL: Final = math.radians(10.0)
"""Greatest roll of a lidar that counts as level [rad]."""


@dataclass(frozen=True, kw_only=True)
class RobotModel:
    """A disc-shaped robot with two driven wheels on one axle through its center.

    Args:
        name: Name in error messages.
        radius: Radius of the footprint, half of its diameter: from the middle of the axle to the
            farthest point of the robot [m].
        height: Height of the body [m].
        mass: Mass of the whole robot [kg].
        wheel_base: Distance between the two wheels [m].
        wheel_radius: Radius of a wheel [m].
        min_wheel_speed: Slowest speed of a wheel over the ground [m/s].
        max_wheel_speed: Fastest speed of a wheel over the ground [m/s].
        wheel_acceleration: How fast the speed of a wheel changes [m/s²]; None: at once.
        deceleration: How fast the robot brakes, where that is slower [m/s²]: the smaller one of
            both holds for driving off and braking alike; None: as it accelerates.
        turn_limit: Fastest turn that it makes where its wheels could turn it faster [rad/s]; None:
            as they can. Both wheels then change by the same, so that the forward speed stays.
        turn_acceleration: How fast its turn changes, where its wheels could change it faster
            [rad/s²]. Its controller then limits the forward speed apart from the turn, as
            ``diff_drive_controller`` does. None: each wheel changes by itself.
        reverse: False if its controller does not let the body drive backwards; its wheels still
            turn it on the spot. Give the ``min_wheel_speed`` that this takes and no less, as a
            policy learns slowly where most actions turn it on the spot.
        field_of_view: Angle that its lidar sees, which its front halves [deg]. The default does not
            fit a robot that reverses: filter, dynamic window and pilot keep it from driving where
            it does not see. Give 360.
        lidar_rays: Rays of a scan over that angle. Training casts as many in each of the sectors
            of 10 degrees, but at most three; None: three.
        lidar_range: A ray that meets nothing within this distance reports this distance [m].
        lidar_mount: Position (x, y) of the lidar and direction of its x axis in the robot's frame
            [m, m, rad], and its roll, if it has one: 0, or ±π upside down [rad]. Rays begin
            there, within the radius. A pilot turns scans by the angles, and in training the lidar
            looks ahead.
        latency: Time from a scan to the moment at which the wheels take the order that follows from
            it [s].

    Raises:
        ValueError: If a measure is not positive, the wheels do not fit in the footprint, or the
            speeds are not ordered.

    Examples:
        >>> from mpfa_envs import RobotModel
        >>> robot = RobotModel(
        ...     name="cart", radius=0.2, height=0.1, mass=3.0, wheel_base=0.3, wheel_radius=0.04,
        ...     min_wheel_speed=0.0, max_wheel_speed=0.4,
        ... )
        >>> round(robot.max_angular_speed, 3)
        1.333
    """

    name: str
    radius: float
    height: float
    mass: float
    wheel_base: float
    wheel_radius: float
    min_wheel_speed: float
    max_wheel_speed: float
    wheel_acceleration: float | None = None
    deceleration: float | None = None
    turn_limit: float | None = None
    turn_acceleration: float | None = None
    reverse: bool = True
    field_of_view: float = 180.0
    lidar_rays: int | None = None
    lidar_range: float = 10.0
    lidar_mount: tuple[float, ...] = (0.0, 0.0, 0.0)
    latency: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"name must be a non-empty string, got {self.name!r}")
        check_bool("reverse", self.reverse)
        if self.lidar_rays is not None:
            check_count("lidar_rays", self.lidar_rays)
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            if field.name in _CHECKED or (value is None and field.default is None):
                continue
            check = {"min_wheel_speed": check_number, "latency": check_not_negative}
            check.get(field.name, check_positive)(field.name, value)
        keep(self, *(field.name for field in fields(self)[1:] if field.name not in _CHECKED[1:]))
        mount = check_mount("lidar_mount", self.lidar_mount, self.radius)
        object.__setattr__(self, "lidar_mount", mount)
        if self.wheel_base > 2 * self.radius:
            raise ValueError(
                f"wheel_base must be at most the diameter {2 * self.radius}, got {self.wheel_base}"
            )
        if 2 * self.wheel_radius > self.height:
            raise ValueError(
                f"wheel_radius must be at most half the height {self.height}, "
                f"got {self.wheel_radius}"
            )
        if self.min_wheel_speed >= self.max_wheel_speed:
            raise ValueError(
                f"min_wheel_speed must be below max_wheel_speed = {self.max_wheel_speed}, "
                f"got {self.min_wheel_speed}"
            )

    @classmethod
    def from_fields(cls, values: Mapping[str, Any]) -> RobotModel:
        """Make a robot of its fields by name, as ``dataclasses.asdict`` and policies have them.

        Args:
            values: The fields; those with a default may be left out.

        Returns:
            The robot.

        Raises:
            ValueError: If a field is unknown, missing or out of its range.
        """
        known = {field.name: field.default is MISSING for field in fields(cls)}
        for name in values:
            if name not in known:
                hint = did_you_mean(name, known) or f"known are {', '.join(known)}"
                raise ValueError(f"robot must have fields of RobotModel, got {name!r}; {hint}")
        missing = [name for name, needed in known.items() if needed and name not in values]
        if missing:
            raise ValueError(f"robot must have all its fields, got none for {', '.join(missing)}")
        return cls(**values)

    @property
    def max_angular_speed(self) -> float:
        """Fastest turn, with the wheels at both ends of their range or at its limit [rad/s]."""
        by_wheels = (self.max_wheel_speed - self.min_wheel_speed) / self.wheel_base
        return by_wheels if self.turn_limit is None else min(by_wheels, self.turn_limit)

    @property
    def can_stop(self) -> bool:
        """True if it can stand still: both wheels may have a speed of zero."""
        return self.min_wheel_speed <= 0.0 <= self.max_wheel_speed

    @property
    def lidar_to_rim(self) -> float:
        """Least distance from the lidar to the rim [m]; 0.05 m for a lidar that is nearer."""
        return max(self.radius - math.hypot(*self.lidar_mount[:2]), _NEAREST)

    @property
    def wheel_limits(self) -> WheelLimits:
        """Limits of the wheels, as compiled loops read them."""
        change = min(self.wheel_acceleration or math.inf, self.deceleration or math.inf)
        across, turning = (
            math.inf if limit is None else 0.5 * limit * self.wheel_base
            for limit in (self.turn_limit, self.turn_acceleration)
        )
        slow, fast = self.min_wheel_speed, self.max_wheel_speed
        return WheelLimits(slow, fast, across, change, turning, self.reverse)

    def wheel_speeds(self, action: NDArray[np.float32]) -> tuple[float, float]:
        """Read an action.

        Args:
            action: Left and right wheel, shape ``[2]``; -1 is the slowest, 1 the fastest speed,
                and what is beyond is clipped.

        Returns:
            Speeds of the left and the right wheel [m/s].

        Raises:
            ValueError: If the action is not two numbers.
        """
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (2,):
            raise ValueError(f"action must have shape (2,), got {values.shape}")
        speeds = np.empty((1, 2))
        if not scale_actions(values[None], self.wheel_limits, speeds):
            raise ValueError(f"action must not hold NaN, got {action!r}")
        left, right = speeds[0].tolist()
        return left, right

    def urdf(self) -> str:
        """Write the robot as URDF text made of primitives.

        A wheel *looks* like a cylinder and *touches* the ground as a sphere: PyBullet surrounds a
        cylinder with a collision margin, so that a cylinder of the same radius drives 2.6 % too
        fast, while a sphere is exact. The base slides on two spheres of its own, the casters.

        Returns:
            An URDF document with the links ``base``, ``left_wheel`` and ``right_wheel``.
        """
        # The engine makes contacts, which cost time, with a body less than 2 cm above the floor.
        clearance = self.wheel_radius
        body = self.height - clearance
        caster = 0.5 * self.wheel_radius
        wheel_mass = 0.02 * self.mass
        base_mass = self.mass - 2 * wheel_mass
        side = base_mass * (3 * self.radius**2 + body**2) / 12
        upright = base_mass * self.radius**2 / 2
        # The rotor of a geared motor, seen through the gear, outweighs the wheel. It also helps the
        # solver: with the wheel's own inertia it needs 50 iterations to agree with the motors.
        spin = 0.3 * self.mass * self.wheel_radius**2
        black, gray = '<material name="black"/>', '<material name="gray"/>'
        disc = f'<cylinder radius="{self.radius}" length="{body}"/>'
        ball = f'<sphere radius="{caster}"/>'
        middle = (0.0, 0.0, clearance + body / 2)
        # Half a millimeter above the floor, or they would carry the robot while the wheels spin.
        lift = caster + 0.0005
        front, rear = (0.8 * self.radius, 0.0, lift), (-0.8 * self.radius, 0.0, lift)
        parts = [
            f'<robot name="{_escape(self.name)}">',
            '<material name="black"><color rgba="0.08 0.08 0.09 1"/></material>',
            '<material name="gray"><color rgba="0.35 0.35 0.38 1"/></material>',
            '<link name="base">',
            _inertial(base_mass, (side, side, upright), z=clearance + body / 3),
            *(_shape("visual", disc, middle, black), _shape("collision", disc, middle)),
            *(_shape("collision", ball, front), _shape("collision", ball, rear)),
            "</link>",
        ]
        tire = f'<cylinder radius="{self.wheel_radius}" length="0.02"/>'
        for name, y in (("left_wheel", self.wheel_base / 2), ("right_wheel", -self.wheel_base / 2)):
            parts += [
                f'<link name="{name}">',
                _inertial(wheel_mass, (spin, spin, spin), z=0.0),
                _shape("visual", tire, (0.0, 0.0, 0.0), gray),
                _shape("collision", f'<sphere radius="{self.wheel_radius}"/>', (0.0, 0.0, 0.0)),
                f'</link><joint name="{name}_joint" type="continuous"><parent link="base"/>',
                f'<child link="{name}"/><origin xyz="0 {y} {self.wheel_radius}"',
                f' rpy="{-math.pi / 2} 0 0"/><axis xyz="0 0 1"/></joint>',
            ]
        return "\n".join([*parts, "</robot>"])


def check_mount(name: str, mount: Any, radius: float) -> tuple[float, ...]:
    """Check a pose (x, y, yaw) of a robot's level lidar, or one with its roll [m, m, rad, rad]."""
    try:
        found = tuple(check_number(name, value) for value in mount)
    except TypeError:
        raise ValueError(f"{name} must be a list [x, y, yaw], got {mount!r}") from None
    if len(found) not in (3, 4):
        raise ValueError(
            f"{name} must be 3 numbers, x, y [m] and yaw [rad], or 4 with a roll, got {len(found)}"
        )
    for value, quantity in zip(found, ("offset", "offset", "yaw"), strict=False):
        check_meant(name, value, quantity)
    roll = abs(found[3]) if found[3:] else 0.0
    if min(roll, abs(roll - math.pi)) > _LEVEL:
        raise ValueError(f"{name} must have a roll of 0 or π, as scans are level, got {found[3]}")
    if math.hypot(*found[:2]) > radius:
        raise ValueError(
            f"{name} must be at most the radius {radius:g} m away from the middle of the axle, got "
            f"({found[0]:g}, {found[1]:g}): the radius reaches to the farthest point of the robot, "
            "its lidar included"
        )
    return found


def _inertial(mass: float, moments: tuple[float, float, float], *, z: float) -> str:
    """Mass [kg] and principal moments of inertia [kg m²] around a height [m]."""
    ixx, iyy, izz = moments
    return (
        f'<inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _shape(use: str, geometry: str, at: tuple[float, float, float], look: str = "") -> str:
    """A ``visual`` or ``collision`` element at a position [m]."""
    x, y, z = at
    place = f'<origin xyz="{x} {y} {z}"/>'
    return f"<{use}>{place}<geometry>{geometry}</geometry>{look}</{use}>"


def _escape(text: str) -> str:
    """Escape a name for an XML attribute."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


ROBOTS: Final[Mapping[str, RobotModel]] = {
    robot.name: robot
    for robot in (
        # The paper's: a TurtleBot2 whose wheels neither stop nor reverse.
        RobotModel(
            name="turtlebot2",
            radius=0.18,
            height=0.42,
            mass=6.3,
            wheel_base=0.23,
            wheel_radius=0.035,
            min_wheel_speed=0.05,
            max_wheel_speed=0.5,
        ),
        # The same body as it is sold. Speeds: user's guide of the Kobuki; acceleration: default of
        # its velocity smoother in ROS 2, kobuki_velocity_smoother.
        RobotModel(
            name="kobuki",
            radius=0.18,
            height=0.42,
            mass=6.3,
            wheel_base=0.23,
            wheel_radius=0.035,
            min_wheel_speed=-0.7,
            max_wheel_speed=0.7,
            wheel_acceleration=0.8,
            turn_limit=math.pi,
            field_of_view=360.0,
        ),
        # Speeds: specifications of the manufacturer (ROBOTIS e-Manual); acceleration: acc_lim_x of
        # its parameters for Nav2, turtlebot3_navigation2.
        RobotModel(
            name="burger",
            radius=0.105,
            height=0.192,
            mass=1.0,
            wheel_base=0.16,
            wheel_radius=0.033,
            min_wheel_speed=-0.22,
            max_wheel_speed=0.22,
            wheel_acceleration=2.5,
            turn_limit=2.84,
            field_of_view=360.0,
        ),
        RobotModel(
            name="waffle",
            radius=0.22,
            height=0.141,
            mass=1.8,
            wheel_base=0.287,
            wheel_radius=0.033,
            min_wheel_speed=-0.26,
            max_wheel_speed=0.26,
            wheel_acceleration=2.5,
            turn_limit=1.82,
            field_of_view=360.0,
        ),
        # Speeds: TurtleBot 4 User Manual, safe mode; acceleration: default wheel_accel_limit of its
        # base, the Create 3. Its safety_override must be backup_only for it to reverse.
        RobotModel(
            name="turtlebot4",
            radius=0.175,
            height=0.351,
            mass=3.9,
            wheel_base=0.233,
            wheel_radius=0.03575,
            min_wheel_speed=-0.306,
            max_wheel_speed=0.306,
            wheel_acceleration=0.9,
            turn_limit=1.9,
            field_of_view=360.0,
        ),
    )
}
"""The robots known by name: the paper's, and some as they are sold."""
