"""The paper's ablations, as the settings have them: which weights, which adjustments."""

import pytest
import torch
from tensordict import TensorDict

from tests import oracles
from tests.methods.replays import make_buffer, set_signals
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods.assembly import make_sampler, signals_of

REWARDS = [3.0, -1.0, 0.5, 0.5, -2.0, 0.1, 9.0, -0.2]
ERRORS = [0.2, 1.5, 0.1, 2.0, 0.7, 0.05, 3.0, 1.0]
SLOPES = [1.0, 0.5, 2.0, 0.1, 0.3, 1.2, 0.4, 0.9]


def priorities_of(name):
    """Priorities of the eight transitions, eps included, after one update of all of them."""
    method = METHODS[name]
    method = type(method)(**{**vars(method), "capacity": 8, "batch_size": 4})
    sampler = make_sampler(method)
    buffer = make_buffer(sampler, 8, 4, filled=0, signals=signals_of(method))
    buffer.extend(TensorDict({"next": {"reward": torch.tensor(REWARDS).unsqueeze(1)}}, [8]))
    set_signals(buffer, td_error=torch.tensor(ERRORS), action_gradient=torch.tensor(SLOPES))
    return sampler.priorities(torch.arange(8)).tolist(), sampler


def entropies():
    return oracles.entropy_of_reward(REWARDS), oracles.entropy_of_positive(REWARDS)


def test_reward_and_td_error_share_their_entropies():
    of_reward, of_positive = entropies()
    a = of_reward / (of_reward + of_positive)
    found, _ = priorities_of("td_reward")
    expected = [a * abs(r) + (1 - a) * d + 0.05 for r, d in zip(REWARDS, ERRORS, strict=True)]
    assert found == pytest.approx(expected, rel=1e-5)


def test_td_error_and_slope_have_the_same_weight_whatever_the_rewards():
    found, _ = priorities_of("td_loss")
    expected = [0.5 * d + 0.5 * g + 0.05 for d, g in zip(ERRORS, SLOPES, strict=True)]
    assert found == pytest.approx(expected, rel=1e-5)


def test_all_three_signals_have_the_weights_of_the_paper():
    of_reward, of_positive = entropies()
    a = of_reward / (of_reward + 2 * of_positive)
    rest = (1 - a) / 2
    found, _ = priorities_of("mpf_per")
    expected = [
        a * abs(r) + rest * d + rest * g + 0.05
        for r, d, g in zip(REWARDS, ERRORS, SLOPES, strict=True)
    ]
    assert found == pytest.approx(expected, rel=1e-5)


def raised(reward, priority):
    return max(3.0 * priority, 1.0) if reward > 0 else priority


def decayed(rewards, priorities):
    mean = sum(priorities) / len(priorities)
    return [
        p / (1 + 2.718281828459045 ** (-0.01 * j)) if r > 0 and p > mean else p
        for j, (r, p) in enumerate(zip(rewards, priorities, strict=True), 1)
    ]


def test_raise_is_per_with_positive_transitions_raised():
    found, _ = priorities_of("raise")
    expected = [raised(r, d + 0.05) for r, d in zip(REWARDS, ERRORS, strict=True)]
    assert found == pytest.approx(expected, rel=1e-5)


def test_decay_is_per_with_positive_transitions_above_the_mean_decayed():
    found, _ = priorities_of("decay")
    assert found == pytest.approx(decayed(REWARDS, [d + 0.05 for d in ERRORS]), rel=1e-5)


def test_mpfa_per_is_mpf_per_raised_and_then_decayed():
    fused, _ = priorities_of("mpf_per")
    found, _ = priorities_of("mpfa_per")
    both = decayed(REWARDS, [raised(r, p) for r, p in zip(REWARDS, fused, strict=True)])
    assert found == pytest.approx(both, rel=1e-5)


def test_per_is_the_td_error_alone():
    found, _ = priorities_of("per")
    assert found == pytest.approx([d + 0.05 for d in ERRORS], rel=1e-5)
