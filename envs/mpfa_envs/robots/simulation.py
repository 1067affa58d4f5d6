"""Robots in a physics server; the only file that calls PyBullet."""

from __future__ import annotations

import math
import platform
import tempfile
import weakref
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

try:
    import pybullet
except ImportError as error:
    raise ImportError(
        "physics='wheels' needs PyBullet, which has wheels for Python 3.11 and earlier only, and "
        f"this is Python {platform.python_version()}: use physics='kinematic', which needs no "
        "PyBullet, or on Python 3.11 install the extra 'envs', see Install in the README"
    ) from error

if TYPE_CHECKING:
    from mpfa_envs.robots.model import RobotModel

_ROBOTS = 64
"""Group of the robots of a server; the engine itself uses the lower bits."""
_MOTOR_TORQUE = 3.0
"""Torque of a wheel's motor [N m]: enough to reach a commanded speed within a step."""


class Simulation:
    """A PyBullet server with a floor and named robots, independent of other servers."""

    def __init__(
        self,
        *,
        time_step: float,  # [s]
        substeps: int = 1,  # Steps of the engine in one of ours.
    ) -> None:
        self.bodies: dict[str, int] = {}
        """Names of the bodies and the engine's numbers for them."""
        self._server = _Server()
        self._wheels: dict[str, list[int]] = {}
        self._rest_height = 0.0
        server = self._server
        server.setGravity(0, 0, -9.81)
        server.setPhysicsEngineParameter(
            fixedTimeStep=time_step,
            numSubSteps=substeps,
            # The solver stops once an iteration changes next to nothing: 1.6 times faster than
            # always doing 50, at an error of 0.5 % of the slowest speed.
            numSolverIterations=50,
            solverResidualThreshold=1e-4,
            # The order of contacts, and so the last bits, must not depend on earlier episodes.
            deterministicOverlappingPairs=1,
            # Robots that do not touch are solved apart, so that none depends on what others do.
            minimumSolverIslandSize=1,
        )
        plane = server.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=[0, 0, 1])
        self.bodies["floor"] = server.createMultiBody(baseCollisionShapeIndex=plane)
        server.changeDynamics(self.bodies["floor"], -1, lateralFriction=1.0)

    def __reduce__(self) -> NoReturn:
        """Reject copies and pickles: a copy would have the same server and robots."""
        raise TypeError(
            "physics='wheels' cannot be copied or pickled, as its robots are in a physics server: "
            "make another environment with the same arguments and, of a VectorNavigationEnv, load "
            "its state_dict() there with load_state_dict(); physics='kinematic' can be copied"
        )

    @property
    def client(self) -> int:
        """PyBullet's number of this server; -1 once it is closed."""
        return self._server.number if self._server.close.alive else -1

    def add_robot(self, robot: RobotModel, *, name: str = "robot") -> None:
        """Load a robot from its URDF. Several of them pass through each other."""
        server = self._server
        # The engine reads URDF from files only.
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot.urdf(), encoding="utf-8")
            # Without the flag the engine guesses moments of inertia from the shapes.
            body = server.loadURDF(str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
        self.bodies[name] = body
        # The engine's position of a body is its center of mass.
        self._rest_height = server.getDynamicsInfo(body, -1)[3][2]
        links: dict[str, int] = {"base": -1}
        for joint in range(server.getNumJoints(body)):
            links[server.getJointInfo(body, joint)[12].decode()] = joint
        self._wheels[name] = [links["left_wheel"], links["right_wheel"]]
        if len(self._wheels) > 1:
            # Robots touch everything but each other.
            for other in self._wheels:
                for link in links.values():
                    server.setCollisionFilterGroupMask(self.bodies[other], link, _ROBOTS, ~_ROBOTS)
        # Friction has a separate call: with damping the engine gives that of a link to the base
        # (https://github.com/bulletphysics/bullet3/issues/3314).
        server.changeDynamics(
            body,
            -1,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            # A robot that fell asleep would wake up a step late.
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        for part, link in links.items():
            # The casters slide; the wheels alone hold the ground.
            friction = 1.0 if part.endswith("wheel") else 0.0
            server.changeDynamics(body, link, lateralFriction=friction)

    def place_robot(self, x: float, y: float, heading: float, *, name: str = "robot") -> None:
        """Put a robot at rest at a pose [m, m, rad], without any trace of earlier motion."""
        body, server = self.bodies[name], self._server
        for wheel in self._wheels[name]:
            server.resetJointState(body, wheel, 0.0, 0.0)
        server.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0])
        turned = [0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)]
        # Contacts outlive a move to another place. High above the floor the engine drops them.
        for height in (100.0, self._rest_height):
            server.resetBasePositionAndOrientation(body, [x, y, height], turned)
            server.performCollisionDetection()
        self.set_wheel_speeds(0.0, 0.0, name=name)

    def set_wheel_speeds(self, left: float, right: float, *, name: str = "robot") -> None:
        """Command the motors; forward is positive [rad/s]."""
        self._server.setJointMotorControlArray(
            self.bodies[name],
            self._wheels[name],
            pybullet.VELOCITY_CONTROL,
            targetVelocities=[left, right],
            forces=[_MOTOR_TORQUE, _MOTOR_TORQUE],
        )

    def step(self, count: int = 1) -> None:
        """Advance the physics by a number of time steps."""
        for _ in range(count):
            self._server.stepSimulation()

    def robot_motion(self, name: str = "robot") -> tuple[float, float, float, float, float, float]:
        """Pose (x, y, heading) [m, m, rad] and speeds in x, in y and turning [m/s, rad/s]."""
        body = self.bodies[name]
        (x, y, _), (qx, qy, qz, qw) = self._server.getBasePositionAndOrientation(body)
        (vx, vy, _), (_, _, turn) = self._server.getBaseVelocity(body)
        heading = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        return x, y, heading, vx, vy, turn

    def close(self) -> None:
        """Shut the server down; a second call does nothing."""
        self._server.close()


class _Server:
    """A new PyBullet server, and PyBullet's functions bound to it."""

    def __init__(self) -> None:
        self.number: int = pybullet.connect(pybullet.DIRECT)
        # A server takes 34 MB: one whose owner was dropped without close() must go as well.
        self.close = weakref.finalize(self, _disconnect, self.number)

    def __getattr__(self, name: str) -> Any:
        bound = partial(getattr(pybullet, name), physicsClientId=self.number)
        setattr(self, name, bound)  # Found at once the next time.
        return bound


def _disconnect(number: int) -> None:
    """Shut a server down, if it lives."""
    if pybullet.isConnected(physicsClientId=number):
        pybullet.disconnect(physicsClientId=number)
