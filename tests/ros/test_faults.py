"""Messages that are wrong, goals without end, and a machine under load, on real rclpy."""

from __future__ import annotations

import gc
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="no rclpy (extra ros, Python 3.11): the nodes were not run")
pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from std_srvs.srv import Trigger

from mpfa_envs.ros.policy_node import PolicyNode
from tests.envs.exported import ENV_ARGUMENTS
from tests.ros.live import Live, live
from tests.ros.processes import SECONDS, node
from tests.ros.test_navigator import straight

pytestmark = pytest.mark.filterwarnings("ignore")
STANDS = (0.0, 0.0)


@pytest.fixture
def driving(tmp_path: Path) -> Iterator[Live]:
    """A node that drives to a goal far away."""
    with live(PolicyNode, policy=straight(tmp_path)) as found:
        found.node.start()
        assert found.until(lambda: found.around.goals.get_subscription_count() > 0)
        assert found.until(lambda: found.node.navigator.frames.odometry is not None)
        found.around.aim(500.0)
        assert found.until(lambda: found.around.sent and found.around.sent[-1][0] > 0.1)
        yield found


def old_scans(scan: Any, _: Any) -> None:
    scan.header.stamp.sec -= 10


def nan_ranges(scan: Any, _: Any) -> None:
    scan.ranges = [math.nan] * 360


def no_ranges(scan: Any, _: Any) -> None:
    scan.ranges = []


def other_angles(scan: Any, _: Any) -> None:
    scan.angle_increment = math.nan


def scan_of_the_future(scan: Any, _: Any) -> None:
    scan.header.stamp.sec += 10


def nan_pose(_: Any, odometry: Any) -> None:
    odometry.pose.pose.position.x = math.nan


def no_quaternion(_: Any, odometry: Any) -> None:
    odometry.pose.pose.orientation.w = odometry.pose.pose.orientation.z = 0.0


def infinite_speed(_: Any, odometry: Any) -> None:
    odometry.twist.twist.linear.x = math.inf


def odometry_of_the_future(_: Any, odometry: Any) -> None:
    odometry.header.stamp.sec += 10


def odometry_without_stamp(_: Any, odometry: Any) -> None:
    odometry.header.stamp.sec = 0


@pytest.mark.parametrize(
    ("spoils", "reason"),
    [
        (old_scans, "stale scan"),
        (nan_ranges, "none of the scan's 360 rays is valid"),
        (no_ranges, "ranges must have shape"),
        (other_angles, "a scan needs a first angle"),
        (scan_of_the_future, "stale scan"),
        (nan_pose, "odometry is not finite"),
        (no_quaternion, "odometry is not finite"),
        (infinite_speed, "odometry is not finite"),
        (odometry_of_the_future, "stale odometry"),
        (odometry_without_stamp, "stale odometry"),
    ],
)
def test_wrong_messages_stop_it_while_they_last(
    driving: Live,
    spoils: Callable[[Any, Any], None],
    reason: str,
    record_property: Callable[[str, object], None],
) -> None:
    around = driving.around
    around.spoils = spoils
    record_property(SECONDS, driving.stands_after(time.monotonic()))
    assert driving.until(lambda: around.statuses[-1]["reason"].startswith(reason))
    assert around.states[-1] == "waiting"
    driving.until(lambda: False, 0.3)
    assert around.sent[-1] == STANDS
    around.spoils = lambda scan, odometry: None
    assert driving.until(lambda: around.sent[-1][0] > 0.1)


def test_a_decision_that_takes_too_long_is_not_driven(driving: Live) -> None:
    driver = driving.node.navigator.controller.pilot._asked._driver
    decide = driver.policy

    def slowly(seen: Any) -> Any:
        time.sleep(0.7)
        return decide(seen)

    driver.policy = slowly
    around = driving.around
    assert driving.until(lambda: around.sent[-1] == STANDS)
    assert driving.until(lambda: around.statuses[-1]["reason"].startswith("too late"))
    driver.policy = decide
    assert driving.until(lambda: around.sent[-1][0] > 0.1)


def test_another_frame_of_the_odometry_gives_up_the_goal(driving: Live) -> None:
    def renames(_: Any, odometry: Any) -> None:
        odometry.header.frame_id = "odom_combined"

    driving.around.spoils = renames
    assert driving.until(lambda: driving.around.states[-1] == "given up")
    assert driving.around.statuses[-1]["reason"].startswith("odometry jumped: from frame 'odom'")
    assert driving.until(lambda: driving.around.sent[-1] == STANDS)


def test_a_goal_of_an_unknown_frame_waits_and_says_so(driving: Live) -> None:
    driving.around.aim(1.0, frame="nowhere")
    said = "goal in frame 'nowhere'"
    assert driving.until(lambda: driving.around.statuses[-1]["reason"].startswith(said))
    assert driving.around.states[-1] == "waiting"
    assert driving.until(lambda: driving.around.sent[-1] == STANDS)


@pytest.mark.parametrize("count", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_goals_and_cancels_without_end_leak_nothing_and_leave_a_robot_that_stands(
    driving: Live, count: int
) -> None:
    around = driving.around
    client = around.node.create_client(Trigger, "mpfa_policy/cancel")
    assert driving.until(client.service_is_ready)
    sizes = []
    for number in range(count):
        around.aim(around.pose[0] + 100.0)
        assert driving.until(lambda: around.sent[-1][0] > 0.0)
        future = client.call_async(Trigger.Request())
        assert driving.until(future.done) and future.result().success
        assert driving.until(lambda: around.sent[-1] == STANDS)
        if number % (count // 5) == 0:
            gc.collect()
            sizes.append(len(gc.get_objects()))
    sent = len(around.sent)
    driving.until(lambda: False, 1.0)
    assert len(around.sent) == sent
    # Of each goal the surroundings keep some messages, and the node nothing.
    kept = len(around.statuses) + len(around.feedbacks) + len(around.sent)
    assert sizes[-1] - sizes[1] < 10 * kept


def burn(ended: Any) -> None:
    while not ended.is_set():
        sum(range(1000))


@contextmanager
def burners(count: int) -> Iterator[None]:
    """Processes that use a core each."""
    kind = multiprocessing.get_context("spawn")
    ended = kind.Event()
    processes = [kind.Process(target=burn, args=(ended,)) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        ended.set()
        for process in processes:
            process.join()


@pytest.mark.slow
@pytest.mark.parametrize("busy", [0, 2])
def test_orders_come_in_time_while_others_burn_the_cores(
    tmp_path: Path, busy: int, record_property: Callable[[str, object], None]
) -> None:
    # It decides every 0.1 s.
    policy = straight(tmp_path, **ENV_ARGUMENTS, action_repeat=1)
    with live(None) as found, node("policy_node", policy=policy), burners(busy):
        around = found.around
        around.scan_every(0.025)
        assert found.until(lambda: around.goals.get_subscription_count() > 0, 120.0)
        assert found.until(lambda: around.states == ["idle"], 60.0)
        around.aim(500.0)
        assert found.until(lambda: around.sent and around.sent[-1][0] > 0.1, 60.0)
        start = len(around.times)
        found.until(lambda: False, 30.0)
        periods = np.diff(around.times[start:])
        median, late = np.percentile(periods, [50.0, 99.0])
        record_property("median and 99 % of the period of orders [s]", (float(median), float(late)))
        # The base stops after 0.5 s without an order.
        assert median < 0.1 and late < 0.5
        moving = [order[0] > 0.0 for order in around.sent[start:]]
        assert np.mean(moving) > 0.9
        assert time.monotonic() - around.times[-1] < 0.5
