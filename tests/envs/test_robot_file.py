"""Robots in YAML files, and whatever takes a robot."""

from __future__ import annotations

import re
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    EXAMPLE_ROBOT,
    ROBOTS,
    ROOMS_TASK,
    Policy,
    RobotFileError,
    RobotModel,
    SafetyFilter,
    TaskConfig,
    VectorNavigationEnv,
    evaluate,
    load_policy,
    load_robot,
    make_planner,
    save_policy,
)
from mpfa_envs.policies.layers import Linear
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.ros.simulated_robot import SimulatedRobot

CART = load_robot(EXAMPLE_ROBOT)
UNIT = re.compile(r"\[(?:[^\[\]]*\b)?(m|kg|deg|s|m/s|m/s²|rad/s|rad/s²|m, m, rad)\]$")


def changed(line: str) -> str:
    """The example with another line for its key."""
    key = line.partition(":")[0]
    text = EXAMPLE_ROBOT.read_text(encoding="utf-8")
    return re.sub(rf"^{key}:.*$", line, text, flags=re.MULTILINE)


def written(folder: Path, robot: RobotModel) -> Path:
    """A robot as a file, without its name."""
    file = folder / f"{robot.name}.yaml"
    lines = (f"{key}: {value}\n" for key, value in asdict(robot).items() if value is not None)
    file.write_text(
        "".join(each for each in lines if not each.startswith("name:"))
        .replace("(", "[")
        .replace(")", "]")
    )
    return file


def test_the_example_has_each_field_and_its_unit() -> None:
    keys = {}
    for line in EXAMPLE_ROBOT.read_text(encoding="utf-8").splitlines()[1:]:
        key, _, rest = line.partition(":")
        keys[key] = UNIT.search(rest) is not None
    assert list(keys) == [field.name for field in fields(RobotModel)]
    assert [key for key, has_unit in keys.items() if not has_unit] == [
        "name",
        "reverse",
        "lidar_rays",
    ]


@pytest.mark.parametrize("robot", [*ROBOTS.values(), CART])
def test_a_robot_comes_back_from_its_file_and_its_fields(robot: RobotModel, tmp_path: Path) -> None:
    file = written(tmp_path, robot)
    short = file.with_suffix(".yml")
    short.write_bytes(file.read_bytes())
    choices: list[RobotChoice] = [robot, asdict(robot), file, str(file), str(short)]
    assert [resolve_robot(choice) for choice in choices] == [robot] * 5


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("radius: wide", "radius must be a number in m, got 'wide'"),
        ("radius: -1", "radius must be positive, got -1.0"),
        ("mass: heavy", "mass must be a number in kg, got 'heavy'"),
        ("turn_limit: null", "turn_limit must be a number in rad/s, got 'null'"),
        ("turn_acceleration: 0", "turn_acceleration must be positive, got 0.0"),
        ("reverse: never", "reverse must be true or false, got 'never'"),
        ("wheel_base: 0.9", "wheel_base must be at most the diameter 0.56, got 0.9"),
        ("min_wheel_speed: 2", "min_wheel_speed must be below max_wheel_speed = 0.9, got 2.0"),
        ("field_of_view: 400", "field_of_view must be at most 360 deg in size, got 400"),
        ("lidar_rays: 10.5", "lidar_rays must be a positive integer, got 10.5"),
        ("lidar_range: 0", "lidar_range must be positive, got 0.0"),
        ("lidar_mount: 3", "lidar_mount must be a list"),
        ("lidar_mount: [0.3, 0, 0]", r"lidar_mount must be .* radius 0.28 m .*got \(0.3, 0\)"),
        ("lidar_mount: [1, 2]", "lidar_mount must be 3 numbers, .* got 2"),
        ("lidar_mount: [0, 0, 0, 1]", "lidar_mount must have a roll of 0 or π, .* got 1.0"),
    ],
)
def test_an_error_names_file_line_key_and_value(line: str, message: str, tmp_path: Path) -> None:
    text = changed(line)
    file = tmp_path / "bad.yaml"
    file.write_text(text, encoding="utf-8")
    number = text.splitlines().index(line) + 1
    with pytest.raises(RobotFileError, match=rf"bad\.yaml:{number}: {message}"):
        load_robot(file)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ("cart", r"robot must be .* \.yaml file or one of .*, got 'cart'"),
        ({"radus": 1}, r"fields of RobotModel, got 'radus'; did you mean 'radius'\?"),
        ({**asdict(CART), "mass": 0}, "mass must be positive, got 0"),
        (3, "robot must be .*got 3"),
    ],
)
def test_what_is_no_robot_is_rejected(robot: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        resolve_robot(robot)


def test_each_part_takes_the_file() -> None:
    file = str(EXAMPLE_ROBOT)
    env = VectorNavigationEnv(2, **ROOMS_TASK | {"robot": file})
    made = [env.config.robot, make_planner("dwa", robot=file).robot]
    made += [
        make_planner("astar", robot=file).robot,
        SimulatedRobot(robot=file, physics="kinematic").robot,
    ]
    senses = {"angles": env.config.make_lidar().angles, "sectors": 36, "max_range": 10.0}
    made += [SafetyFilter(file, closeness_distance=0.28, **senses).robot]
    assert made == [CART] * 5
    env.close()


@pytest.mark.parametrize("robot", ["kobuki", CART, str(EXAMPLE_ROBOT)])
def test_a_policys_file_alone_drives_its_robot(robot: RobotChoice, tmp_path: Path) -> None:
    task = {"robot": robot, "physics": "kinematic"}
    size = max(part.stop for part in TaskConfig(**task).observation_slices.values())
    layers = [Linear(np.zeros((2, size), np.float32), np.ones(2, np.float32))]
    policy = Policy(layers, env_arguments=task)
    save_policy(policy, tmp_path)
    loaded = load_policy(tmp_path)
    assert resolve_robot(loaded.env_arguments["robot"]) == resolve_robot(robot)
    assert loaded.env_arguments["robot"]["radius"] == resolve_robot(robot).radius
    found = evaluate(loaded, "rooms:validation", episodes=2, max_steps=20)
    assert found == evaluate(policy, "rooms:validation", episodes=2, max_steps=20)
