"""Robots whose files name parameter files of ``diff_drive_controller``, Nav2 and ROS 1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mpfa_envs import RobotFileError, RobotModel, load_robot

OWN = {"height": 0.2, "mass": 3.0, "field_of_view": 360.0}
"""What neither file has."""

DRIVE = """
controller_manager:
  ros__parameters:
    update_rate: 20
    base_controller:
      type: diff_drive_controller/DiffDriveController

mecanum_controller:
  ros__parameters: {wheel_separation_x: 0.1, wheel_radius: 0.04, linear.x.max_velocity: 0.6}

/base_controller:
  ros__parameters:
    left_wheel_names: [fl_wheel_joint, rl_wheel_joint]
    wheel_separation: 0.186
    wheel_radius: 0.0425
    # Wheels slip, as four of them stand in two rows.
    wheel_separation_multiplier: 1.45
    pose_covariance_diagonal: [0.1, 0.1, 0.1, 0.1, 0.1, 0.1]
    linear:
      x:
        has_velocity_limits: true
        max_velocity: 0.9  # m/s
        has_acceleration_limits: true
        max_acceleration: 1.0  # m/s^2
        min_acceleration: -0.8
        max_deceleration: .NaN  # limits nothing
        max_jerk: .nan
    angular.z.max_velocity: 3.0
    angular:
      z.has_acceleration_limits: true
      z.max_acceleration: 4.0
      z.max_deceleration: -3.5
"""
NAV2 = """
amcl:
  ros__parameters: {min_particles: 500, robot_model_type: nav2_amcl::DifferentialMotionModel}
controller_server:
  ros__parameters:
    controller_plugins: ["FollowPath"]
    FollowPath:
      plugin: "dwb_core::DWBLocalPlanner"
      min_vel_x: -0.2
      max_vel_x: 0.5
      max_vel_theta: 3.2
      acc_lim_x: 2.5
      acc_lim_theta: 3.2
      decel_lim_x: -0.6
local_costmap:
  local_costmap:
    ros__parameters: {robot_radius: 0.5, footprint: "[[.12, 0.09], [-0.3, 0.4], [-0.12, -0.09]]"}
global_costmap:
  global_costmap:
    ros__parameters:
      robot_radius: 0.22
