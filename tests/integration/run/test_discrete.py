"""Runs of DQN and Q learning by the training script: saving, resuming, driving, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mpfa_envs import load_policy
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from tests.integration.tiny_runs import rows, tiny, train
from training.evaluating import drive
from training.run.loop import TrainingRun
from training.settings.checks import check_settings
from training.settings.train import Stage

LEARNERS = ["dqn", "q_learning"]


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_learns_from_choices_and_saves_a_policy_that_drives_them(tmp_path, learner):
    settings = tiny(learner=learner, robots=2, updates=2)
    settings.environment.max_steps, settings.method.capacity = 25, 100
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
    driven = drive(policy, "A", episodes=3, seed=0, physics=None, progress=False)
    assert len(driven.results) == 3


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_goes_on_where_it_was_saved(tmp_path, learner):
    settings = tiny(learner=learner, episodes=[Stage("A", 4)])
    whole = train(tmp_path / "whole", settings)
    first = TrainingRun(settings, tmp_path)
    while first.schedule.episodes < 2:
        first._iterate()
    first.save()
    first.close()
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    second = TrainingRun(settings, tmp_path, state)
    second.train()
    second.close()
    assert rows(second) == rows(whole)
    states = [run.learner.state_dict()["loss"] for run in (whole, second)]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize(
    "method", ["hvper", "la3p", "ref_er", "averaged_ddpg", "pal", "ddpg_radam"]
)
def test_a_method_that_needs_an_actor_is_refused_in_one_sentence(method, learner):
    with pytest.raises(ValueError, match=rf"method={method} is not for learner={learner}"):
        check_settings(tiny(method, learner=learner))


def test_a_loss_that_bends_is_refused_where_there_is_no_loss():
    check_settings(tiny("lap", learner="dqn"))
    with pytest.raises(ValueError, match="method=lap is not for learner=q_learning"):
        check_settings(tiny("lap", learner="q_learning"))
    settings = tiny("per", learner="q_learning")
    settings.learner.reward_scale = 0.1
    with pytest.raises(ValueError, match=r"learner\.reward_scale must be 1 with q_learning.*0\.1"):
        check_settings(settings)


def test_the_action_gradient_alone_is_refused_and_so_is_a_program():
    settings = tiny("per", learner="dqn")
    settings.method.signals = ["action_gradient"]
    with pytest.raises(ValueError, match="reward or td_error"):
        check_settings(settings)
    settings = tiny("per", learner="dqn")
    settings.learner.compile = True
    with pytest.raises(ValueError, match=r"learner\.compile must be false with dqn"):
        check_settings(settings)
