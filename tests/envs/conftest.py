"""What the tests of the environment share."""

from __future__ import annotations

import pytest


@pytest.fixture(params=["kinematic", "wheels"])
def physics(request: pytest.FixtureRequest) -> str:
    if request.param == "wheels":  # Some tests drive in another process, whose error says nothing.
        pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 and earlier")
    return request.param