"""
DRIVEN = {
    "wheel_base": 0.186 * 1.45,
    "wheel_radius": 0.0425,
    "max_wheel_speed": 0.9,
    "min_wheel_speed": -0.9,
    "wheel_acceleration": 1.0,
    "deceleration": 0.8,
    "turn_limit": 3.0,
    "turn_acceleration": 3.5,
    "reverse": True,
}
PLANNED = {
    "radius": 0.5,
    "max_wheel_speed": 0.5,
    "min_wheel_speed": -0.2,
    "wheel_acceleration": 2.5,
    "deceleration": 0.6,
    "turn_limit": 3.2,
    "turn_acceleration": 3.2,
    "reverse": True,
}


BOMB = "a: &a0 [x]\n" + "".join(f"b{i}: &a{i + 1} [{f'*a{i}, ' * 9}]\n" for i in range(30))
"""Lists of lists that stand for more entries than any memory has."""


def robot_of(folder: Path, own: dict[str, Any], *controllers: str) -> RobotModel:
    """Read a robot whose files of the controller have these texts."""
    names = [f"controller{number}.yaml" for number in range(len(controllers))]
    for name, text in zip(names, controllers, strict=True):
        (folder / "config").mkdir(exist_ok=True)
        (folder / "config" / name).write_text(text, encoding="utf-8")
    paths = [f"config/{name}" for name in names]
    entries = {"controller": paths[0] if len(paths) == 1 else f"[{', '.join(paths)}]"} | OWN | own
    lines = [f"{key}: {value}\n" for key, value in entries.items()]
    (folder / "cart.yaml").write_text("".join(lines), encoding="utf-8")
    return load_robot(folder / "cart.yaml")


def values_of(robot: RobotModel, expected: dict[str, Any]) -> dict[str, Any]:
    return {key: getattr(robot, key) for key in expected}


def test_a_drive_controller_fills_the_fields_left_out(tmp_path: Path) -> None:
    robot = robot_of(tmp_path, {"radius": 0.2}, DRIVE)
    assert values_of(robot, DRIVEN) == pytest.approx(DRIVEN)
    assert values_of(robot, OWN) == OWN


@pytest.mark.parametrize("texts", [(DRIVE, NAV2), (NAV2, DRIVE)])
def test_of_two_limits_the_smaller_one_counts(texts: tuple[str, str], tmp_path: Path) -> None:
    smaller = {
        "max_wheel_speed": 0.5,
        "min_wheel_speed": -0.2,
        "wheel_acceleration": 1.0,
        "deceleration": 0.6,
        "turn_limit": 3.0,
        "turn_acceleration": 3.2,
        "radius": 0.5,
    }
    robot = robot_of(tmp_path, {}, *texts)
    assert values_of(robot, smaller) == pytest.approx(smaller)


def test_a_number_of_the_robots_own_file_wins(tmp_path: Path) -> None:
    own = {"radius": 0.3, "max_wheel_speed": 1.2, "turn_limit": 5.0, "wheel_base": 0.4}
    robot = robot_of(tmp_path, own, DRIVE, NAV2)
    assert values_of(robot, own) == own
    assert robot.deceleration == 0.6


@pytest.mark.parametrize(
    ("text", "own", "expected"),
    [
        (NAV2.replace("-0.2\n", "0.0\n"), {}, (False, -3.2 * 0.3 / 2)),
        (NAV2.replace("-0.2\n", "0.05\n"), {}, (False, -3.2 * 0.3 / 2)),
        (NAV2, {"reverse": "false", "turn_limit": 1.0}, (False, -1.0 * 0.3 / 2)),
        (NAV2.replace("-0.2\n", "0.0\n"), {"reverse": "true"}, (True, -0.5)),
        (NAV2.replace("-0.2\n", "0.0\n"), {"min_wheel_speed": 0.0}, (False, 0.0)),
    ],
)
def test_a_body_that_must_not_reverse_still_turns_on_the_spot(
    text: str, own: dict[str, Any], expected: tuple[bool, float], tmp_path: Path
) -> None:
    robot = robot_of(tmp_path, {"wheel_base": 0.3, "wheel_radius": 0.04} | own, text)
    assert (robot.reverse, robot.min_wheel_speed) == (expected[0], pytest.approx(expected[1]))


def test_a_limit_that_is_switched_off_does_not_count(tmp_path: Path) -> None:
    text = DRIVE.replace("velocity_limits: true", "velocity_limits: False")
    text = text.replace("limits: true", "limits: false").replace("max_velocity: 3.0", "x: 1")
    text = text.replace("max_velocity: 0.9", "max_velocity: 0.1\n        min_velocity: 0.0")
    own = {"radius": 0.2, "max_wheel_speed": 0.7}
    robot = robot_of(tmp_path, own, text)
    assert (robot.max_wheel_speed, robot.min_wheel_speed, robot.reverse) == (0.7, -0.7, True)
    limits = "wheel_acceleration", "deceleration", "turn_limit", "turn_acceleration"
    assert [getattr(robot, name) for name in limits] == [None] * 4


@pytest.mark.parametrize(
    ("shape", "radius"),
    [
        ("[[0.3, 0.2], [-0.3, 0.4]]", 0.5),
        ('"[[0.3, 0.2], [-0.3, 0.4]]"', 0.5),
        ('"[]"\n      robot_radius: 0.25', 0.25),
        ('"[[0.3, 0.0]]"\n      robot_radius: 0.45', 0.3),
    ],
)
def test_a_footprint_reaches_to_its_farthest_corner(
    shape: str, radius: float, tmp_path: Path
) -> None:
    text = f"local_costmap:\n  local_costmap:\n    ros__parameters:\n      footprint: {shape}\n"
    assert robot_of(tmp_path, {}, DRIVE, text).radius == pytest.approx(radius)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("world: B\nsize: 3\n", ":1: the file must have .*diff_drive_controller.* or Nav2"),
        ("wheel_radius: 0.1\n", ":1: the file must have .*diff_drive_controller.* or Nav2"),
        ("linear.x.max_velocity: 1.0\n", ":1: the file must have .*wheel_separation"),
        ("", ":1: the file must have .*diff_drive_controller.* or Nav2"),
        ("- 1\n", ":1: the file must have"),
        ("{", ":1: is not YAML"),
        ("a: !!python/object/apply:os.abort []\n", ":1: the file must have"),
        ("a: &a\n  b: *a\n", ":1: must have no alias"),
        ("a: 1\nmax_vel_x: fast\n", ":2: max_vel_x must be a number in m/s, got 'fast'"),
        (BOMB, ":1: the file must have"),
        ("max_vel_x: [1]\n", ":1: max_vel_x must be a number in m/s"),
        ("a:\n  footprint: round\n", r":2: footprint must be corners \[\[x, y\], ...\] in m"),
        ("footprint: ''\n", ":1: footprint must be corners"),
        ("footprint: '[[1], [2]]'\n", ":1: footprint must be corners"),
        ("wheel_separation: 1.5\n", ":1: wheel_base must be at most the diameter 0.4, got 1.5"),
        ("a: 1\nmax_vel_x: 900\n", ":2: max_wheel_speed must be at most 20 m/s in size, got 900"),
    ],
)
def test_an_error_names_the_line_of_both_files(text: str, message: str, tmp_path: Path) -> None:
    own = {"radius": 0.2, "wheel_radius": 0.04}
    own |= {} if "wheel_sep" in text else {"wheel_base": 0.3}
    own |= {"min_wheel_speed": -0.5} if "max_vel" in text else {"max_wheel_speed": 0.5}
    with pytest.raises(RobotFileError, match=rf"cart\.yaml:1: .*controller0\.yaml{message}"):
        robot_of(tmp_path, own, text)


COSTMAP = "local_costmap: {local_costmap: {ros__parameters: {robot_radius: 0.22}}}\n"
DWB = (
    "controller_server: {ros__parameters: {FollowPath: {min_vel_x: -0.5, max_vel_x: 0.5, "
    "acc_lim_x: 2.5, decel_lim_x: -2.5, max_vel_theta: 2.0, acc_lim_theta: 3.2}}}\n"
)
BARE = {"wheel_base": 0.3, "wheel_radius": 0.04, "radius": 0.2}
FAST = {"max_wheel_speed": 0.9, "min_wheel_speed": -0.9}


def smoother(**lists: list[float]) -> str:
    """The file of Nav2's last node before the wheels."""
    entries = ", ".join(f"{name}: {values}" for name, values in lists.items())
    return f"velocity_smoother: {{ros__parameters: {{smoothing_frequency: 20.0, {entries}}}}}\n"


