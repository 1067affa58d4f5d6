"""The ROS 2 node of a simulated robot: messages in and out, the rest in :class:`SimulatedRobot`."""

from __future__ import annotations

from array import array
from typing import Any, Final

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool

from mpfa_envs.ros.declared import declare, value_of
from mpfa_envs.ros.messages import write_pose, yaw
from mpfa_envs.ros.simulated_robot import SimulatedRobot

PARAMETERS: Final[dict[str, Any]] = {
    "world": "test",
    "robot": "turtlebot2",
    "physics": "wheels",
    "time_step": 0.1,
    "rays": 360,
    "max_range": 10.0,
    "noise": 0.0,
    "speed": 1.0,
}
"""The parameters with their defaults; ``speed`` is simulated over real time."""


class RobotNode(Node):
    """Publishes scan, odometry, contact and the clock; obeys speeds, and poses to start from."""

    def __init__(self) -> None:
        super().__init__("mpfa_robot")
        declare(self, PARAMETERS)
        values = {name: value_of(self, name, PARAMETERS) for name in PARAMETERS}
        speed = values.pop("speed")
        self.robot = SimulatedRobot(values.pop("world"), **values)
        self._clock_topic = self.create_publisher(Clock, "/clock", 10)
        self._scans = self.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
        self._odometry = self.create_publisher(Odometry, "odom", 10)
        self._contacts = self.create_publisher(Bool, "contact", 10)
        self.create_subscription(Twist, "cmd_vel", self._on_command, 1)
        self.create_subscription(PoseStamped, "start_pose", self._on_start, 1)
        self.create_timer(self.robot.time_step / speed, self._step)

    def _on_command(self, message: Any) -> None:
        self.robot.obey(message.linear.x, message.angular.z)

    def _on_start(self, message: Any) -> None:
        place = message.pose.position
        self.robot.place((place.x, place.y, yaw(message.pose.orientation)))
        # Whoever waits for it sees it there, though an order under way may move it at once.
        self._tell()

    def _step(self) -> None:
        self.robot.step()
        self._tell()

    def _tell(self) -> None:
        """Publish all that the robot measures."""
        stamp = rclpy.time.Time(nanoseconds=round(self.robot.time * 1e9)).to_msg()
        self._clock_topic.publish(Clock(clock=stamp))
        self._odometry.publish(self._odometry_message(stamp))
        self._scans.publish(self._scan_message(stamp))
        self._contacts.publish(Bool(data=self.robot.touched))

    def _odometry_message(self, stamp: Any) -> Any:
        motion, message = self.robot.motion, Odometry()
        message.header.stamp = stamp
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        write_pose(message.pose.pose, motion[:3])
        message.twist.twist.linear.x = motion.linear_speed
        message.twist.twist.angular.z = motion.angular_speed
        return message

    def _scan_message(self, stamp: Any) -> Any:
        scan, message = self.robot.scan(), LaserScan()
        message.header.stamp = stamp
        message.header.frame_id = "laser"
        message.angle_min, message.angle_increment = scan.angle_min, scan.angle_increment
        message.ranges = array("f", np.asarray(scan.ranges, dtype=np.float64))
        message.angle_max = scan.angle_min + scan.angle_increment * (len(message.ranges) - 1)
        message.range_min, message.range_max = scan.range_min, scan.range_max
        return message


def main() -> None:
    """Run the node until it is shut down."""
    rclpy.init()
    node = RobotNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.robot.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
