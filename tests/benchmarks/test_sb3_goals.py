"""Stable-Baselines3's side of the comparison on goal tasks: what is told to it, and its score."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import gymnasium_td3 as page
from tests.integration.test_gymnasium_td3 import MAZE, POINT

sb3 = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is of the extra peers")
sb3_goals = pytest.importorskip("benchmarks.goals.sb3")


def test_its_run_has_the_settings_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []

    class Kept(sb3.TD3):  # type: ignore[misc, name-defined]
        def __init__(self, *words: Any, **given: Any) -> None:
            super().__init__(*words, **given)
            made.append(self)

    monkeypatch.setattr(sb3_goals, "TD3", Kept)
    scored: list[Any] = []
    monkeypatch.setattr(sb3_goals, "score", lambda *words: scored.append(words) or 0.5)
    words = ["--task", POINT, "--replay", "her", "--steps", "60", "--start", "30", "--every", "30"]
    words += ["--batch-size", "16", "--width", "8", "--gamma", "0.9", "--tau", "0.2"]
    options, _ = page.parse([*words, "--noise", "0.4", "--seed", "5"])
    assert sb3_goals.train(options) == [(30, 0.5), (60, 0.5)]
    [model] = made
    # Three rounds of ten steps are at random, and three learn.
    assert model._n_updates == 30 and model.num_timesteps == 60
    assert (model.gamma, model.tau, model.batch_size, model.seed) == (0.9, 0.2, 16, 5)
    assert (model.policy_delay, model.target_policy_noise, model.target_noise_clip) == (2, 0.2, 0.5)
    assert model.lr_schedule(1.0) == page.LEARNING_RATE
    assert model.action_noise._sigma.tolist() == [0.4, 0.4]
    assert model.policy.net_arch == [8, 8]
    buffer = model.replay_buffer
    assert (buffer.n_sampled_goal, buffer.goal_selection_strategy.name) == (4, "FUTURE")
    scales = model.get_vec_normalize_env()
    assert scales.norm_obs and not scales.norm_reward and scales.clip_obs == 5.0
    assert [each[1:] for each in scored] == [(scales, POINT)] * 2


@pytest.mark.parametrize("task", [POINT, MAZE])
@pytest.mark.parametrize(("scale", "expected"), [(5.0, 1.0), (-5.0, 0.0)])
def test_its_score_is_the_share_that_ends_at_the_goal_seen_as_it_was_in_training(
    task: str, scale: float, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "EPISODES", 4)

    def predict(seen: dict[str, np.ndarray], deterministic: bool) -> Any:
        assert deterministic
        return np.clip(seen["towards"], -1.0, 1.0), None

    def towards(seen: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {"towards": scale * (seen["desired_goal"] - seen["achieved_goal"])}

    model, scales = SimpleNamespace(predict=predict), SimpleNamespace(normalize_obs=towards)
    assert sb3_goals.score(model, scales, task) == expected
