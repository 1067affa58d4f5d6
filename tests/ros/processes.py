"""Nodes in processes of their own, and what stands around them."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from std_msgs.msg import Bool

from mpfa_envs import Task
from mpfa_envs.ros.messages import odometry_of, seconds, write_pose

SECONDS = "seconds until the robot stands or is ordered to"
"""A property of tests of faults."""


@contextmanager
def node(module: str, **parameters: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A node of the package in a process of its own."""
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", f"mpfa_envs.ros.{module}", "--ros-args", *words]
    process = subprocess.Popen(command)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


class Bench:
    """What stands around the nodes: it hears all topics."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("bench")
        self.pose, self.speeds, self.now, self.touched = (0.0, 0.0, 0.0), (0.0, 0.0), 0.0, False
        self.commands: list[tuple[float, float]] = []
        self.goal = self.node.create_publisher(PoseStamped, "goal_pose", 1)
        self.start = self.node.create_publisher(PoseStamped, "start_pose", 1)
        hear = self.node.create_subscription
        hear(Odometry, "odom", self._on_odometry, 10)
        hear(Bool, "contact", self._on_contact, 10)
        hear(Twist, "cmd_vel", self._on_command, 10)
        self.status: dict[str, str] = {}
        hear(DiagnosticStatus, "mpfa_policy/status", self._on_status, 10)

    def _on_odometry(self, message: Any) -> None:
        self.pose, self.speeds = odometry_of(message)
        self.now = seconds(message.header.stamp)

    def _on_contact(self, message: Any) -> None:
        self.touched = message.data

    def _on_command(self, message: Any) -> None:
        self.commands.append((message.linear.x, message.angular.z))

    def _on_status(self, message: Any) -> None:
        self.status = {each.key: each.value for each in message.values}

    def until(self, holds: Callable[[], bool], timeout: float) -> bool:
        """Wait until something holds, or for so many seconds."""
        end = time.monotonic() + timeout
        while not holds() and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)
        return holds()

    def drive(self, task: Task) -> bool:
        """Have the robot drive a task; whether it reached the goal and nothing else."""
        self.send(self.start, task.start)
        assert self.until(lambda: math.dist(self.pose[:2], task.start[:2]) < 0.01, 20.0)
        self.touched, number = False, int(self.status.get("goal", "0")) + 1
        self.send(self.goal, (*task.goal, 0.0), self.now)
        assert self.until(lambda: self.status.get("goal") == str(number), 20.0)
        end = self.now + 50.0
        ends = ("arrived", "given up", "rejected")
        self.until(lambda: self.status["state"] in ends or self.touched or self.now > end, 120.0)
        return self.status["state"] == "arrived" and not self.touched

    def send(self, publisher: Any, pose: tuple[float, float, float], now: float = 0.0) -> None:
        message = PoseStamped()
        message.header.stamp = rclpy.time.Time(seconds=now).to_msg()
        message.header.frame_id = "odom"
        write_pose(message.pose, pose)
        publisher.publish(message)
