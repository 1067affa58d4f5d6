"""The nodes in processes of their own, where rclpy is installed."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="no rclpy (extra ros, Python 3.11): the nodes were not run")
pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from mpfa_envs import evaluate, export_policy, load_policy, world_tasks
from tests.envs.exported import SHIPPED
from tests.ros.processes import SECONDS, Bench, node

pytestmark = pytest.mark.filterwarnings("ignore")
_SPEED = 3.0
"""Of the simulated robot, over real time."""


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return export_policy(load_policy(SHIPPED), tmp_path / "policy.onnx")


def test_the_node_stops_on_stale_scans_and_at_its_end(
    bench: Bench, policy: Path, record_property: Callable[[str, object], None]
) -> None:
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
        sees, ended = False, time.monotonic()
        assert bench.until(lambda: bench.commands[-1] == (0.0, 0.0), 20.0)
        record_property(SECONDS, time.monotonic() - ended)
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


def test_the_robot_stops_by_itself_when_the_node_is_killed(
    bench: Bench, policy: Path, record_property: Callable[[str, object], None]
) -> None:
    with (
        node("robot_node", world="test"),
        node("policy_node", policy=policy, stop_distance=0.0, use_sim_time=True) as process,
    ):
        begin(bench)
        process.kill()
        assert process.wait(20.0) == -signal.SIGKILL
        # The node cannot say anything any more: the base's own timeout of 0.5 s has to stop it.
        killed = bench.now
        assert bench.until(lambda: abs(bench.speeds[0]) < 0.01, 20.0)
        record_property(SECONDS, bench.now - killed)
        assert bench.now - killed < 2.0
        place = bench.pose
        bench.until(lambda: bench.now > killed + 3.0, 20.0)
        assert math.dist(bench.pose[:2], place[:2]) < 0.02


def test_the_node_stops_when_the_simulation_with_its_clock_is_killed(
    bench: Bench, policy: Path, record_property: Callable[[str, object], None]
) -> None:
    with (
        node("robot_node", world="test") as robot,
        node("policy_node", policy=policy, stop_distance=0.0, use_sim_time=True),
    ):
        begin(bench)
        robot.kill()
        killed = time.monotonic()
        assert bench.until(lambda: bench.commands[-1] == (0.0, 0.0), 20.0)
        record_property(SECONDS, time.monotonic() - killed)
        assert bench.until(lambda: bench.status["state"] == "waiting", 20.0)
        assert bench.until(lambda: bench.status["reason"].startswith("the clock"), 20.0)
        with node("robot_node", world="test"):
            # Its clock begins again, and its odometry is far from where the robot was.
            assert bench.until(lambda: bench.status["state"] in ("given up", "driving"), 60.0)


def begin(bench: Bench) -> None:
    """Have the robot drive in the first task of the test world."""
    for publisher in (bench.goal, bench.start):
        assert bench.until(lambda p=publisher: p.get_subscription_count() > 0, 60.0)
    task = world_tasks("test", episodes=1, seed=0)[0].task
    bench.send(bench.start, task.start)
    assert bench.until(lambda: math.dist(bench.pose[:2], task.start[:2]) < 0.01, 20.0)
    bench.send(bench.goal, (*task.goal, 0.0), bench.now)
    assert bench.until(lambda: bench.speeds[0] > 0.2, 30.0)
