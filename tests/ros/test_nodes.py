"""The nodes in processes of their own, where rclpy is installed."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed: the nodes were not run (extra ros)")
pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool

from mpfa_envs import Task, evaluate, export_policy, load_policy, world_tasks
from mpfa_envs.ros.messages import odometry_of, seconds, write_pose
from tests.envs.exported import SHIPPED
from tests.ros.live import choose_domain

pytestmark = pytest.mark.filterwarnings("ignore")
_SPEED = 3.0
"""Of the simulated robot, over real time."""


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


@pytest.fixture
def bench() -> Iterator[Bench]:
    choose_domain()
    rclpy.init()
    found = Bench()
    yield found
    found.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return export_policy(load_policy(SHIPPED), tmp_path / "policy.onnx")


def test_the_node_stops_on_stale_scans_and_at_its_end(bench: Bench, policy: Path) -> None:
    scans = bench.node.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
    odometry = bench.node.create_publisher(Odometry, "odom", 10)
    sees = True

    def publish() -> None:
        stamp = bench.node.get_clock().now().to_msg()
        felt = Odometry()
        felt.header.stamp, felt.header.frame_id = stamp, "odom"
        felt.pose.pose.orientation.w = 1.0
        odometry.publish(felt)
        if sees:
            seen = LaserScan(angle_min=-math.pi, angle_increment=math.pi / 180, range_max=8.0)
            seen.angle_max = math.pi - math.pi / 180
            seen.header.stamp, seen.ranges = stamp, [3.0] * 360
            scans.publish(seen)

    bench.node.create_timer(0.1, publish)
    with node("policy_node", policy=policy) as process:
        assert bench.until(lambda: bench.goal.get_subscription_count() > 0, 60.0)
        bench.until(lambda: False, 1.0)
        bench.send(bench.goal, (3.0, 0.0, 0.0))
        assert bench.until(lambda: bool(bench.commands) and bench.commands[-1][0] > 0.05, 20.0)
        sees = False
        assert bench.until(lambda: bench.commands[-1] == (0.0, 0.0), 20.0)
        sees = True
        assert bench.until(lambda: bench.commands[-1][0] > 0.05, 20.0)
        bench.send(bench.goal, (math.nan, 0.0, 0.0))
        assert bench.until(lambda: bench.commands[-1] == (0.0, 0.0), 20.0)
        bench.send(bench.goal, (3.0, 0.0, 0.0))
        assert bench.until(lambda: bench.commands[-1][0] > 0.05, 20.0)
        process.send_signal(signal.SIGTERM)
        assert bench.until(lambda: bench.commands[-1] == (0.0, 0.0), 20.0)
        assert process.wait(20.0) == 0


@pytest.mark.slow
def test_twenty_drives_in_real_processes_succeed_as_in_the_environment(
    bench: Bench, policy: Path
) -> None:
    want = evaluate(load_policy(SHIPPED), "test", episodes=20, physics="wheels")
    reached = []
    with (
        node("robot_node", world="test", speed=_SPEED),
        node("policy_node", policy=policy, stop_distance=0.0, use_sim_time=True),
    ):
        for publisher in (bench.goal, bench.start):
            assert bench.until(lambda p=publisher: p.get_subscription_count() > 0, 60.0)
        for each in world_tasks("test", episodes=20, seed=0):
            reached.append(bench.drive(each.task))
    assert sum(reached) >= sum(result.success for result in want) - 1
