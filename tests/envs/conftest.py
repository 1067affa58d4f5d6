"""What the tests of the environment share."""

from __future__ import annotations

import pytest


def pytest_configure(config: pytest.Config) -> None:
    # TorchRL 0.14 warns about classes of its own whenever its collectors are imported.
    config.addinivalue_line(
        "filterwarnings",
        "ignore:Creating .* which inherits from WeightUpdaterBase:DeprecationWarning",
    )


@pytest.fixture(params=["kinematic", "wheels"])
def physics(request: pytest.FixtureRequest) -> str:
    return request.param
