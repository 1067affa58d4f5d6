"""The commands `ros2 run` and `ros2 launch`, where they are installed, on a prefix as a wheel's."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="no rclpy (extra ros, Python 3.11): the nodes were not run")
pytest.importorskip("onnx", reason="exported policies are of the extra onnx")
pytest.importorskip("ros2launch", reason="ros2 run and ros2 launch are not in the Python index")


from mpfa_envs import export_policy, load_policy
from tests.ros.processes import Bench
from tests.ros.test_launch import places_in_a_prefix

pytestmark = pytest.mark.filterwarnings("ignore")


@contextmanager
def ros2(*words: str, prefix: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A command with the package in a prefix; it is interrupted as by Ctrl-C at the end."""
    for there, here in places_in_a_prefix().items():
        copy = shutil.copytree if here.is_dir() else shutil.copy
        (prefix / there).parent.mkdir(parents=True, exist_ok=True)
        copy(here, prefix / there)
    prefixes = f"{prefix}:{os.environ.get('AMENT_PREFIX_PATH', sys.prefix)}"
    python = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {**os.environ, "AMENT_PREFIX_PATH": prefixes, "PATH": python}
    process = subprocess.Popen(["ros2", *words], env=environment, start_new_session=True)
    try:
        yield process
        os.killpg(process.pid, signal.SIGINT)
        process.wait(20.0)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def test_ros2_run_finds_the_node_and_ctrl_c_ends_it(bench: Bench, tmp_path: Path) -> None:
    policy = export_policy(load_policy("td3-paper"), tmp_path / "policy.onnx")
    words = ("run", "mpfa_envs", "policy_node", "--ros-args", "-p", f"policy:={policy}")
    with ros2(*words, prefix=tmp_path / "prefix"):
        assert bench.until(lambda: bench.goal.get_subscription_count() > 0, 60.0)
    assert bench.until(lambda: bench.goal.get_subscription_count() == 0, 10.0)


def test_ros2_launch_drives_a_simulated_robot_to_a_goal(bench: Bench, tmp_path: Path) -> None:
    policy = export_policy(load_policy("td3-rooms"), tmp_path / "policy.onnx")
    words = ("launch", "mpfa_envs", "simulated.launch.xml", f"policy:={policy}")
    with ros2(*words, prefix=tmp_path / "prefix"):
        assert bench.until(lambda: bench.goal.get_subscription_count() > 0, 90.0)
        assert bench.until(lambda: bench.now > 0.0, 30.0)
        x, y, _ = bench.pose
        bench.send(bench.goal, (x + 1.0, y, 0.0), bench.now)
        assert bench.until(lambda: bench.status.get("state") in ("arrived", "given up"), 60.0)
        assert bench.status["state"] == "arrived" and not bench.touched
    assert bench.until(lambda: bench.goal.get_subscription_count() == 0, 10.0)
