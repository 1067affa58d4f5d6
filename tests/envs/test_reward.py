from __future__ import annotations

import pytest

from mpfa_envs import StepOutcome, navigation_reward


def outcome(before: float, after: float, *, success: bool = False, collision: bool = False):
    return StepOutcome(before, after, success, collision, 1.0, 0.3, 0.0)


def test_approaching_is_rewarded_and_leaving_costs() -> None:
    assert navigation_reward(outcome(2.0, 1.9)).total == pytest.approx(0.5)
    assert navigation_reward(outcome(1.9, 2.0)).total == pytest.approx(-0.5)


def test_the_goal_and_a_collision_replace_the_progress() -> None:
    assert navigation_reward(outcome(0.6, 0.4, success=True)) == (10.0, 0.0, 0.0, 0.0)
    assert navigation_reward(outcome(0.6, 0.4, collision=True)) == (0.0, -5.0, 0.0, 0.0)
    assert navigation_reward(outcome(0.6, 0.4, success=True, collision=True)).total == 10.0


def test_the_scales_are_arguments() -> None:
    scales = {"progress_scale": 7.0, "goal_reward": 30.0, "collision_reward": -20.0}
    assert navigation_reward(outcome(2.0, 1.0), **scales).progress == 7.0
    assert navigation_reward(outcome(2.0, 1.0, success=True), **scales).total == 30.0
    assert navigation_reward(outcome(2.0, 1.0, collision=True), **scales).total == -20.0
