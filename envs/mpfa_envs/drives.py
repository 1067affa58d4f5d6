"""Two ways to move a robot by its wheel speeds: exact kinematics, or PyBullet's physics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

if TYPE_CHECKING:
    from mpfa_envs.robot import RobotModel
    from mpfa_envs.simulation import Simulation
    from mpfa_envs.worlds import World


SUBSTEP: Final = 1 / 30
"""Duration of a step of the physics engine [s].

The wheels keep their speeds as exactly at 30 Hz as at 240 Hz; at 20 Hz they do not.
"""


class Motion(NamedTuple):
    """Where the robot is and how it moves."""

    x: float
    """Position [m]."""
    y: float
    """Position [m]."""
    heading: float
    """Direction of the front, from the x axis to the left, in [-π, π] [rad]."""
    linear_speed: float
    """Forward speed [m/s]."""
    angular_speed: float
    """Turning speed, to the left [rad/s]."""


class Drive(Protocol):
    """What :class:`~mpfa_envs.NavigationEnv` needs of a way to move."""

    def place(self, x: float, y: float, heading: float) -> Motion:
        """Put the robot at rest at a pose [m, m, rad]."""
        ...

    def move(self, left: float, right: float) -> Motion:
        """Hold the wheel speeds [m/s] for one time step."""
        ...

    def close(self) -> None:
        """Release what the drive holds."""
        ...


class KinematicDrive:
    """Moves on exact arcs: the wheels have their speed at once and never slip.

    Args:
        robot: The robot.
        time_step: Duration of a step [s].

    Examples:
        >>> from mpfa_envs import ROBOTS
        >>> from mpfa_envs.drives import KinematicDrive
        >>> drive = KinematicDrive(ROBOTS["turtlebot2"], time_step=0.1)
        >>> _ = drive.place(0.0, 0.0, 0.0)
        >>> drive.move(0.5, 0.5).x
        0.05
    """

    def __init__(self, robot: RobotModel, *, time_step: float) -> None:
        self._wheel_base = robot.wheel_base
        self._time_step = time_step
        self._pose = (0.0, 0.0, 0.0)

    def place(self, x: float, y: float, heading: float) -> Motion:
        """Put the robot at rest at a pose [m, m, rad]."""
        heading = math.remainder(heading, math.tau)
        self._pose = x, y, heading
        return Motion(x, y, heading, 0.0, 0.0)

    def move(self, left: float, right: float) -> Motion:
        """Hold the wheel speeds [m/s] for one time step."""
        x, y, heading = self._pose
        speed = 0.5 * (left + right)
        turn = (right - left) / self._wheel_base
        # Along a chord of the arc: its direction is halfway between the two headings, and
        # sin(half) / half is its length over the arc's.
        half = 0.5 * turn * self._time_step
        chord = speed * self._time_step * (math.sin(half) / half if half else 1.0)
        x += chord * math.cos(heading + half)
        y += chord * math.sin(heading + half)
        heading = math.remainder(heading + 2 * half, math.tau)
        self._pose = x, y, heading
        return Motion(x, y, heading, speed, turn)

    def close(self) -> None:
        """Nothing is held."""


class WheelDrive:
    """Moves by PyBullet: motors turn the wheels, friction moves the robot.

    Args:
        robot: The robot.
        world: The room it drives in.
        time_step: Duration of a step [s].
        substep: Duration of a step of the physics engine [s], rounded to divide the time step.

    Examples:
        >>> from mpfa_envs import ROBOTS, WORLDS
        >>> from mpfa_envs.drives import WheelDrive
        >>> drive = WheelDrive(ROBOTS["turtlebot2"], WORLDS["A"], time_step=0.1)
        >>> _ = drive.place(0.0, 0.0, 0.0)
        >>> for _ in range(20):
        ...     motion = drive.move(0.5, 0.5)
        >>> round(motion.linear_speed, 2)
        0.5
        >>> drive.close()
    """

    def __init__(
        self, robot: RobotModel, world: World, *, time_step: float, substep: float = SUBSTEP
    ) -> None:
        # Imported here so that kinematic environments run without PyBullet, which also greets
        # the terminal whenever it is imported.
        from mpfa_envs.simulation import Simulation

        self._wheel_radius = robot.wheel_radius
        self.simulation = Simulation(time_step=time_step, substeps=substeps(time_step, substep))
        self.simulation.add_world(world)
        self.simulation.add_robot(robot)

    def place(self, x: float, y: float, heading: float) -> Motion:
        """Put the robot at rest at a pose [m, m, rad]."""
        self.simulation.place_robot(x, y, heading)
        return Motion(x, y, math.remainder(heading, math.tau), 0.0, 0.0)

    def move(self, left: float, right: float) -> Motion:
        """Hold the wheel speeds [m/s] for one time step."""
        self.simulation.set_wheel_speeds(left / self._wheel_radius, right / self._wheel_radius)
        self.simulation.step()
        return read_motion(self.simulation)

    def close(self) -> None:
        """Shut the physics server down; a second call does nothing."""
        self.simulation.close()


def substeps(time_step: float, substep: float = SUBSTEP) -> int:
    """Count the steps of the physics engine in a time step [s]."""
    return max(1, round(time_step / substep))


def read_motion(simulation: Simulation, name: str = "robot") -> Motion:
    """Read the motion of a simulated robot.

    Args:
        simulation: The physics server.
        name: Name of the body.

    Returns:
        Its motion.
    """
    x, y, heading, speed_x, speed_y, turn = simulation.robot_motion(name)
    speed = speed_x * math.cos(heading) + speed_y * math.sin(heading)
    return Motion(x, y, heading, speed, turn)
