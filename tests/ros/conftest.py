"""What stands around nodes in processes of their own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def bench() -> Iterator[Any]:
    # Imported here, as the other tests need no rclpy.
    import rclpy

    from tests.ros.live import choose_domain
    from tests.ros.processes import Bench

    choose_domain()
    rclpy.init()
    found = Bench()
    yield found
    found.node.destroy_node()
    rclpy.shutdown()