def plugin(parameters: str, name: str = "FollowPath") -> str:
    return f"controller_server: {{ros__parameters: {{{name}: {{{parameters}}}}}}}\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (smoother(max_velocity=[0.2, 0.0, 0.5]), {"max_wheel_speed": 0.2, "turn_limit": 0.5}),
        (smoother(min_velocity=[-0.1, 0.0, -0.6]), {"min_wheel_speed": -0.1, "turn_limit": 0.6}),
        (
            smoother(max_accel=[0.4, 0.0, 1.2], max_decel=[-0.3, 0.0, -1.1]),
            {"wheel_acceleration": 0.4, "deceleration": 0.3, "turn_acceleration": 1.1},
        ),
        (
            smoother(max_velocity=[0.2, 0.0, 0.0, 0.0, 0.0, 0.7]),
            {"max_wheel_speed": 0.2, "turn_limit": 0.7},
        ),
        (
            plugin("vx_max: 0.3, vx_min: -0.2, wz_max: 0.4, ax_max: 1.0, ax_min: -2, az_max: 1.5"),
            {
                "max_wheel_speed": 0.3,
                "min_wheel_speed": -0.2,
                "turn_limit": 0.4,
                "wheel_acceleration": 1.0,
                "deceleration": 2.0,
                "turn_acceleration": 1.5,
            },
        ),
        (
            plugin(
                "desired_linear_vel: 0.3, rotate_to_heading_angular_vel: 0.8, "
                "max_angular_accel: 1.6, allow_reversing: false"
            ),
            {
                "max_wheel_speed": 0.3,
                "turn_limit": 0.8,
                "turn_acceleration": 1.6,
                "reverse": False,
            },
        ),
        (
            plugin(
                "max_linear_vel: 0.3, min_linear_vel: -0.1, max_angular_vel: 0.9, "
                "min_angular_vel: -0.8, max_linear_accel: 1.0, max_linear_decel: -0.9, "
                "max_angular_accel: 2.0, max_angular_decel: -1.8"
            ),
            {
                "max_wheel_speed": 0.3,
                "min_wheel_speed": -0.1,
                "turn_limit": 0.8,
                "wheel_acceleration": 1.0,
                "deceleration": 0.9,
                "turn_acceleration": 1.8,
            },
        ),
        (
            plugin("v_linear_min: 0.1, v_linear_max: 0.4, v_angular_max: 0.7, v_angular_min: 0.2"),
            {"max_wheel_speed": 0.4, "min_wheel_speed": -0.5, "turn_limit": 0.7},
        ),
        (plugin("max_speed_xy: 0.45, decel_lim_theta: -3.0"), {"max_wheel_speed": 0.45}),
        (plugin("max_speed_xy: -1.0, decel_lim_theta: -3.0"), {"turn_acceleration": 3.0}),
        (
            "TebLocalPlannerROS: {max_vel_x: 0.42, max_vel_x_backwards: 0.11, max_vel_trans: 0.0}",
            {"max_wheel_speed": 0.42, "min_wheel_speed": -0.11, "reverse": True},
        ),
        ("TebLocalPlannerROS: {max_vel_x_backwards: 0.0}", {"reverse": False}),
        (
            "DWAPlannerROS: {max_trans_vel: 0.3, max_rot_vel: 0.9, min_rot_vel: 0.4, "
            "acc_lim_x: 1.0, acc_lim_th: 1.7}",
            {"max_wheel_speed": 0.3, "turn_limit": 0.9, "turn_acceleration": 1.7},
        ),
        (
            "TrajectoryPlannerROS: {max_rotational_vel: 0.8, min_vel_theta: -0.7, acc_limit_x: 1}",
            {"turn_limit": 0.7, "wheel_acceleration": 1.0},
        ),
        (
            "speed_lim_v: 0.2\nspeed_lim_w: 0.6\naccel_lim_v: 0.5\naccel_lim_w: 1.5\n",
            {
                "max_wheel_speed": 0.2,
                "turn_limit": 0.6,
                "wheel_acceleration": 0.5,
                "turn_acceleration": 1.5,
            },
        ),
        (
            "base_controller: {left_wheel: a, right_wheel: b, linear: {x: {max_velocity: 0.2, "
            "max_acceleration_reverse: 0.8}}, angular: {z: {min_velocity: -0.9}}}",
            {"max_wheel_speed": 0.2, "wheel_acceleration": 0.8, "turn_limit": 0.9},
        ),
    ],
    ids=lambda value: str(value)[:40],
)
def test_the_smallest_limit_counts_by_whatever_name(
    text: str, expected: dict[str, Any], tmp_path: Path
) -> None:
    robot = robot_of(tmp_path, BARE, COSTMAP + DWB, text)
    assert values_of(robot, expected) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("cruise_speed_limit: 0.2", "max_wheel_speed"),
        ("limits: {maxLinearVelocity: 0.2}", "max_wheel_speed"),
        ("velocity_smoother: {max_velocity: 0.2}", "max_wheel_speed"),
        ("max_backward_speed: 0.1", "min_wheel_speed"),
        ("limiter: {angular: {max_velocity: 0.5}}", "turn_limit"),
        ("limiter: {linear: {x: {max_velocity: 0.2}}}", "max_wheel_speed"),
        ("acceleration_limits: [0.5, 0.5]", "wheel_acceleration"),
        ("maximum_deceleration: 0.5", "deceleration"),
        ("max_yaw_acc: 0.5", "turn_acceleration"),
    ],
)
def test_a_limit_of_an_unknown_name_must_stand_in_the_robots_file(
    text: str, field: str, tmp_path: Path
) -> None:
    own = BARE | FAST
    own = {key: own[key] for key in own if key != field}
    key = text.rpartition("{")[2].partition(":")[0]
    message = rf"controller0\.yaml:3: (.*\.)?{key} is a limit that is not read: write {field} in"
    with pytest.raises(RobotFileError, match=message):
        robot_of(tmp_path, own, COSTMAP + DWB + text)
    limit = -0.1 if field == "min_wheel_speed" else 0.2
    assert getattr(robot_of(tmp_path, own | {field: limit}, COSTMAP + DWB + text), field) == limit


