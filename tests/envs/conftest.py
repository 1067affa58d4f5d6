"""What the tests of the environment share."""

from __future__ import annotations

import pytest


@pytest.fixture(params=["kinematic", "wheels"])
def physics(request: pytest.FixtureRequest) -> str:
    return request.param
