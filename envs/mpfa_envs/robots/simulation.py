"""The only file that calls PyBullet: one physics server with named bodies."""

from __future__ import annotations

import math
import platform
import tempfile
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

try:
    import pybullet
except ImportError as error:
    raise ImportError(
        "physics='wheels' needs PyBullet, which has wheels for Python 3.11 and earlier only, and "
        f"this is Python {platform.python_version()}: use physics='kinematic', which needs no "
        "PyBullet, or Python 3.11 and pip install 'torchrl-mpfa[envs]'"
    ) from error

from mpfa_envs.checks import check_count, check_positive

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.worlds.shapes import Point
    from mpfa_envs.worlds.world import World

_ROBOTS = 64
"""Group of the robots of a server; the engine itself uses the lower bits."""
_WALL_HEIGHT = 1.0
_WALL_THICKNESS = 0.2
_MOTOR_TORQUE = 3.0
"""Torque of a wheel's motor [N m]: enough to reach a commanded speed within a step."""


class Simulation:
    """A PyBullet server of its own, without a window, in which bodies have names.

    Several of them live in one process without knowing of each other.

    Args:
        time_step: Duration of a step of the simulation [s].
        substeps: Steps of the physics engine in it.

    Raises:
        ValueError: If one of them is not positive.

    Examples:
        >>> from mpfa_envs import ROBOTS, WORLDS
        >>> from mpfa_envs.robots.simulation import Simulation
        >>> simulation = Simulation(time_step=0.02)
        >>> simulation.add_world(WORLDS["B"])
        >>> simulation.add_robot(ROBOTS["turtlebot2"])
        >>> simulation.place_robot(0.0, 0.0, 0.0)
        >>> simulation.set_wheel_speeds(10.0, 10.0)
        >>> simulation.step(50)
        >>> simulation.robot_motion()[0] > 0.3  # [m]
        True
        >>> simulation.close()
    """

    def __init__(self, *, time_step: float, substeps: int = 1) -> None:
        self.time_step = check_positive("time_step", time_step)
        self.substeps = check_count("substeps", substeps)
        self.bodies: dict[str, int] = {}
        """Names of the bodies and the engine's numbers for them."""
        self._client: int = pybullet.connect(pybullet.DIRECT)
        # A server takes 34 MB: one whose owner was dropped without close() must go as well.
        self._release = weakref.finalize(self, _disconnect, self._client)
        self._wheels: dict[str, list[int]] = {}
        self._rest_height = 0.0
        self._configure()
        self._add_plane()

    def _configure(self) -> None:
        pybullet.setGravity(0, 0, -9.81, physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.time_step,
            numSubSteps=self.substeps,
            # The solver stops once an iteration changes next to nothing: 1.6 times faster than
            # always doing 50, at an error of 0.5 % of the slowest speed.
            numSolverIterations=50,
            solverResidualThreshold=1e-4,
            # The order of contacts, and so the last bits, must not depend on earlier episodes.
            deterministicOverlappingPairs=1,
            # Robots that do not touch are solved apart, so that none depends on what others do.
            minimumSolverIslandSize=1,
            physicsClientId=self._client,
        )

    def __reduce__(self) -> NoReturn:
        """Refuse to be copied or pickled: a copy would have the same server and robots."""
        raise TypeError(
            "physics='wheels' cannot be copied or pickled, as its robots are in a physics server: "
            "make another environment with the same arguments and, of a VectorNavigationEnv, load "
            "its state_dict() there with load_state_dict(); physics='kinematic' can be copied"
        )

    @property
    def client(self) -> int:
        """PyBullet's number for this server; -1 once it is closed."""
        return self._client

    @property
    def is_connected(self) -> bool:
        """Whether the server lives."""
        return self._client >= 0 and bool(pybullet.isConnected(physicsClientId=self._client))

    def _add_plane(self) -> None:
        plane = pybullet.createCollisionShape(
            pybullet.GEOM_PLANE, planeNormal=[0, 0, 1], physicsClientId=self._client
        )
        self.bodies["floor"] = pybullet.createMultiBody(
            baseCollisionShapeIndex=plane, physicsClientId=self._client
        )
        pybullet.changeDynamics(
            self.bodies["floor"], -1, lateralFriction=1.0, physicsClientId=self._client
        )

    def add_box(
        self, name: str, *, x_min: float, y_min: float, x_max: float, y_max: float, height: float
    ) -> None:
        """Put a fixed box on the floor.

        Args:
            name: Name of the body.
            x_min: Left edge [m].
            y_min: Lower edge [m].
            x_max: Right edge [m].
            y_max: Upper edge [m].
            height: Height [m].
        """
        halves = [(x_max - x_min) / 2, (y_max - y_min) / 2, height / 2]
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=halves, physicsClientId=self._client
        )
        self._add_fixed(name, shape, (x_min + x_max) / 2, (y_min + y_max) / 2, height / 2)

    def add_cylinder(self, name: str, *, x: float, y: float, radius: float, height: float) -> None:
        """Put a fixed upright cylinder on the floor.

        Args:
            name: Name of the body.
            x: Center [m].
            y: Center [m].
            radius: Radius [m].
            height: Height [m].
        """
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=radius, height=height, physicsClientId=self._client
        )
        self._add_fixed(name, shape, x, y, height / 2)

    def add_prism(self, name: str, vertices: Sequence[Point], *, height: float) -> None:
        """Put a fixed upright prism with a convex footprint on the floor.

        Args:
            name: Name of the body.
            vertices: Corners of the footprint (x, y) [m].
            height: Height [m].
        """
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=[[x, y, z] for z in (-height / 2, height / 2) for x, y in vertices],
            physicsClientId=self._client,
        )
        self._add_fixed(name, shape, 0.0, 0.0, height / 2)

    def _add_fixed(self, name: str, shape: int, x: float, y: float, z: float) -> None:
        if name in self.bodies:
            raise ValueError(f"name must be new, got {name!r}")
        self.bodies[name] = pybullet.createMultiBody(
            baseMass=0,
            baseCollisionShapeIndex=shape,
            basePosition=[x, y, z],
            physicsClientId=self._client,
        )

    def add_world(self, world: World) -> None:
        """Build the walls and the obstacles of a world.

        Args:
            world: The room; bodies are named ``wall_0``, ``box_0``, ``cylinder_0``, ``polygon_0``
                and so on. A polygon with dents is built of the parts ``polygon_0_0`` to the last.
        """
        room, thick = world.room, _WALL_THICKNESS
        low_x, low_y = room.x_min - thick, room.y_min - thick
        high_x, high_y = room.x_max + thick, room.y_max + thick
        edges = [
            (low_x, low_y, room.x_min, high_y),
            (room.x_max, low_y, high_x, high_y),
            (room.x_min, low_y, room.x_max, room.y_min),
            (room.x_min, room.y_max, room.x_max, high_y),
        ]
        edges += [(box.x_min, box.y_min, box.x_max, box.y_max) for box in world.boxes]
        for index, (x_min, y_min, x_max, y_max) in enumerate(edges):
            self.add_box(
                f"wall_{index}" if index < 4 else f"box_{index - 4}",
                x_min=x_min,
                y_min=y_min,
                x_max=x_max,
                y_max=y_max,
                height=_WALL_HEIGHT,
            )
        for index, cylinder in enumerate(world.cylinders):
            self.add_cylinder(
                f"cylinder_{index}",
                x=cylinder.x,
                y=cylinder.y,
                radius=cylinder.radius,
                height=_WALL_HEIGHT,
            )
        for index, polygon in enumerate(world.polygons):
            parts = polygon.convex_parts
            for number, part in enumerate(parts):
                name = f"polygon_{index}" + (f"_{number}" if len(parts) > 1 else "")
                self.add_prism(name, part, height=_WALL_HEIGHT)

    def add_robot(self, robot: RobotModel, *, name: str = "robot") -> None:
        """Load a robot from its URDF. Several of them pass through each other.

        Args:
            robot: The robot.
            name: Name of the body.

        Raises:
            ValueError: If there is a body of that name.
        """
        if name in self.bodies:
            raise ValueError(f"name must be new, got {name!r}")
        # The engine reads URDF from files only.
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot.urdf(), encoding="utf-8")
            body = pybullet.loadURDF(
                str(path),
                # Without it the engine guesses moments of inertia from the shapes.
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=self._client,
            )
        self.bodies[name] = body
        # The engine's position of a body is its center of mass.
        dynamics = pybullet.getDynamicsInfo(body, -1, physicsClientId=self._client)
        self._rest_height = dynamics[3][2]
        links: dict[str, int] = {"base": -1}
        for joint in range(pybullet.getNumJoints(body, physicsClientId=self._client)):
            info = pybullet.getJointInfo(body, joint, physicsClientId=self._client)
            links[info[12].decode()] = joint
        self._wheels[name] = [links["left_wheel"], links["right_wheel"]]
        if len(self._wheels) > 1:
            self._part_robots(links.values())
        for part, link in links.items():
            pybullet.changeDynamics(
                body,
                link,
                # The casters slide; the wheels alone hold the ground.
                lateralFriction=1.0 if part.endswith("wheel") else 0.0,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                # A robot that fell asleep would wake up a step late.
                activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
                physicsClientId=self._client,
            )

    def _part_robots(self, links: Iterable[int]) -> None:
        """Let robots touch everything but each other."""
        for robot in self._wheels:
            for link in links:
                pybullet.setCollisionFilterGroupMask(
                    self.bodies[robot], link, _ROBOTS, ~_ROBOTS, physicsClientId=self._client
                )

    def place_robot(self, x: float, y: float, heading: float, *, name: str = "robot") -> None:
        """Put a robot at rest on the floor, as if nothing had happened before.

        Args:
            x: Position [m].
            y: Position [m].
            heading: Direction of the front [rad].
            name: Name of the body.
        """
        body, client = self.bodies[name], self._client
        for wheel in self._wheels[name]:
            pybullet.resetJointState(body, wheel, 0.0, 0.0, physicsClientId=client)
        pybullet.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=client)
        half = heading / 2
        turned = [0.0, 0.0, math.sin(half), math.cos(half)]
        # Contacts outlive a move to another place. High above the floor the engine drops them.
        for height in (100.0, self._rest_height):
            place = [x, y, height]
            pybullet.resetBasePositionAndOrientation(body, place, turned, physicsClientId=client)
            pybullet.performCollisionDetection(physicsClientId=client)
        self.set_wheel_speeds(0.0, 0.0, name=name)

    def set_wheel_speeds(self, left: float, right: float, *, name: str = "robot") -> None:
        """Command the motors.

        Args:
            left: Speed of the left wheel, forward is positive [rad/s].
            right: Speed of the right wheel [rad/s].
            name: Name of the body.
        """
        pybullet.setJointMotorControlArray(
            self.bodies[name],
            self._wheels[name],
            pybullet.VELOCITY_CONTROL,
            targetVelocities=[left, right],
            forces=[_MOTOR_TORQUE, _MOTOR_TORQUE],
            physicsClientId=self._client,
        )

    def step(self, count: int = 1) -> None:
        """Advance the physics.

        Args:
            count: Number of time steps.
        """
        for _ in range(count):
            pybullet.stepSimulation(physicsClientId=self._client)

    def robot_motion(self, name: str = "robot") -> tuple[float, float, float, float, float, float]:
        """Read where a robot is and how it moves.

        Args:
            name: Name of the body.

        Returns:
            ``(x, y, heading, speed in x, speed in y, turning speed)`` [m, m, rad, m/s, m/s, rad/s].
        """
        body, client = self.bodies[name], self._client
        (x, y, _), (qx, qy, qz, qw) = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=client
        )
        (vx, vy, _), (_, _, turn) = pybullet.getBaseVelocity(body, physicsClientId=client)
        heading = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        return x, y, heading, vx, vy, turn

    def cast_rays(
        self,
        origin: tuple[float, float],
        angles: NDArray[np.float64],
        *,
        height: float,
        reach: float,
    ) -> NDArray[np.float64]:
        """Measure ranges with the engine's own ray test, the check of :class:`~mpfa_envs.Lidar`.

        Args:
            origin: Position of the sensor (x, y) [m].
            angles: Directions of the rays in the room [rad], shape ``[rays]``.
            height: Height of the sensor [m].
            reach: Longest range [m].

        Returns:
            Ranges [m], shape ``[rays]``.
        """
        start = np.tile([*origin, height], (len(angles), 1))
        end = start.copy()
        end[:, 0] += reach * np.cos(angles)
        end[:, 1] += reach * np.sin(angles)
        hits: Any = pybullet.rayTestBatch(start, end, physicsClientId=self._client)
        return np.array([hit[2] for hit in hits]) * reach

    def close(self) -> None:
        """Shut the server down; a second call does nothing."""
        self._release()
        self._client = -1


def _disconnect(client: int) -> None:
    """Shut a server down, if it lives."""
    if pybullet.isConnected(physicsClientId=client):
        pybullet.disconnect(physicsClientId=client)
