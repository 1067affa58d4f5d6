"""How the policy's node ends on real rclpy: by signals, by errors, and cleaned up."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="no rclpy (extra ros, Python 3.11): the nodes were not run")
pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

import rclpy
from lifecycle_msgs.srv import GetState
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from mpfa_envs.ros import policy_node
from mpfa_envs.ros.policy_node import PolicyNode
from tests.ros.live import Live, live
from tests.ros.processes import node
from tests.ros.test_navigator import straight

pytestmark = pytest.mark.filterwarnings("ignore")
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Live]:
    """A node that is active."""
    with live(PolicyNode, policy=straight(tmp_path)) as found:
        found.node.start()
        assert found.until(lambda: found.around.goals.get_subscription_count() > 0)
        assert found.until(lambda: found.node.navigator.frames.odometry is not None)
        yield found


@pytest.fixture
def handlers() -> Iterator[None]:
    """Those of signals are afterwards what they were."""
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = {number: signal.getsignal(number) for number in numbers}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("end", ["SIGINT", "SIGTERM", "SIGHUP", "error"])
def test_it_stops_the_robot_at_its_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, end: str
) -> None:
    sent: list[tuple[float, float]] = []

    def spin(node: Any) -> None:
        publish = node._publish
        monkeypatch.setattr(
            node, "_publish", lambda *speeds: (sent.append(speeds), publish(*speeds))
        )
        node._publish(0.5, 0.0)
        if end == "error":
            raise RuntimeError("a bad message")
        signal.raise_signal(getattr(signal, end))

    start, policy = PolicyNode.start, Parameter("policy", value=straight(tmp_path))
    monkeypatch.setattr(rclpy, "spin", spin)
    monkeypatch.setattr(
        PolicyNode, "start", lambda node: (node.set_parameters([policy]), start(node))
    )
    if end == "error":
        with pytest.raises(RuntimeError, match="a bad message"):
            policy_node.main()
    else:
        policy_node.main()
    assert sent[-1] == (0.0, 0.0)


@pytest.mark.usefixtures("handlers")
def test_at_its_end_it_waits_until_the_last_order_has_arrived_whatever_signals_come(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    done: list[Any] = []
    stop, start = PolicyNode.stop, PolicyNode.start

    def stops(node: PolicyNode) -> None:
        signal.raise_signal(signal.SIGINT)
        stop(node)

    monkeypatch.setattr(PolicyNode, "stop", stops)
    monkeypatch.setattr(PolicyNode, "_publish", lambda node, *speeds: done.append(speeds))
    monkeypatch.setattr(
        Publisher, "wait_for_all_acked", lambda publisher, time: done.append(publisher.topic_name)
    )
    policy = Parameter("policy", value=straight(tmp_path))
    monkeypatch.setattr(
        PolicyNode, "start", lambda node: (node.set_parameters([policy]), start(node))
    )
    monkeypatch.setattr(rclpy, "spin", lambda node: signal.raise_signal(signal.SIGTERM))
    policy_node.main()
    assert done == [(0.0, 0.0), "/cmd_vel"]


def test_a_node_that_is_cleaned_up_waits_until_its_last_order_has_arrived(
    monkeypatch: pytest.MonkeyPatch, started: Live
) -> None:
    waited: list[str] = []
    monkeypatch.setattr(
        Publisher, "wait_for_all_acked", lambda publisher, time: waited.append(publisher.topic_name)
    )
    started.node.trigger_deactivate()
    assert waited == []
    started.node.trigger_cleanup()
    assert waited == ["/cmd_vel"]


@pytest.mark.usefixtures("handlers")
def test_a_signal_that_a_callback_of_the_compiler_hides_ends_it_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def start(_: PolicyNode) -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    def spin(_: PolicyNode) -> None:
        raise AssertionError("the node runs")

    monkeypatch.setattr(PolicyNode, "start", start)
    monkeypatch.setattr(rclpy, "spin", spin)
    policy_node.main()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_node_that_no_one_has_configured(number: signal.Signals) -> None:
    with live(None) as found, node("policy_node", autostart=False) as process:
        client = found.around.node.create_client(GetState, "mpfa_policy/get_state")

        def answers() -> bool:
            # A service may be there before who asks is known to it; a question is lost then.
            future = client.call_async(GetState.Request())
            return found.until(future.done, 1.0)

        assert found.until(answers, 60.0)
        process.send_signal(number)
        assert process.wait(10.0) == 0
