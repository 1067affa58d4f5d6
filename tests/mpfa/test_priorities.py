"""Eqs. (8)-(10) and (12)-(14) against hand numbers, the oracle and what they degenerate to."""

import math

import pytest
import torch

from tests import oracles
from tests.mpfa.transitions import seeded
from torchrl_mpfa.priorities import (
    action_gradient_priority,
    importance_weights,
    proportional_priority,
    reward_priority,
    sampling_probabilities,
    td_error_priority,
)


def test_reward_priority_is_the_absolute_reward():
    assert reward_priority(torch.tensor([10.0, -5.0, 0.0])).tolist() == [10.0, 5.0, 0.0]


def test_td_error_priority_is_the_absolute_error_and_not_its_square():
    assert td_error_priority(torch.tensor([-3.0, 0.5])).tolist() == [3.0, 0.5]


@pytest.mark.parametrize(
    ("order", "expected"), [(2.0, 5.0), (1.0, 7.0), (math.inf, 4.0)], ids=["l2", "l1", "max"]
)
def test_action_gradient_priority_is_the_chosen_norm_of_each_row(order, expected):
    gradient = torch.tensor([[3.0, -4.0], [0.0, 0.0]])
    found = action_gradient_priority(gradient, order=order)
    assert found.tolist() == pytest.approx([expected, 0.0])


def test_proportional_priority_adds_eps_once():
    found = proportional_priority(torch.tensor([-1.0, 0.0]), eps=0.05)
    assert found.tolist() == pytest.approx([1.05, 0.05])


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0, 2.0])
def test_probabilities_equal_the_oracle(alpha):
    priority = torch.rand(100, generator=seeded(1)) + 0.01
    expected = oracles.probabilities(priority.tolist(), alpha)
    found = sampling_probabilities(priority, alpha=alpha)
    assert found.tolist() == pytest.approx(expected, rel=1e-5)
    assert float(found.sum()) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
def test_importance_weights_equal_the_oracle_and_do_not_depend_on_the_batch(beta):
    priority = torch.rand(60, generator=seeded(3)) + 0.01
    sampled = torch.randint(60, (16,), generator=seeded(4))
    probability = sampling_probabilities(priority, alpha=0.6)
    found = importance_weights(probability[sampled], beta=beta, lowest=probability.min())
    expected = oracles.importance_weights(priority.tolist(), 0.6, beta, sampled.tolist())
    assert found.tolist() == pytest.approx(expected, rel=1e-4)


def test_importance_weights_undo_the_bias_of_sampling_at_beta_one():
    probability = sampling_probabilities(torch.rand(30, generator=seeded(5)) + 0.1, alpha=0.8)
    value = torch.randn(30, generator=seeded(6))
    weight = importance_weights(probability, beta=1.0)
    expected_value = (probability * weight * value).sum() / (probability * weight).sum()
    torch.testing.assert_close(expected_value, value.mean(), rtol=1e-4, atol=1e-6)