@pytest.mark.parametrize(
    "text",
    [
        "docking_server: {ros__parameters: {controller: {v_linear_max: 0.05, v_angular_max: 0.1}}}",
        "behavior_server: {ros__parameters: {max_rotational_vel: 0.1, rotational_acc_lim: 0.1}}",
        "collision_monitor: {ros__parameters: {Slow: {linear_limit: 0.1, max_speed: 0.1}}}",
        "/robot/following_server: {ros__parameters: {controller: {v_linear_max: 0.05}}}",
        "teleop_twist_joy: {ros__parameters: {max_speed: 0.1}}",
        "joint_limits: {arm: {has_velocity_limits: true, max_velocity: 0.1}}",
        "mecanum: {wheel_separation_x: 0.2, linear.x.max_velocity: 0.1}",
        "x: {min_x_velocity_threshold: 0.1, deadband_velocity: [0.1, 0, 0.1], max_vel_y: 0.1, "
        "min_speed_xy: -0.1, weight_max_vel_x: 0.1, speed_limit_topic: a, limit_vel: true}",
    ],
)
def test_a_limit_of_what_does_not_drive_to_a_goal_does_not_count(text: str, tmp_path: Path) -> None:
    expected = robot_of(tmp_path, BARE, COSTMAP + DWB)
    assert robot_of(tmp_path, BARE, COSTMAP + DWB + text) == expected


