"""Runs of DQN and Q learning by the training script: saving and driving."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpfa_envs import load_policy
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from tests.integration.tiny_runs import tiny, train
from training.evaluating import drive
from training.settings.checks import check_settings

LEARNERS = ["dqn", "q_learning"]


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_learns_from_choices_and_saves_a_policy_that_drives_them(tmp_path, learner):
    settings = tiny(learner=learner, robots=2, updates=2)
    settings.environment.max_steps, settings.method.capacity = 25, 100
    settings.environment.filter = 1.0  # Of actions that are wheel speeds.
    check_settings(settings)
    run = train(tmp_path, settings)
    assert run.learner.updates > 50
    stored = run.buffer.storage.get(slice(0, len(run.buffer)))["action"]
    assert stored.shape[1] == len(WHEEL_PAIRS)
    assert (stored.sum(1) == 1).all()
    assert (stored.sum(0) > 0).all()
    assert sorted(run.buffer.sampler.weights) == ["reward", "td_error"]
    policy = load_policy(tmp_path)
    seen = np.random.default_rng(0).uniform(0.0, 1.0, (50, 24)).astype(np.float32)
    chosen = run.learner.policy.outputs({"observation": torch.from_numpy(seen)})["action"]
    pairs = np.array(WHEEL_PAIRS, np.float32)[chosen.argmax(-1).numpy()]
    assert (policy(seen) == pairs).all()
    [driven] = drive(policy, ["A"], episodes=3, seed=0, physics=None, progress=False)
    assert len(driven.results) == 3


def test_the_loss_of_lap_is_for_dqn():
    check_settings(tiny("lap", learner="dqn"))
