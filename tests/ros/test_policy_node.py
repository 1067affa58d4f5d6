"""The policy's node on fakes of rclpy and tf2: what it makes of messages, failures and its end."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import Policy, export_policy, load_policy
from mpfa_envs.policies.layers import Linear
from mpfa_envs.robots.model import ROBOTS
from tests.envs.exported import ENV_ARGUMENTS
from tests.ros.fake_rclpy import World, install

names = SimpleNamespace
DRIVES, STANDS = (0.5, 0.0), (0.0, 0.0)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """With a policy that drives straight ahead."""
    layer = Linear(np.zeros((2, 24), np.float32), np.ones(2, np.float32))
    policy = Policy([layer], env_arguments=ENV_ARGUMENTS)
    found = World()
    found.parameters["policy"] = str(export_policy(policy, tmp_path / "policy.onnx"))
    return found


@pytest.fixture
def module(world: World, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    handlers = {name: signal.getsignal(name) for name in (signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield install(monkeypatch, world)
    for name, handler in handlers.items():
        signal.signal(name, handler)


def stamp(time: float) -> Any:
    return names(sec=int(time), nanosec=round((time - int(time)) * 1e9))


def odometry(time: float, x: float = 0.0, frame: str = "odom") -> Any:
    pose = names(position=names(x=x, y=0.0), orientation=names(x=0.0, y=0.0, z=0.0, w=1.0))
    twist = names(linear=names(x=0.5), angular=names(z=0.0))
    header = names(stamp=stamp(time), frame_id=frame)
    return names(header=header, pose=names(pose=pose), twist=names(twist=twist))


def scan(time: float) -> Any:
    header = names(stamp=stamp(time))
    field = {"angle_min": -math.pi, "angle_increment": math.pi / 180}
    return names(header=header, **field, ranges=np.full(360, 5.0), range_min=0.1, range_max=8.0)


def goal(frame: str, x: float = 4.0) -> Any:
    facing = names(x=0.0, y=0.0, z=math.sin(0.5), w=math.cos(0.5))
    pose = names(position=names(x=x, y=0.0), orientation=facing)
    return names(header=names(frame_id=frame, stamp=stamp(0.0)), pose=pose)


def transform(time: float, x: float = 0.0) -> Any:
    rotation = names(x=0.0, y=0.0, z=0.0, w=1.0)
    found = names(translation=names(x=x, y=0.0), rotation=rotation)
    return names(header=names(stamp=stamp(time)), transform=found)


def feed(node: Any, world: World, time: float, frame: str = "odom") -> tuple[float, float]:
    """Odometry and a scan of now; what is sent then."""
    world.now = time
    node._on_odometry(odometry(time, frame=frame))
    node._on_scan(scan(time))
    return world.sent[-1]


def begin(node: Any, world: World, frame: str = "odom") -> None:
    """Have a node drive to a goal."""
    node._on_odometry(odometry(10.0))
    node._on_goal(goal(frame))
    assert feed(node, world, 10.0) == DRIVES


def driving(module: Any, world: World, frame: str = "odom") -> Any:
    """A node on its path."""
    node = module.PolicyNode()
    begin(node, world, frame)
    return node


def test_a_robot_that_sees_too_little_for_its_filter_is_rejected_at_the_start(
    module: Any, world: World, tmp_path: Path
) -> None:
    file = export_policy(load_policy("td3-rooms"), tmp_path / "rooms.onnx")
    narrow = tmp_path / "narrow.yaml"
    fields = asdict(replace(ROBOTS["kobuki"], name="narrow", field_of_view=120.0))
    narrow.write_text(
        json.dumps({name: value for name, value in fields.items() if value is not None})
    )
    world.parameters |= {"policy": str(file), "robot": str(narrow), "clearance": 0.03}
    with pytest.raises(ValueError, match=r"field_of_view must be at least 180 .* clearance=None"):
        module.PolicyNode()


def test_it_stops_the_robot_when_it_dies_of_an_exception(module: Any, world: World) -> None:
    def spin(node: Any) -> None:
        begin(node, world)
        raise RuntimeError("a bad message")

    world.spin = spin
    with pytest.raises(RuntimeError, match="a bad message"):
        module.main()
    assert world.sent[-1] == STANDS


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_it_stops_the_robot_when_it_is_told_to_end(module: Any, world: World, name: str) -> None:
    def spin(node: Any) -> None:
        begin(node, world)
        signal.raise_signal(getattr(signal, name))

    world.spin = spin
    module.main()
    assert world.sent[-1] == STANDS


def test_a_check_that_fails_stops_the_robot_and_is_logged(
    module: Any, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = driving(module, world)

    def fail(now: float) -> None:
        raise ZeroDivisionError("of the pilot")

    with monkeypatch.context() as patch:
        patch.setattr(node.controller, "tick", fail)
        node._tick()
    assert world.sent[-1] == STANDS and node.controller.pilot.goal is None
    assert world.logged[-1] == ("error", "stopped by ZeroDivisionError('of the pilot')")
    assert feed(node, world, 10.05) == STANDS


def test_an_old_transform_stops_it_until_a_new_one_comes(module: Any, world: World) -> None:
    world.transform = transform(10.0)
    node = driving(module, world, "map")
    assert feed(node, world, 10.9) == DRIVES
    assert feed(node, world, 11.1) == STANDS
    assert world.logged[-1] == ("info", "stale transform: 1.1 s old")
    world.transform = transform(11.1)
    assert feed(node, world, 11.2) == DRIVES
    world.transform = None
    assert feed(node, world, 12.0) == DRIVES
    assert feed(node, world, 12.2) == STANDS


def test_without_stamps_a_transform_ages_from_when_it_last_came(module: Any, world: World) -> None:
    world.parameters["trust_stamps"] = False
    world.transform = transform(500.0)
    node = driving(module, world, "map")
    assert feed(node, world, 10.9) == DRIVES
    assert feed(node, world, 11.1) == STANDS
    world.transform = transform(501.0)
    assert feed(node, world, 11.2) == DRIVES


@pytest.mark.parametrize("frame", ["odom", "map"])
def test_a_goal_before_the_first_odometry_waits_for_it(
    module: Any, world: World, frame: str
) -> None:
    world.transform = transform(10.0)
    node = module.PolicyNode()
    node._on_goal(goal(frame))
    node._tick()
    assert world.sent == [STANDS]  # One stop, then none.
    assert (
        world.logged[-1][1]
        == f"goal in frame {frame!r}: there was no odometry as new as the goal yet"
    )
    assert feed(node, world, 10.0) == DRIVES
    assert node.controller.pilot.goal == (4.0, 0.0)


def test_a_goal_without_a_transform_waits_for_one(module: Any, world: World) -> None:
    node = module.PolicyNode()
    node._on_odometry(odometry(10.0))
    node._on_goal(goal("map"))
    assert feed(node, world, 10.0) == STANDS
    assert world.logged[-1][1] == "goal in frame 'map': no such transform"
    assert len(world.sent) == 1
    world.transform = transform(10.1, x=2.0)
    assert feed(node, world, 10.1) == DRIVES
    assert node.controller.pilot.goal == (6.0, 0.0)


def test_odometry_without_a_frame_is_named(module: Any, world: World) -> None:
    node = module.PolicyNode()
    node._on_odometry(odometry(10.0, frame=""))
    node._on_goal(goal("odom"))
    assert world.logged[-1][1] == "goal in frame 'odom': the odometry names no frame"
    node._on_goal(goal(""))
    assert feed(node, world, 10.0, frame="") == DRIVES


@pytest.mark.parametrize("frame", ["odom", "map"])
def test_odometry_of_another_frame_gives_up_the_goal(module: Any, world: World, frame: str) -> None:
    world.transform = transform(10.0)
    node = driving(module, world, frame)
    assert feed(node, world, 10.05, frame="odom2") == STANDS
    assert world.logged[-1] == ("info", "odometry jumped: from frame 'odom' to 'odom2'")
    sent = len(world.sent)
    node._tick()
    assert len(world.sent) == sent
    node._on_goal(goal("odom2"))
    assert feed(node, world, 10.1, frame="odom2") == DRIVES


def test_a_rate_of_zero_is_rejected(module: Any, world: World) -> None:
    world.parameters["rate"] = 0.0
    with pytest.raises(ValueError, match="rate must be positive, got 0"):
        module.PolicyNode()


def turning_robot(tmp_path: Path, **arguments: Any) -> str:
    """The file of a policy of a Kobuki that wants to drive straight ahead."""
    size = 45 if arguments else 42
    layer = Linear(np.zeros((2, size), np.float32), np.ones(2, np.float32))
    policy = Policy([layer], env_arguments={"robot": "kobuki", **arguments})
    return str(export_policy(policy, tmp_path / "turns.onnx"))


@pytest.mark.parametrize("asked", [True, False])
def test_it_turns_to_the_heading_of_the_goal(
    module: Any, world: World, tmp_path: Path, asked: bool
) -> None:
    world.parameters |= {"policy": turning_robot(tmp_path), "goal_heading": asked}
    node = module.PolicyNode()
    node._on_odometry(odometry(10.0))
    node._on_goal(goal("odom", x=0.1))
    still = odometry(10.1)
    still.twist.twist.linear.x = 0.0
    world.now = 10.1
    node._on_odometry(still)
    node._on_scan(scan(10.1))
    linear, angular = world.sent[-1]
    assert linear == 0.0 and (angular > 0.0) == asked
    assert (node.controller.pilot.goal is None) != asked


def occupancy(frame: str, wall: int) -> Any:
    """A map of 8 x 6 m with a wall of cells with a chance, 4 m from its left edge, and a door."""
    cells = np.full((60, 80), -1)
    cells[:, 40] = wall
    cells[50:, 40] = 0
    place = names(position=names(x=-2.0, y=-3.0), orientation=names(x=0.0, y=0.0, z=0.0, w=1.0))
    info = names(width=80, height=60, resolution=0.1, origin=place)
    return names(header=names(frame_id=frame), info=info, data=cells.ravel().tolist())


@pytest.mark.parametrize("wall", [100, 40])
def test_it_knows_the_map_of_the_topic_where_localization_has_it(
    module: Any, world: World, tmp_path: Path, wall: int
) -> None:
    world.parameters |= {"policy": turning_robot(tmp_path, memory="map"), "map_topic": "map"}
    node = module.PolicyNode()
    node._on_map(occupancy("map", wall))
    world.transform = transform(10.0, x=1.0)
    node._on_odometry(odometry(10.0))
    node._on_goal(goal("odom"))
    feed(node, world, 10.0)
    pilot = node.controller.pilot
    assert pilot.plan is node._plan[0]
    # In the frame of the odometry the wall is at 3 m.
    origin, levels = pilot._map._memory.arrays.origins[0], pilot._map._memory.arrays.levels[0]
    column = round((3.05 - pilot._map._center[0] - origin[0]) / 0.1)
    blocked = (levels[column, 10:50] == 3).mean()
    assert blocked == 1.0 if wall == 100 else blocked < 0.3
    world.transform = transform(10.2, x=1.5)
    feed(node, world, 10.2)
    assert pilot._plan.pose == pytest.approx((-0.5, -3.0, 0.0))


def test_a_map_needs_a_policy_that_has_one(module: Any, world: World) -> None:
    world.parameters["map_topic"] = "map"
    with pytest.raises(ValueError, match="map_topic must be '' for a policy without a map"):
        module.PolicyNode()
