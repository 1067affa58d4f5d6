"""Real nodes in this process, on real rclpy: what stands around the policy's node."""

from __future__ import annotations

import gc
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float64MultiArray

from mpfa_envs.ros.messages import write_pose


def choose_domain() -> None:
    """Keep to this machine, in a domain of this process."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Tests kill nodes. What a killed process leaves in Fast DDS's shared memory can end others.
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)


class Surroundings:
    """A base and a lidar in a hall, and a program that sends goals."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("surroundings")
        self.pose, self.speeds = [0.0, 0.0, 0.0], (0.0, 0.0)
        self.sees = True
        self.sent: list[tuple[float, float]] = []
        self.times: list[float] = []
        """When the orders came [s]."""
        self.spoils: Callable[[Any, Any], None] = lambda scan, odometry: None
        """Changes messages before they are published."""
        self.statuses: list[dict[str, str]] = []
        self.feedbacks: list[list[float]] = []
        publish, hear = self.node.create_publisher, self.node.create_subscription
        self.goals = publish(PoseStamped, "goal_pose", 1)
        self._scans = publish(LaserScan, "scan", qos_profile_sensor_data)
        self._odometry = publish(Odometry, "odom", 10)
        hear(Twist, "cmd_vel", self._on_command, 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        hear(DiagnosticStatus, "mpfa_policy/status", self._on_status, latched)
        hear(Float64MultiArray, "mpfa_policy/feedback", self._on_feedback, 10)
        self._period, self._timer = 0.0, None
        self.scan_every(0.05)

    @property
    def states(self) -> list[str]:
        """The states of the goal, without repetitions."""
        states = [status["state"] for status in self.statuses]
        return [state for i, state in enumerate(states) if not i or state != states[i - 1]]

    def scan_every(self, period: float) -> None:
        """Change the period of scans and odometry [s]."""
        if self._timer is not None:
            self.node.destroy_timer(self._timer)
        self._period, self._timer = period, self.node.create_timer(period, self.publish)

    def publish(self) -> None:
        """Move as ordered, and publish what is measured."""
        linear, angular = self.speeds
        self.pose[0] += self._period * linear * math.cos(self.pose[2])
        self.pose[1] += self._period * linear * math.sin(self.pose[2])
        self.pose[2] = math.remainder(self.pose[2] + self._period * angular, math.tau)
        now = self.node.get_clock().now()
        felt = Odometry()
        felt.header.stamp, felt.header.frame_id = now.to_msg(), "odom"
        write_pose(felt.pose.pose, (self.pose[0], self.pose[1], self.pose[2]))
        felt.twist.twist.linear.x, felt.twist.twist.angular.z = self.speeds
        seen = LaserScan(angle_min=-math.pi, angle_increment=math.pi / 180, range_max=8.0)
        seen.angle_max = math.pi - math.pi / 180
        # No two scans of a robot that moves are alike.
        free = 6.0 + 0.1 * math.sin(10.0 * self.pose[0])
        seen.header.stamp, seen.ranges = now.to_msg(), [free] * 360
        self.spoils(seen, felt)
        self._odometry.publish(felt)
        if self.sees:
            self._scans.publish(seen)

    def aim(self, x: float, y: float = 0.0, frame: str = "odom") -> None:
        """Send a goal."""
        message = PoseStamped()
        message.header.frame_id = frame
        write_pose(message.pose, (x, y, 0.0))
        self.goals.publish(message)

    def _on_command(self, message: Any) -> None:
        self.speeds = message.linear.x, message.angular.z
        self.sent.append(self.speeds)
        self.times.append(time.monotonic())

    def _on_status(self, message: Any) -> None:
        self.statuses.append({each.key: each.value for each in message.values})

    def _on_feedback(self, message: Any) -> None:
        self.feedbacks.append(list(message.data))


class Live:
    """The policy's node, its surroundings, and the executor of both."""

    def __init__(self, make: Callable[[], Any] | None) -> None:
        self.around = Surroundings()
        self.node = None if make is None else make()
        self.executor = SingleThreadedExecutor()
        for node in filter(None, (self.around.node, self.node)):
            self.executor.add_node(node)

    def until(self, holds: Callable[[], Any], timeout: float = 60.0) -> bool:
        """Wait until something holds, or for so many seconds."""
        end = time.monotonic() + timeout
        while not holds() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)
        return bool(holds())

    def stands_after(self, moment: float) -> float:
        """Time from a moment [s] to the first order to stand after it [s]; waits for that."""
        around = self.around

        def first() -> float | None:
            orders = zip(around.times, around.sent, strict=True)
            return next((t for t, speeds in orders if t > moment and speeds == (0.0, 0.0)), None)

        assert self.until(lambda: first() is not None)
        return (first() or math.inf) - moment

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service."""
        client = self.around.node.create_client(kind, name)
        assert self.until(client.service_is_ready)
        future = client.call_async(request)
        assert self.until(future.done)
        self.around.node.destroy_client(client)
        return future.result()


@contextmanager
def live(make: Callable[..., Any] | None, **parameters: Any) -> Iterator[Live]:
    """A node with parameters, or None, and what stands around it."""
    choose_domain()
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    rclpy.init(args=["--ros-args", *words] if words else None)
    made = Live(make)
    try:
        yield made
    finally:
        made.executor.shutdown()
        if made.node is not None:
            made.node.destroy_node()
        made.around.node.destroy_node()
        rclpy.shutdown()
        # The services of a life cycle are on the network until their node is collected.
        made.node = None
        gc.collect()


def parameter(name: str, value: Any) -> Any:
    """A parameter as a message."""
    return Parameter(name, value=value).to_parameter_msg()
