"""The ROS 2 node of a policy: messages in and out, all else is in :class:`Controller`."""

from __future__ import annotations

import math
import signal
from contextlib import suppress
from functools import partial
from typing import Any, Final

import rclpy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import LaserScan

from mpfa_envs.checks import check_positive
from mpfa_envs.deploy import Pilot
from mpfa_envs.ros.controller import Controller
from mpfa_envs.ros.messages import (
    Pose,
    odometry_of,
    plan_of,
    scan_of,
    seconds,
    transformed,
    yaw,
)
from mpfa_envs.ros.rehearsal import rehearse
from mpfa_envs.worlds.world import World

PARAMETERS: Final[dict[str, Any]] = {
    "policy": "",
    "robot": "",
    "pace": 0.0,
    "mount": [0.0, 0.0, 0.0],
    "unseen": 0.0,
    "silent": "reject",
    "map_size": 40.0,
    "clearance": 0.0,
    "latency": -1.0,
    "goal_radius": 0.0,
    "goal_heading": True,
    "stop_distance": 0.05,
    "scan_timeout": 0.5,
    "odometry_timeout": 0.5,
    "transform_timeout": 1.0,
    "rate": 20.0,
    "trust_stamps": True,
    "stamped": False,
    "base_frame": "base_link",
    "scan_topic": "scan",
    "odometry_topic": "odom",
    "goal_topic": "goal_pose",
    "map_topic": "",
    "command_topic": "cmd_vel",
}
"""The parameters with their defaults; docs/robot.md explains them."""


