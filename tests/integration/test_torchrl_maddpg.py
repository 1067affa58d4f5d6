"""TorchRL's MADDPG with our replay: three robots learn to meet."""

from __future__ import annotations

import pytest

import torchrl_maddpg

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torchrl|tensordict")


@pytest.mark.slow
@pytest.mark.parametrize("agents", ["max", "mean"])
def test_robots_that_start_a_meter_apart_meet(agents: str) -> None:
    distances = torchrl_maddpg.main(["--agents", agents, "--actions", "12000"])
    assert distances[0] > 1.0
    # Robots that do not learn stay as far apart, or end in corners.
    assert sum(distances[-3:]) / 3 < 0.5


def test_the_seed_decides_the_distances_to_the_last_bit() -> None:
    found = [torchrl_maddpg.main(["--actions", "1200", "--seed", seed]) for seed in ("0", "0", "1")]
    assert found[0] == found[1] != found[2]
