"""The cost-to-go of a part of the map, beside that of the whole."""

from __future__ import annotations

import math

import numpy as np

from mpfa_envs.control.cost_to_go import cost_to_go
from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE, path_lengths

FACTORS = np.array((5, 8, 150, 1000))
REACH = 15


def whole(levels: np.ndarray, raised: np.ndarray, target: tuple[int, int]) -> np.ndarray:
    """The same on the whole map, however far away."""
    costs = np.minimum(FACTORS[levels] + raised, 1000)
    at, gap, step = np.array([target]), np.zeros(1), 0.1 * STEP_SCALE / 5
    return path_lengths(costs, at, gap, MOVES, step, math.inf, buckets=2500)


def test_lengths_around_the_robot_are_those_of_the_whole_map() -> None:
    rng = np.random.default_rng(0)
    for _ in range(12):
        # A building of 6 m in a map of 20 m, with the goal and the robot in it or beside it.
        levels, raised = np.zeros((200, 200), np.uint8), np.zeros((200, 200), np.int64)
        levels[70:130, 60:120] = rng.choice([0, 1, 2, 3], p=[0.6, 0.2, 0.1, 0.1], size=(60, 60))
        raised[90:93, 80:83] = 25
        (a, b), (i, j) = rng.integers(40, 150, (2, 2)).tolist()
        found, expected = (
            cost_to_go(levels, raised, (a, b), (i, j), REACH),
            whole(levels, raised, (a, b)),
        )
        near = slice(i - REACH, i + REACH + 1), slice(j - REACH, j + REACH + 1)
        farthest = expected[i, j] + 12.0
        np.testing.assert_allclose(
            found[near], np.minimum(expected[near], farthest), rtol=1e-12, atol=1e-9
        )
        # Nowhere a cell seems nearer than it is, unless it is farther than all that counts.
        assert (found >= np.minimum(expected, farthest) - 1e-9).all()


def test_lengths_on_an_empty_map_are_those_of_straight_paths() -> None:
    nothing = np.zeros((400, 400), np.uint8), np.zeros((400, 400), np.int64)
    found = cost_to_go(*nothing, (200, 200), (280, 200), REACH)
    assert abs(found[280, 200] - 8.0) < 0.12 and found[290, 200] > found[280, 200] > found[270, 200]
