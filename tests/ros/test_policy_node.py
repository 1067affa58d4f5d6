"""The policy's node on real rclpy: its life cycle, status, action, and parameters."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="no rclpy (extra ros, Python 3.11): the nodes were not run")
pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

import rclpy
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from mpfa_envs import export_policy, load_policy
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.ros import policy_node
from mpfa_envs.ros.policy_node import PolicyNode
from tests.ros.live import Live, live, parameter
from tests.ros.test_navigator import straight, turning

pytestmark = pytest.mark.filterwarnings("ignore")
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


LAUNCH = Path(policy_node.__file__).parent / "launch"


class MetersAhead:
    """An action whose goal is a number of meters, in the place of NavigateToPose."""

    kind = Fibonacci

    def place(self, goal: Any) -> Any:
        message = policy_node.PoseStamped()
        message.header.frame_id = "odom"
        message.pose.position.x, message.pose.orientation.w = float(goal.order), 1.0
        return message

    def feedback(self, progress: Any, place: Any) -> Any:
        assert place.header.frame_id == "odom"
        x = round(place.pose.position.x)
        return Fibonacci.Feedback(sequence=[round(progress.distance), progress.recoveries, x])

    def result(self, status: Any) -> Any:
        return Fibonacci.Result(sequence=[len(status.reason)])


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Live]:
    """A node that is active."""
    with live(lambda: PolicyNode(MetersAhead), policy=straight(tmp_path)) as found:
        found.node.start()
        assert found.until(lambda: found.around.goals.get_subscription_count() > 0)
        assert found.until(lambda: found.node.navigator.frames.odometry is not None)
        yield found


def test_a_drive_is_accepted_driven_and_arrives_and_the_robot_stands(started: Live) -> None:
    around = started.around
    assert started.until(lambda: around.states == ["idle"])
    around.aim(1.5)
    assert started.until(lambda: around.states[-1] == "arrived")
    assert set(around.states[1:-1]) <= {"waiting", "accepted", "driving"}
    assert "driving" in around.states and around.statuses[-1]["code"] == str(SUCCEEDED)
    assert around.statuses[-1]["reason"] == "arrived" and around.statuses[-1]["goal"] == "1"
    assert started.until(lambda: around.sent[-1] == (0.0, 0.0))
    distances = [distance for distance, _, _ in around.feedbacks if not math.isnan(distance)]
    assert len(distances) >= 2 and distances == sorted(distances, reverse=True)
    sent = len(around.sent)
    started.until(lambda: False, 0.5)
    assert len(around.sent) == sent


def test_the_status_is_there_for_who_comes_late(started: Live) -> None:
    started.around.aim(math.nan)
    assert started.until(lambda: started.around.states[-1] == "rejected")
    assert started.around.statuses[-1]["reason"].startswith("goal must be a finite number")
    assert started.around.sent[-1] == (0.0, 0.0)
    other = type(started.around)()
    started.executor.add_node(other.node)
    assert started.until(lambda: other.states == ["rejected"])
    other.node.destroy_node()


def test_the_service_cancels_and_says_where_there_is_nothing_to_cancel(started: Live) -> None:
    around = started.around
    assert not started.call(Trigger, "mpfa_policy/cancel", Trigger.Request()).success
    around.aim(5.0)
    assert started.until(lambda: around.sent and around.sent[-1][0] > 0.1)
    assert started.call(Trigger, "mpfa_policy/cancel", Trigger.Request()).success
    assert started.until(lambda: around.states[-1] == "canceled" and around.sent[-1] == (0.0, 0.0))
    sent = len(around.sent)
    started.until(lambda: False, 0.5)
    assert len(around.sent) == sent


def test_a_lost_scan_is_waited_for_and_a_jump_gives_up(started: Live) -> None:
    around = started.around
    around.aim(6.0)
    assert started.until(lambda: around.states[-1] == "driving")
    around.sees = False
    assert started.until(lambda: around.states[-1] == "waiting" and around.sent[-1] == (0.0, 0.0))
    assert around.statuses[-1]["reason"].startswith("stale scan")
    around.sees = True
    assert started.until(lambda: around.states[-1] == "driving")
    around.pose[0] += 2.0
    assert started.until(lambda: around.states[-1] == "given up" and around.sent[-1] == (0.0, 0.0))
    assert around.statuses[-1]["reason"].startswith("odometry jumped")


def send(started: Live, meters: int) -> tuple[Any, list[Any]]:
    """Send a goal by the action; its handle, and its feedback."""
    client = ActionClient(started.around.node, Fibonacci, "navigate_to_pose")
    assert started.until(client.server_is_ready)
    heard: list[Any] = []
    sent = client.send_goal_async(Fibonacci.Goal(order=meters), heard.append)
    assert started.until(sent.done)
    return sent.result(), heard


def test_the_action_succeeds_with_feedback(started: Live) -> None:
    handle, heard = send(started, 2)
    assert handle.accepted
    ended = handle.get_result_async()
    assert started.until(ended.done)
    assert ended.result().status == SUCCEEDED
    assert list(ended.result().result.sequence) == [len("arrived")]
    assert [message.feedback.sequence[0] for message in heard][-1] <= 1 and len(heard) >= 2
    assert [message.feedback.sequence[2] for message in heard][-1] >= 1


def test_the_action_is_canceled_by_its_client(started: Live) -> None:
    handle, _ = send(started, 5)
    assert started.until(lambda: started.around.states[-1] == "driving")
    ended, canceled = handle.get_result_async(), handle.cancel_goal_async()
    assert started.until(lambda: canceled.done() and ended.done())
    assert ended.result().status == CANCELED
    assert started.until(lambda: started.around.sent[-1] == (0.0, 0.0))


def test_another_goal_aborts_that_of_the_action_and_is_driven(started: Live) -> None:
    first, _ = send(started, 5)
    ended = first.get_result_async()
    assert started.until(lambda: started.around.states[-1] == "driving")
    second, _ = send(started, 2)
    assert started.until(ended.done) and ended.result().status == ABORTED
    ended = second.get_result_async()
    assert started.until(ended.done) and ended.result().status == SUCCEEDED


@pytest.mark.parametrize("end", ["trigger_shutdown", "end"])
def test_the_client_of_the_action_gets_its_result_when_the_node_ends(
    started: Live, end: str
) -> None:
    handle, _ = send(started, 5)
    ended = handle.get_result_async()
    assert started.until(lambda: started.around.states[-1] == "driving")
    getattr(started.node, end)()
    assert started.until(ended.done, 5.0) and ended.result().status == ABORTED
    assert started.until(lambda: started.around.sent[-1] == (0.0, 0.0))
    if end == "trigger_shutdown":
        assert started.until(lambda: started.node.navigator is None, 5.0)


def test_a_node_that_does_not_drive_says_nothing_at_its_end(started: Live) -> None:
    around = started.around
    started.node.trigger_deactivate()
    assert started.until(lambda: bool(around.sent))
    sent = len(around.sent)
    started.node.end()
    started.until(lambda: False, 0.5)
    assert len(around.sent) == sent


def test_an_action_of_an_inactive_node_is_rejected(started: Live) -> None:
    started.node.trigger_deactivate()
    assert not send(started, 2)[0].accepted


def test_the_life_cycle_begins_where_a_manager_wants_and_stands_when_deactivated(
    tmp_path: Path,
) -> None:
    def change(found: Live, label: str) -> bool:
        request = ChangeState.Request()
        request.transition.label = label
        return bool(found.call(ChangeState, "mpfa_policy/change_state", request).success)

    def state(found: Live) -> str:
        answer = found.call(GetState, "mpfa_policy/get_state", GetState.Request())
        return str(answer.current_state.label)

    with live(PolicyNode, policy=straight(tmp_path)) as found:
        around = found.around
        assert state(found) == "unconfigured"
        assert change(found, "configure") and state(found) == "inactive"
        assert found.until(lambda: found.node.navigator.frames.odometry is not None)
        around.aim(5.0)
        found.until(lambda: False, 0.5)
        assert around.sent == []
        assert change(found, "activate")
        around.aim(5.0)
        assert found.until(lambda: around.sent and around.sent[-1][0] > 0.1)
        assert change(found, "deactivate")
        assert found.until(lambda: around.sent[-1] == (0.0, 0.0))
        assert found.until(lambda: around.states[-1] == "canceled")
        sent = len(around.sent)
        found.until(lambda: False, 0.5)
        assert set(around.sent[sent - 1 :]) == {(0.0, 0.0)} and len(around.sent) <= sent + 1
        assert change(found, "cleanup") and found.node.navigator is None
        assert around.goals.get_subscription_count() == 0
        assert change(found, "configure") and change(found, "activate")
        assert found.until(lambda: around.goals.get_subscription_count() > 0)
        assert found.until(lambda: found.node.navigator.frames.odometry is not None)
        around.aim(around.pose[0] + 2.0)
        assert found.until(lambda: around.states[-1] == "arrived")


def test_a_robot_that_sees_too_little_for_its_filter_is_rejected_when_it_is_configured(
    tmp_path: Path,
) -> None:
    file = export_policy(load_policy("td3-rooms"), tmp_path / "rooms.onnx")
    narrow = tmp_path / "narrow.yaml"
    fields = asdict(replace(ROBOTS["kobuki"], name="narrow", field_of_view=120.0))
    narrow.write_text(
        json.dumps({name: value for name, value in fields.items() if value is not None})
    )
    with (
        live(PolicyNode, policy=file, robot=narrow, clearance=0.03) as found,
        pytest.raises(ValueError, match=r"field_of_view must be at least 180 .* clearance=None"),
    ):
        found.node.start()


def test_parameters_change_while_it_drives_or_are_rejected_by_name(tmp_path: Path) -> None:
    def change(found: Live, name: str, value: Any) -> Any:
        request = SetParameters.Request(parameters=[parameter(name, value)])
        answer = found.call(SetParameters, "mpfa_policy/set_parameters", request)
        return answer.results[0]

    with live(PolicyNode, policy=turning(tmp_path), clearance=0.03) as found:
        assert change(found, "stop_distance", 0.1).successful
        found.node.start()
        controller = found.node.navigator.controller
        assert controller.stop_distance == 0.1
        assert change(found, "goal_radius", 0.2).successful
        assert controller.pilot.goal_radius == 0.2
        assert change(found, "scan_timeout", 0.8).successful and controller.scan_timeout == 0.8
        assert change(found, "clearance", 0.1).successful
        found.until(lambda: found.node.navigator.frames.odometry is not None)
        found.around.aim(1.0)
        assert found.until(lambda: found.around.states[-1] == "arrived")
        no = change(found, "robot", "burger")
        assert not no.successful and no.reason.startswith("robot cannot change while")
        no = change(found, "clearance", 0.0)
        assert not no.successful and no.reason.startswith("clearance must stay positive")
        assert found.node.get_parameter("robot").value == ""


def test_a_check_that_fails_stops_the_robot_and_is_said(
    started: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    around = started.around
    around.aim(5.0)
    assert started.until(lambda: around.sent and around.sent[-1][0] > 0.1)

    def fail(now: float) -> None:
        raise ZeroDivisionError("of the pilot")

    with monkeypatch.context() as patch:
        patch.setattr(started.node.navigator.controller, "tick", fail)
        assert started.until(lambda: around.sent[-1] == (0.0, 0.0))
    assert started.until(lambda: around.states[-1] == "given up")
    around.aim(5.0)
    assert started.until(lambda: around.sent[-1][0] > 0.1)


def test_whole_numbers_and_no_text_are_parameters_too(tmp_path: Path) -> None:
    given = {"clearance": 0, "rate": 10, "mount": "[0, 0, 0]", "action": "none", "pace": 1}
    with live(lambda: PolicyNode(MetersAhead), policy=turning(tmp_path), **given) as found:
        found.node.start()
        controller = found.node.navigator.controller
        assert not controller.pilot.has_filter and controller.check_period == 0.1
        assert found.node._action is None
        request = SetParameters.Request(parameters=[parameter("scan_timeout", 1)])
        found.call(SetParameters, "mpfa_policy/set_parameters", request)
        assert controller.scan_timeout == 1.0


@pytest.mark.parametrize(
    ("name", "value", "wants"),
    [("stamped", 1, "true or false"), ("rate", "fast", "a number"), ("mount", 0.1, "a list")],
)
def test_a_parameter_of_another_type_is_rejected_by_name(
    tmp_path: Path, name: str, value: Any, wants: str
) -> None:
    with (
        live(PolicyNode, policy=straight(tmp_path), **{name: value}) as found,
        pytest.raises(ValueError, match=rf"{name} must be {wants}.*, got"),
    ):
        found.node.start()


def test_the_status_says_that_no_one_takes_the_orders(tmp_path: Path) -> None:
    with live(PolicyNode, policy=straight(tmp_path), command_topic="elsewhere") as found:
        found.node.start()
        assert found.until(lambda: found.node.navigator.frames.odometry is not None)
        found.around.aim(5.0)

        def notes() -> list[str]:
            return [status["note"] for status in found.around.statuses]

        assert found.until(lambda: "no one subscribes to /elsewhere" in notes(), 10.0)
        # A process of its own: in one, all have the same type.
        context = rclpy.Context()
        rclpy.init(context=context)
        base = rclpy.create_node("base", context=context)
        base.create_subscription(TwistStamped, "elsewhere", lambda _: None, 1)
        note = "/elsewhere is subscribed as TwistStamped: set stamped true"
        assert found.until(lambda: note in notes(), 10.0)
        base.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("file", sorted(LAUNCH.glob("*.yaml")), ids=lambda file: file.stem)
def test_a_file_of_parameters_reaches_a_node_in_the_namespace_of_a_robot(file: Path) -> None:
    context = rclpy.Context()
    words = ["--ros-args", "--params-file", str(file), "-r", "__ns:=/robot1"]
    rclpy.init(args=words, context=context)
    name = "mpfa_policy"
    found = rclpy.create_node(
        name, context=context, automatically_declare_parameters_from_overrides=True
    )
    assert found.get_parameter("robot").value == file.stem.replace("turtlebot3_", "")
    assert found.get_parameter("clearance").value > 0.0
    found.destroy_node()
    rclpy.shutdown(context=context)