class PolicyNode(Node):
    """Subscribes scan, odometry and goal, publishes speeds."""

    def __init__(self) -> None:
        super().__init__("mpfa_policy")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        value = self._value
        options = {name: value(name) for name in ("silent", "map_size")}
        load = partial(
            Pilot.load,
            value("policy"),
            robot=value("robot") or None,
            pace=value("pace") or None,
            mount=tuple(value("mount")) if any(value("mount")) else None,
            unseen=value("unseen") or None,
            clearance=value("clearance") or None,
            latency=None if value("latency") < 0.0 else value("latency"),
            goal_radius=value("goal_radius") or None,
            **options,
        )
        # Loops that the first decision compiled would hold up the checks for seconds.
        rehearse(load())
        pilot = load()
        rate = check_positive("rate", value("rate"))
        limits = {n: value(n) for n in ("stop_distance", "scan_timeout", "odometry_timeout")}
        self.controller = Controller(pilot, **limits, check_period=1.0 / rate)
        self._stamped = value("stamped")
        self._trust_stamps = value("trust_stamps")
        self._base_frame = value("base_frame")
        self._transform_timeout = check_positive("transform_timeout", value("transform_timeout"))
        self._odometry_frame: str | None = None
        self._goal: tuple[Pose, str] | None = None
        self._plan: tuple[World, Pose, str] | None = None
        self._turns = value("goal_heading") and pilot.turns_on_the_spot
        self._waits = ""
        self._felt, self._known_since = -math.inf, -math.inf
        self._stamp, self._stamped_at = -math.inf, -math.inf
        self._reason = ""
        self._transforms = self._listen()
        kind = TwistStamped if self._stamped else Twist
        self._commands = self.create_publisher(kind, value("command_topic"), 1)
        sensor = partial(self.create_subscription, qos_profile=qos_profile_sensor_data)
        sensor(LaserScan, value("scan_topic"), self._on_scan)
        sensor(Odometry, value("odometry_topic"), self._on_odometry)
        self.create_subscription(PoseStamped, value("goal_topic"), self._on_goal, 1)
        if topic := value("map_topic"):
            if pilot.card.memory != "map":
                raise ValueError(f"map_topic must be '' for a policy without a map, got {topic!r}")
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.create_subscription(OccupancyGrid, topic, self._on_map, latched)
        self.create_timer(1.0 / rate, self._tick)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _listen(self) -> Any:
        """The transforms between frames, where tf2 is installed."""
        try:
            from tf2_ros import Buffer, TransformListener
        except ImportError:
            return None
        buffer = Buffer()
        self._listener = TransformListener(buffer, self)
        return buffer

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _time_of(self, header: Any) -> float:
        return seconds(header.stamp) if self._trust_stamps else self._now()

    def _on_scan(self, message: Any) -> None:
        self.controller.see(scan_of(message), self._time_of(message.header))
        self._tick()

    def _on_odometry(self, message: Any) -> None:
        last, self._odometry_frame = self._odometry_frame, message.header.frame_id
        if last not in (None, self._odometry_frame) and self._goal is not None:
            self._goal, self._waits = None, ""
            there = f"from frame {last!r} to {self._odometry_frame!r}"
            self.controller.aim(None, f"odometry jumped: {there}")
        self._felt = self._time_of(message.header)
        self.controller.feel(*odometry_of(message), self._felt)

    def _on_goal(self, message: Any) -> None:
        heading = yaw(message.pose.orientation) if self._turns else math.nan
        pose = message.pose.position.x, message.pose.position.y, heading
        self._goal, self._waits = (pose, message.header.frame_id), ""
        self._stamp = self._stamped_at = -math.inf
        self.controller.aim(None)
        # Who gave the goal knew this odometry; an older one may be of before it began again.
        self._known_since = seconds(message.header.stamp) if self._trust_stamps else 0.0
        self._known_since = self._known_since or self._now()
        self._set_out()
        self._tick()

    def _on_map(self, message: Any) -> None:
        # A map that comes while the robot drives is for the next goal.
        self._plan = (*plan_of(message), message.header.frame_id)

    def _place_plan(self) -> None:
        """Give the controller the plan, where localization has it."""
        if self._plan is not None:
            plan, pose, frame = self._plan
            self.controller.know(plan, self._in_odometry(pose, frame))

    def _set_out(self) -> None:
        """Set out for the goal if its place is known; else it is tried again at each check."""
        if self._goal is None:
            return
        try:
            if self._felt < self._known_since:
                raise LookupError("there was no odometry as new as the goal yet")
            x, y, heading = self._in_odometry(*self._goal)
            self._place_plan()
            self.controller.aim((x, y), heading=None if math.isnan(heading) else heading)
        # What tf2 raises has no public base class.
        except Exception as error:
            reason = f"goal in frame {self._goal[1]!r}: {error}"
            if not self._waits:
                self.controller.aim(None, reason)
            self._waits = reason
        else:
            self._waits = ""

    def _in_odometry(self, place: Pose, frame: str) -> Pose:
        """Transform a pose of another frame into that of the odometry."""
        if frame in ("", self._odometry_frame):
            return place
        if not self._odometry_frame:
            raise LookupError("the odometry names no frame")
        if self._transforms is None:
            raise LookupError("tf2_ros is not installed")
        found = self._transforms.lookup_transform(self._odometry_frame, frame, Time())
        stamp = seconds(found.header.stamp)
        if stamp != self._stamp:
            self._stamp, self._stamped_at = stamp, self._now()
        return transformed(place, found.transform)

    def _correct(self) -> None:
        """Update goal and plan by the newest transform; an old one keeps the robot standing."""
        frames = {placed[-1] for placed in (self._goal, self._plan) if placed}
        if self._goal is None or not frames - {"", self._odometry_frame}:
            return
        try:
            x, y, heading = self._in_odometry(*self._goal)
            self._place_plan()
            self.controller.correct_goal((x, y), None if math.isnan(heading) else heading)
        # As above; a correction that fails once is made later.
        except Exception as error:
            warn = self.get_logger().warning
            warn(f"goal not corrected: {error}", throttle_duration_sec=5.0)
        age = self._now() - (self._stamp if self._trust_stamps else self._stamped_at)
        # Transforms that never change have no time.
        old = self._stamp != 0.0 and not age <= self._transform_timeout
        self.controller.hold(f"stale transform: {age:.1f} s old" if old else "")

    def _tick(self) -> None:
        try:
            self._check()
        # Whatever it is: a robot that no one checks must not drive on.
        except Exception as error:
            self.get_logger().error(f"stopped by {error!r}")
            self._goal, self._waits = None, ""
            self.controller.aim(None, "failed")
            self.stop()

    def _check(self) -> None:
        """Publish what the controller says."""
        if self._waits:
            self._set_out()
        elif self.controller.pilot.goal is None:
            self._goal = None
        else:
            self._correct()
        began = self._now()
        order = self.controller.tick(began)
        if self._now() - began > self.controller.scan_timeout:
            # What it decided by is too old by now.
            order = self.controller.tick(self._now())
        if order is None:
            return
        reason = order.reason.partition(":")[0]
        if reason != self._reason:
            self._reason = reason
            self.get_logger().info(order.reason)
        self._publish(order.linear, order.angular)

    def _publish(self, linear: float, angular: float) -> None:
        message = TwistStamped() if self._stamped else Twist()
        twist = message
        if self._stamped:
            message.header.stamp = self.get_clock().now().to_msg()
            message.header.frame_id = self._base_frame
            twist = message.twist
        twist.linear.x, twist.angular.z = float(linear), float(angular)
        self._commands.publish(message)

    def stop(self) -> None:
        """Have the robot stand still."""
        self._publish(0.0, 0.0)


def main() -> None:
    """Run the node until it is shut down."""
    # The signal handlers of rclpy would end all publishing before the robot is stopped.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hangup = getattr(signal, "SIGHUP", None)
    # A user who ignores the signal wants the node to outlive the terminal.
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        signal.signal(hangup, signal.default_int_handler)
    node = PolicyNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        # If this fails nothing can be published, and the first error must be seen.
        with suppress(Exception):
            node.stop()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
