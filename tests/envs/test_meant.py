"""Numbers that nobody means: in another unit, or with the point in another place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    EXAMPLE_ROBOT,
    ROBOTS,
    RobotModel,
    TaskConfig,
    load_robot,
    load_world,
)
from mpfa_envs.robots.robot_file import RobotFileError
from tests.envs.map_files import write_map


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"radius": 310}, r"radius must be at most 5 m in size, got 310; did you mean 0.31, "),
        ({"mass": 6300}, "did you mean 6.3, which is 6300 grams"),
        ({"lidar_range": 8000}, "lidar_range must be at most 300 m .* did you mean 8, "),
        ({"turn_acceleration": 115}, "did you mean 2.007, which is 115 deg/s²"),
        ({"lidar_mount": (120, 0, 0)}, "lidar_mount must .* did you mean 0.12, "),
        ({"lidar_mount": (0.1, 0, -90)}, "at most 6.283 rad in size, .* did you mean -1.571, "),
        ({"field_of_view": 4.19}, "at least 7 deg .* did you mean 240.1, which is 4.19 radians"),
        ({"max_wheel_speed": 900}, "did you mean 0.9, which is 900 mm/s"),
        ({"turn_limit": 180}, "did you mean 3.142, which is 180 deg/s"),
    ],
)
def test_a_measure_of_a_robot_in_another_unit_is_answered_by_the_one_meant(
    changes: Mapping[str, Any], text: str
) -> None:
    with pytest.raises(ValueError, match=text):
        RobotModel(**{**asdict(ROBOTS["kobuki"]), **changes})


@pytest.mark.parametrize(
    ("task", "text"),
    [
        ({"time_step": 100}, "time_step must be at most 10 s .* did you mean 0.1, "),
        ({"goal_radius": 10}, "goal_radius must be at most 5 m .* did you mean 0.1, "),
        ({"lidar": {"max_range": 8000}}, "max_range must .* did you mean 8, "),
        ({"lidar": {"field_of_view": 3.14, "sectors": 18}}, "did you mean 179.9, "),
        ({"noise": {"range_noise": 20}}, "did you mean 0.02, "),
    ],
)
def test_a_number_of_a_task_in_another_unit_is_answered_by_the_one_meant(
    task: Mapping[str, Any], text: str
) -> None:
    with pytest.raises(ValueError, match=text):
        TaskConfig(**task)


def test_a_robot_file_in_millimeters_is_rejected_at_its_line(tmp_path: Path) -> None:
    text = EXAMPLE_ROBOT.read_text(encoding="utf-8")
    path = tmp_path / "cart.yaml"
    path.write_text(text.replace("radius: 0.28", "radius: 280"), encoding="utf-8")
    with pytest.raises(RobotFileError, match=r"cart.yaml:\d+: radius .* did you mean 0.28, "):
        load_robot(path)


@pytest.mark.parametrize(
    ("key", "field"),
    [
        ("wheel_separation", "wheel_base"),
        ("diameter", "radius"),
        ("wheel_diameter", "wheel_radius"),
        ("max_angular_speed", "turn_limit"),
        ("max_vel_theta", "turn_limit"),
        ("acc_lim_theta", "turn_acceleration"),
    ],
)
def test_a_key_of_another_tool_is_answered_by_the_field(
    tmp_path: Path, key: str, field: str
) -> None:
    (tmp_path / "cart.yaml").write_text(f"{key}: 0.3\n")
    with pytest.raises(RobotFileError, match=f"unknown key {key!r} .* did you mean {field!r}"):
        load_robot(tmp_path / "cart.yaml")


HALL = np.full((240, 360), 254, np.uint8)


@pytest.mark.parametrize(
    ("resolution", "size"), [(0.5, "180 x 120"), (0.005, "1.8 x 1.2"), (1.0, "360 x 240")]
)
def test_cells_of_a_map_that_nobody_means_are_warned_of(
    tmp_path: Path, resolution: float, size: str
) -> None:
    with pytest.warns(UserWarning, match=rf"map.yaml:2: .* of {size} m; did you mean 0\.?[01]"):
        load_world(write_map(tmp_path, HALL, resolution=resolution))
