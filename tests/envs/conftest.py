"""What the tests of the environment share."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

if find_spec("pybullet") is None:  # Python 3.12 and later
    collect_ignore = [
        "test_environment_benchmark.py",
        "test_lidar.py",
        "test_robot.py",
        "test_simulation_release.py",
    ]


@pytest.fixture
def wheels() -> None:
    pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 and earlier")


@pytest.fixture(params=["kinematic", "wheels"])
def physics(request: pytest.FixtureRequest) -> str:
    if request.param == "wheels":
        request.getfixturevalue("wheels")
    return request.param
