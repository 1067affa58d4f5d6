"""What the node makes of messages, frames and a clock that jumps; real nodes need rclpy."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import Policy, export_policy
from mpfa_envs.policies.layers import Linear
from mpfa_envs.ros.frames import Frames
from mpfa_envs.ros.navigator import Navigator
from mpfa_envs.ros.parameters import PARAMETERS, change, check_change, make_controller
from tests.envs.exported import ENV_ARGUMENTS

names = SimpleNamespace
DRIVES, STANDS = (0.5, 0.0), (0.0, 0.0)


def straight(folder: Path, size: int = 24, **env_arguments: Any) -> str:
    """The file of a policy that drives straight ahead."""
    layer = Linear(np.zeros((2, size), np.float32), np.ones(2, np.float32))
    policy = Policy([layer], env_arguments=env_arguments or ENV_ARGUMENTS)
    return str(export_policy(policy, folder / "policy.onnx"))


def turning(folder: Path, **arguments: Any) -> str:
    """That of a Kobuki, which can turn on the spot."""
    return straight(folder, 45 if arguments else 42, robot="kobuki", **arguments)


def stamp(time: float) -> Any:
    return names(sec=int(time), nanosec=round((time - int(time)) * 1e9))


def odometry(time: float, x: float = 0.0, frame: str = "odom", speed: float = 0.5) -> Any:
    pose = names(position=names(x=x, y=0.0), orientation=names(x=0.0, y=0.0, z=0.0, w=1.0))
    twist = names(linear=names(x=speed), angular=names(z=0.0))
    header = names(stamp=stamp(time), frame_id=frame)
    return names(header=header, pose=names(pose=pose), twist=names(twist=twist))


def scan(time: float) -> Any:
    header = names(stamp=stamp(time), frame_id="laser")
    field = {"angle_min": -math.pi, "angle_increment": math.pi / 180}
    return names(header=header, **field, ranges=np.full(360, 5.0), range_min=0.1, range_max=8.0)


def transform(time: float, x: float = 0.0) -> Any:
    rotation = names(x=0.0, y=0.0, z=0.0, w=1.0)
    found = names(translation=names(x=x, y=0.0), rotation=rotation)
    return names(header=names(stamp=stamp(time)), transform=found)


class Rig:
    """A navigator, a transform that tf2 would find, and what was ordered and said."""

    def __init__(self, policy: str, *, base: str = "", **parameters: Any) -> None:
        self.transform: Any = None
        values = PARAMETERS | {"policy": policy} | parameters
        frames = Frames(self.look_up, trust_stamps=values["trust_stamps"])
        self.navigator = Navigator(
            make_controller(values.__getitem__),
            frames,
            trust_stamps=values["trust_stamps"],
            turns=values["goal_heading"],
            base=base,
        )
        self.sent: list[tuple[float, float]] = []
        self.reason = ""

    def look_up(self, target: str, source: str) -> Any:
        if self.transform is None:
            raise RuntimeError("no such transform")
        return self.transform

    def tick(self, now: float) -> None:
        order = self.navigator.check(now)
        if order is not None:
            self.sent.append(order[:2])
            self.reason = order.reason

    def feed(self, now: float, frame: str = "odom", **motion: float) -> tuple[float, float]:
        """Odometry and a scan of now; what is ordered then."""
        self.navigator.feel(odometry(now, frame=frame, **motion), now)
        self.navigator.see(scan(now), now)
        self.tick(now)
        return self.sent[-1]

    def aim(self, frame: str, x: float = 4.0, stamp: float = 0.0, now: float = 10.0) -> None:
        self.navigator.aim((x, 0.0, 1.0), frame, stamp, now)
        self.tick(now)

    def begin(self, frame: str = "odom") -> Rig:
        """Have it drive to a goal."""
        self.navigator.feel(odometry(10.0), 10.0)
        self.aim(frame)
        assert self.feed(10.0) == DRIVES
        return self


def test_an_old_transform_stops_it_until_a_new_one_comes(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path))
    rig.transform = transform(10.0)
    rig.begin("map")
    assert rig.feed(10.9) == DRIVES
    assert rig.feed(11.1) == STANDS and rig.reason == "stale transform: 1.1 s old"
    assert rig.navigator.state == "waiting"
    rig.transform = transform(11.1)
    assert rig.feed(11.2) == DRIVES
    rig.transform = None
    assert rig.feed(12.0) == DRIVES
    assert rig.feed(12.2) == STANDS


def test_without_stamps_a_transform_ages_from_when_it_last_came(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path), trust_stamps=False)
    rig.transform = transform(500.0)
    rig.begin("map")
    assert rig.feed(10.9) == DRIVES
    assert rig.feed(11.1) == STANDS
    rig.transform = transform(501.0)
    assert rig.feed(11.2) == DRIVES


@pytest.mark.parametrize("frame", ["odom", "map"])
def test_a_goal_before_the_first_odometry_waits_for_it(tmp_path: Path, frame: str) -> None:
    rig = Rig(straight(tmp_path))
    rig.transform = transform(10.0)
    rig.aim(frame)
    rig.tick(10.0)
    assert rig.sent == [STANDS]  # One stop, then none.
    assert rig.navigator.state == "waiting" and rig.navigator.waits == (
        f"goal in frame {frame!r}: there was no odometry as new as the goal yet"
    )
    assert rig.feed(10.0) == DRIVES
    assert rig.navigator.controller.pilot.goal == (4.0, 0.0)


@pytest.mark.parametrize(("stamp", "since"), [(0.0, 10.3), (10.2, 10.2)])
def test_odometry_from_before_a_goal_does_not_count_for_it(
    tmp_path: Path, stamp: float, since: float
) -> None:
    rig = Rig(straight(tmp_path)).begin()
    # The robot was put elsewhere, and its odometry of before is still under way.
    rig.aim("odom", 8.0, stamp, now=10.3)
    assert rig.feed(since - 0.1) == STANDS
    assert rig.feed(since + 0.1, x=5.0) == DRIVES
    assert rig.navigator.state == "driving"


def test_a_goal_without_a_transform_waits_for_one(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path))
    rig.navigator.feel(odometry(10.0), 10.0)
    rig.aim("map")
    assert rig.feed(10.0) == STANDS
    assert rig.navigator.waits == "goal in frame 'map': no such transform"
    assert len(rig.sent) == 1
    rig.transform = transform(10.1, x=2.0)
    assert rig.feed(10.1) == DRIVES
    assert rig.navigator.controller.pilot.goal == (6.0, 0.0)


def test_odometry_without_a_frame_is_named(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path))
    rig.navigator.feel(odometry(10.0, frame=""), 10.0)
    rig.aim("odom")
    assert rig.navigator.waits == "goal in frame 'odom': the odometry names no frame"
    rig.aim("")
    assert rig.feed(10.0, frame="") == DRIVES


@pytest.mark.parametrize("frame", ["odom", "map"])
def test_odometry_of_another_frame_gives_up_the_goal(tmp_path: Path, frame: str) -> None:
    rig = Rig(straight(tmp_path))
    rig.transform = transform(10.0)
    rig.begin(frame)
    assert rig.feed(10.05, frame="odom2") == STANDS
    assert rig.reason == "odometry jumped: from frame 'odom' to 'odom2'"
    assert rig.navigator.state == "given up"
    sent = len(rig.sent)
    rig.tick(10.05)
    assert len(rig.sent) == sent
    rig.aim("odom2")
    assert rig.feed(10.1, frame="odom2") == DRIVES


def test_a_clock_that_jumps_back_or_ahead_stops_it_until_all_is_new(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path)).begin()
    rig.tick(20.0)
    assert rig.sent[-1] == STANDS and rig.reason == "stale scan: 10.0 s old"
    assert rig.feed(20.1, x=0.1) == DRIVES
    rig.tick(5.0)
    assert rig.sent[-1] == STANDS and rig.reason == "stale scan: -15.1 s old"
    assert rig.feed(5.1, x=0.1) == DRIVES


def test_a_cancel_stops_it_at_once_and_for_good(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path)).begin()
    rig.navigator.cancel()
    assert rig.feed(10.1) == STANDS and rig.navigator.state == "canceled"
    sent = len(rig.sent)
    rig.feed(10.2)
    assert len(rig.sent) == sent
    rig.navigator.cancel()
    rig.tick(10.3)
    assert len(rig.sent) == sent


def test_progress_counts_distance_and_time(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path)).begin()
    rig.feed(12.0, x=1.0)
    assert rig.navigator.progress(12.0) == (3.0, 2.0, 0)


@pytest.mark.parametrize("asked", [True, False])
def test_it_turns_to_the_heading_of_the_goal(tmp_path: Path, asked: bool) -> None:
    rig = Rig(turning(tmp_path), goal_heading=asked)
    rig.navigator.feel(odometry(10.0), 10.0)
    rig.aim("odom", x=0.1)
    linear, angular = rig.feed(10.1, speed=0.0)
    assert linear == 0.0 and (angular > 0.0) == asked
    assert rig.navigator.state == ("driving" if asked else "arrived")


def occupancy(frame: str, wall: int) -> Any:
    """A map of 8 x 6 m with a wall of cells with a chance, 4 m from its left edge, and a door."""
    cells = np.full((60, 80), -1)
    cells[:, 40] = wall
    cells[50:, 40] = 0
    place = names(position=names(x=-2.0, y=-3.0), orientation=names(x=0.0, y=0.0, z=0.0, w=1.0))
    info = names(width=80, height=60, resolution=0.1, origin=place)
    return names(header=names(frame_id=frame), info=info, data=cells.ravel().tolist())


@pytest.mark.parametrize("wall", [100, 40])
def test_it_knows_the_map_of_the_topic_where_localization_has_it(tmp_path: Path, wall: int) -> None:
    rig = Rig(turning(tmp_path, memory="map"), map_topic="map")
    message = occupancy("map", wall)
    rig.navigator.know(message)
    rig.transform = transform(10.0, x=1.0)
    rig.navigator.feel(odometry(10.0), 10.0)
    rig.aim("odom")
    rig.feed(10.0)
    pilot = rig.navigator.controller.pilot
    ground = pilot._ground
    assert pilot.plan is not None and ground.map is not None and ground.plan is not None
    # In the frame of the odometry the wall is at 3 m.
    arrays = ground.map._memory.arrays
    origin, levels = arrays.origins[0], arrays.levels[0]
    column = round((3.05 - ground.map._center[0] - origin[0]) / 0.1)
    blocked = (levels[column, 10:50] == 3).mean()
    assert blocked == 1.0 if wall == 100 else blocked < 0.3
    rig.transform = transform(10.2, x=1.5)
    rig.feed(10.2)
    assert ground.plan.pose == pytest.approx((-0.5, -3.0, 0.0))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"map_topic": "map"}, "map_topic must be '' for a policy without a map"),
        ({"rate": 0.0}, "rate must be positive, got 0"),
    ],
)
def test_parameters_that_do_not_fit_are_rejected(
    tmp_path: Path, parameters: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Rig(straight(tmp_path), **parameters)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "burger"}, "robot cannot change while the node is configured: clean it up"),
        ({"goal_radius": 0.0}, "goal_radius must be positive, got 0"),
        ({"scan_timeout": math.nan}, "scan_timeout must be"),
        ({"clearance": -0.1}, "clearance must"),
        ({"clearance": 0.0}, "clearance must stay positive while the node is configured"),
    ],
)
def test_changes_that_a_driving_robot_cannot_take_are_rejected(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    rig = Rig(turning(tmp_path), clearance=0.03)
    with pytest.raises(ValueError, match=message):
        check_change(changes, rig.navigator.controller)


def test_changes_that_it_takes_hold_from_then_on(tmp_path: Path) -> None:
    controller = Rig(turning(tmp_path), clearance=0.03).navigator.controller
    changes = {"clearance": 0.1, "goal_radius": 0.2, "scan_timeout": 2.0, "use_sim_time": True}
    before = controller.pilot._keep
    check_change(changes, controller)
    change(changes, controller)
    assert controller.pilot.goal_radius == 0.2 and controller.scan_timeout == 2.0
    assert controller.pilot.has_filter and controller.pilot._keep is not before


@pytest.mark.parametrize(
    ("turn", "roll"), [((0.0, 0.0, 1.0, 0.0), 0.0), ((1.0, 0.0, 0.0, 0.0), math.pi)]
)
def test_the_lidar_is_where_its_frame_is(
    tmp_path: Path, turn: tuple[float, ...], roll: float
) -> None:
    rig = Rig(straight(tmp_path), base="base_link", mount=[0.01, 0.0, 0.0])
    sectors = rig.navigator.controller.pilot.sectors
    rig.navigator.see(scan(10.0), 10.0)
    assert sectors.mount == (0.01, 0.0, 0.0)  # The parameter's, as tf2 does not know it yet.
    found = transform(0.0, x=-0.04)
    found.transform.rotation = names(**dict(zip("xyzw", turn, strict=True)))
    rig.transform = found
    rig.navigator.see(scan(10.1), 10.1)
    assert sectors.mount == pytest.approx((-0.04, 0.0, math.pi if not roll else 0.0))
    assert (sectors._side < 0.0) == (roll > 0.0)


def test_the_body_is_the_frame_of_the_odometry_unless_it_is_named(tmp_path: Path) -> None:
    rig, asked = Rig(straight(tmp_path)), []
    rig.transform = transform(0.0, x=0.02)
    rig.navigator.frames._lookup = lambda *frames: asked.append(frames) or rig.look_up(*frames)
    rig.navigator.see(scan(10.0), 10.0)
    assert asked == [] and "by the parameter mount" in rig.navigator.lidar
    message = odometry(10.1)
    message.child_frame_id = "base_footprint"
    rig.navigator.feel(message, 10.1)
    rig.navigator.see(scan(10.1), 10.1)
    assert asked == [("base_footprint", "laser")]
    assert rig.navigator.lidar == (
        "lidar at (0.020, 0.000) m, looks to 0 degrees, by tf2: 'laser' in 'base_footprint'"
    )


@pytest.mark.parametrize(
    ("learned_behind_it", "clearance", "kept"),
    [(True, -1.0, 0.03), (True, 0.0, None), (True, 0.1, 0.1), (False, -1.0, None)],
)
def test_the_filter_is_there_where_the_policy_needs_it_unless_it_is_switched_off(
    tmp_path: Path, learned_behind_it: bool, clearance: float, kept: float | None
) -> None:
    layer = Linear(np.zeros((2, 42), np.float32), np.ones(2, np.float32))
    robot = {"robot": "kobuki", "physics": "kinematic"}
    policy = Policy([layer], card={"filter": learned_behind_it}, env_arguments=robot)
    file = str(export_policy(policy, tmp_path / "policy.onnx"))
    keep = Rig(file, clearance=clearance).navigator.controller.pilot._keep
    assert (None if keep is None else keep.body.clearance) == kept


def test_a_planner_drives_without_a_policy() -> None:
    rig = Rig("", driver="mpc", robot="kobuki")
    pilot = rig.navigator.controller.pilot
    assert pilot.has_filter and pilot.robot.name == "kobuki"
    rig.navigator.feel(odometry(10.0, speed=0.0), 10.0)
    rig.navigator.see(scan(10.0), 10.0)
    rig.navigator.aim((2.0, 0.0, 0.0), "odom", 0.0, 10.0)
    rig.navigator.feel(odometry(10.1, speed=0.0), 10.1)
    rig.navigator.see(scan(10.1), 10.1)
    rig.tick(10.1)
    rig.tick(10.2)
    assert rig.navigator.state == "driving" and rig.sent[-1][0] > 0.0


@pytest.mark.parametrize(
    "given", [{"driver": "mpc"}, {"driver": "mpc", "robot": "kobuki", "policy": "policy.onnx"}]
)
def test_a_planner_needs_a_robot_and_no_policy(given: dict[str, Any]) -> None:
    policy = given.pop("policy", "")
    with pytest.raises(ValueError, match="driver must be 'policy' with a policy"):
        Rig(policy, **given)


def test_a_lidar_outside_of_the_robot_is_an_error(tmp_path: Path) -> None:
    rig = Rig(straight(tmp_path), base="base_link")
    rig.transform = transform(0.0, x=3.0)
    with pytest.raises(ValueError, match="mount must be"):
        rig.navigator.see(scan(10.0), 10.0)
