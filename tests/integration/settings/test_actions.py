"""Settings: the range of actions, and the length of a run."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from mpfa_envs import Policy
from mpfa_envs.policies.layers import Tanh
from tests.integration.settings.test_settings import hydra_at_rest, one  # noqa: F401
from training.run.assembly import make_learner, policy_layers
from training.settings.command_line import composed
from training.settings.train import Stage, curriculum_name


@pytest.mark.parametrize("limit", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
def test_every_learner_has_the_full_range_of_actions_at_the_limit(
    algorithm: str, limit: float
) -> None:
    words = [f"learner={algorithm}", f"learner.saturation_limit={limit}", "learner.compile=false"]
    for more, reached in (([], 1.0), (["learner.full_range=false"], math.tanh(limit))):
        settings = one(*words, *more)
        policy = make_learner(settings.learner, settings.method, 5, 2).policy
        head = next(each for each in reversed(policy.layers()) if isinstance(each, nn.Linear))
        with torch.no_grad():
            head.weight.zero_()
            head.bias.copy_(torch.tensor([limit, -limit]))
        action = Policy(policy_layers(policy))(np.zeros(5, np.float32))
        np.testing.assert_allclose(action, [reached, -reached], rtol=1e-6)


def test_the_paper_has_the_tanh_alone() -> None:
    settings = one("regime=paper")
    policy = make_learner(settings.learner, settings.method, 5, 2).policy
    assert [type(each) for each in policy_layers(policy)][-1] is Tanh


@pytest.mark.parametrize(
    ("words", "stages"),
    [
        (["actions=7000"], [Stage("mixed", actions=7_000)]),
        (["actions=7000", "curriculum.stages=[{world: bars}]"], [Stage("bars", actions=7_000)]),
        (
            ["actions=1000", "regime=paper"],
            [
                Stage(world, actions=n)
                for world, n in zip("ABCD", (100, 200, 300, 400), strict=True)
            ],
        ),
        (
            ["actions=10", "curriculum.stages=[{world: A, actions: 2}, {world: B, actions: 1}]"],
            [Stage("A", actions=6), Stage("B", actions=4)],
        ),
    ],
)
def test_stages_share_the_actions_of_a_run_in_proportion(words, stages) -> None:
    [settings] = composed(words)
    assert settings.curriculum.stages == stages
    assert settings.curriculum.name == curriculum_name(stages)
    assert f"/{curriculum_name(stages)}-" in settings.run_dir


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["actions=3", "regime=paper"], "actions must leave each stage at least 1, got 3"),
        (["actions=0"], "actions must leave each stage at least 1, got 0"),
        (["actions=many"], "actions: Value 'many'"),
        (["actions=9", "curriculum.stages=[]"], "curriculum.stages must name at least one world"),
    ],
)
def test_a_length_that_a_run_cannot_have_is_rejected(words, message) -> None:
    with pytest.raises(ValueError, match=message):
        list(composed(words))