@pytest.mark.parametrize(
    ("plugins", "speed"),
    [
        ("controller_plugins: [FollowPath, Slow], FollowPath: {max_vel_x: 0.5}", 0.5),
        ("controller_plugins: [Slow, FollowPath], FollowPath: {max_vel_x: 0.5}", 0.5),
        ("controller_plugins: [FollowPath], FollowPath: {max_vel_x: 0.5}", 0.5),
        ("controller_plugins: [Fast, DockingController], Fast: {max_vel_x: 0.5}", 0.5),
        ("controller_plugins: [Fast, Slow], Fast: {max_vel_x: 0.5}", 0.05),
        ("Fast: {max_vel_x: 0.5}, DockApproach: {max_vel_x: 0.05}", 0.5),
    ],
)
def test_of_several_controllers_the_one_that_drives_counts(
    plugins: str, speed: float, tmp_path: Path
) -> None:
    others = ", ".join(
        f"{name}: {{plugin: p, max_vel_x: 0.05, inner: {{vx_max: 0.05}}}}"
        for name in ("Slow", "DockingController")
    )
    text = f"controller_server: {{ros__parameters: {{{plugins}, {others}}}}}\n"
    if "controller_plugins" not in plugins:
        text = f"controller_server: {{ros__parameters: {{{plugins}}}}}\n"
    robot = robot_of(tmp_path, BARE | {"min_wheel_speed": -0.04}, text + COSTMAP)
    assert robot.max_wheel_speed == speed


def test_a_rotation_that_is_switched_off_does_not_limit_the_turn(tmp_path: Path) -> None:
    text = plugin("use_rotate_to_heading: false, rotate_to_heading_angular_vel: 0.0")
    assert robot_of(tmp_path, BARE, DWB, text + COSTMAP).turn_limit == 2.0


def test_a_list_of_a_smoother_must_have_an_entry_for_each_axis(tmp_path: Path) -> None:
    text = smoother(max_velocity=[0.2, 0.5])
    with pytest.raises(
        RobotFileError, match=r":1: max_velocity must be \[x, y, theta\] or .*got 2"
    ):
        robot_of(tmp_path, BARE, text)
