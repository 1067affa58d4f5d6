"""Eqs. (15)-(21) against hand numbers, the oracle and what they degenerate to."""

import math

import pytest
import torch

from benchmarks.paper.methods.hvper import ScheduledFusion
from tests import oracles
from tests.mpfa.transitions import make_filled, make_transitions, seeded, train_rounds
from torchrl_mpfa import EntropyFusion, FixedFusion, Fusion, ScaledFusion
from torchrl_mpfa.fusion import (
    binary_entropy,
    entropy_weights,
    fuse,
    positive_entropy,
    reward_entropy,
)
from torchrl_mpfa.samplers import SignalTable

NAMES = ["td_error", "action_gradient", "reward"]


def make_table(rewards):
    table = SignalTable(len(rewards), NAMES)
    table.write(
        torch.arange(len(rewards)),
        table.read(make_transitions(len(rewards), rewards=rewards), len(rewards)),
    )
    table.size = len(rewards)
    return table


@pytest.mark.parametrize(
    ("first", "expected"),
    [(0.5, 1.0), (0.0, 0.0), (1.0, 0.0), (0.25, 0.8112781), (0.1, 0.4689956)],
)
def test_binary_entropy_of_hand_numbers(first, expected):
    found = float(binary_entropy(torch.tensor(first), torch.tensor(1 - first)))
    assert found == pytest.approx(expected, abs=1e-6)
    assert math.copysign(1.0, found) == 1.0, "the entropy of a certain event must not be -0.0"


@pytest.mark.parametrize("seed", range(5))
def test_both_entropies_equal_the_oracle(seed):
    # Rounded, so that zeros and ties happen.
    rewards = (torch.randn(200, generator=seeded(seed)) * 2).round()
    expected = oracles.entropy_of_reward(rewards.tolist())
    assert float(reward_entropy(rewards)) == pytest.approx(expected)
    expected = oracles.entropy_of_positive(rewards.tolist())
    assert float(positive_entropy(rewards)) == pytest.approx(expected)


def test_ties_count_as_not_greater():
    rewards = torch.tensor([1.0, 0.0, 0.0, -1.0])
    assert float(positive_entropy(rewards)) == pytest.approx(0.8112781)
    assert float(reward_entropy(torch.zeros(4))) == 0.0


def test_positive_may_mean_above_a_level_or_above_the_mean():
    """Pendulum: all rewards are negative, so that none is positive by the letter."""
    rewards = torch.tensor([-8.0, -6.0, -1.0, -0.5])
    assert float(positive_entropy(rewards)) == 0.0
    assert float(positive_entropy(rewards, positive_above=-7.0)) == pytest.approx(0.8112781)
    assert float(positive_entropy(rewards, positive_above="mean")) == 1.0
    table, index = make_table(rewards.tolist()), torch.arange(4)
    assert EntropyFusion().weights(NAMES, table, index).tolist() == [0.0, 0.0, 1.0]
    table.positive_above = "mean"
    cured = EntropyFusion().weights(NAMES, table, index)
    assert cured.tolist() == pytest.approx([1 / 3] * 3)


def test_entropy_weights_of_a_hand_example_sum_to_one():
    weights = entropy_weights(torch.tensor([0.5, 1.0, 1.0]))
    assert weights.tolist() == pytest.approx([0.2, 0.4, 0.4])


def test_entropy_weights_are_equal_when_no_entropy_says_anything():
    assert entropy_weights(torch.zeros(3)).tolist() == pytest.approx([1 / 3] * 3)


def test_a_zero_entropy_gets_no_weight():
    assert entropy_weights(torch.tensor([0.7, 0.0, 0.0])).tolist() == [1.0, 0.0, 0.0]


def test_fused_priority_of_a_hand_example():
    # 0.2 * 10 + 0.4 * 3 + 0.4 * 0.5 + 0.05
    found = fuse(torch.tensor([[10.0, 3.0, 0.5]]), torch.tensor([0.2, 0.4, 0.4]), eps=0.05)
    assert found.tolist() == pytest.approx([3.45])


@pytest.mark.parametrize("seed", range(3))
def test_entropy_fusion_gives_the_weights_of_the_oracle_by_name(seed):
    rewards = torch.randn(50, generator=seeded(seed)) + 0.4
    of_positive = oracles.entropy_of_positive(rewards.tolist())
    of_reward = oracles.entropy_of_reward(rewards.tolist())
    a, beta, nu = oracles.fusion_weights(of_reward, of_positive, of_positive)
    weights = EntropyFusion().weights(NAMES, make_table(rewards), torch.arange(4))
    assert weights.tolist() == pytest.approx([beta, nu, a])


def test_the_population_is_the_filled_buffer_or_the_batch():
    table = make_table([1.0, -1.0, -1.0, -1.0])
    index = torch.tensor([0, 1])
    over_buffer = EntropyFusion(population="buffer").entropies(NAMES, table, index)
    over_batch = EntropyFusion(population="batch").entropies(NAMES, table, index)
    assert over_buffer.tolist() == pytest.approx([0.8112781] * 3)
    assert over_batch.tolist() == pytest.approx([1.0] * 3)
    table.size = 2
    filled = EntropyFusion(population="buffer").entropies(NAMES, table, index)
    assert filled.tolist() == pytest.approx([1.0] * 3)


def test_if_all_rewards_are_positive_a_floor_keeps_the_other_weights():
    table, index = make_table([1.0, 2.0, 6.0, 7.0]), torch.arange(4)
    assert EntropyFusion().weights(NAMES, table, index).tolist() == [0.0, 0.0, 1.0]
    floored = EntropyFusion(floor=0.1).weights(NAMES, table, index)
    assert floored.tolist() == pytest.approx([0.1 / 1.2, 0.1 / 1.2, 1 / 1.2])


def test_an_own_signal_gets_the_entropy_of_positive_training_by_default():
    table, index = make_table([4.0, 1.0, 1.0, 1.0, -2.0]), torch.arange(5)
    of_reward = oracles.entropy_of_reward([4.0, 1.0, 1.0, 1.0, -2.0])
    names = ["novelty", "reward"]
    found = EntropyFusion().entropies(names, table, index)
    assert found[0] == pytest.approx(oracles.entropy_of_positive([4.0, 1.0, 1.0, 1.0, -2.0]))
    assert found[1] == pytest.approx(of_reward)
    named = EntropyFusion(reward_signals=["novelty"])
    assert named.entropies(names, table, index).tolist() == found.flip(0).tolist()


def test_fixed_fusion_gives_its_weights_by_name_and_none_to_the_others():
    weights = FixedFusion({"reward": 0.3, "td_error": 2.0}).weights(NAMES, None, None)
    assert weights.tolist() == pytest.approx([2.0, 0.0, 0.3])
    assert isinstance(FixedFusion(), Fusion)
    assert isinstance(EntropyFusion(), Fusion)


# Weights that move with the training or with the scale of the signals.

TWO = ["td_error", "reward"]


def make_known_table(rows):
    """A table of two signals, reward unknown where it is None."""
    table = SignalTable(10, TWO)
    table.size = len(rows)
    for slot, (error, reward) in enumerate(rows):
        table.rows[slot, table.column["td_error"]] = float("nan") if error is None else error
        table.rows[slot, table.column["reward"]] = reward
    return table


def test_scheduled_weights_go_in_a_line_from_start_to_end():
    fusion = ScheduledFusion({"td_error": 1.0}, {"td_error": 0.2, "reward": 0.8})
    found = []
    for fraction in (0.0, 0.25, 1.0):
        fusion.anneal(fraction)
        found.append(fusion.weights(TWO, None, None).tolist())
    assert found == [pytest.approx(w) for w in ([1.0, 0.0], [0.8, 0.2], [0.2, 0.8])]
    assert isinstance(fusion, Fusion)


def test_scaled_signals_have_the_shares_that_their_weights_say():
    table = make_known_table([(1.0, 100.0), (3.0, 300.0), (None, 800.0)])
    weights = ScaledFusion(FixedFusion(dict.fromkeys(TWO, 1.0))).weights(TWO, table, None)
    # Means of what is known: 2 and 400.
    assert weights.tolist() == pytest.approx([1 / 2, 1 / 400])


def test_a_signal_without_a_scale_is_not_scaled():
    table = make_known_table([(None, 0.0), (None, 0.0)])
    weights = ScaledFusion(FixedFusion(dict.fromkeys(TWO, 1.0))).weights(TWO, table, None)
    assert weights.tolist() == [1.0, 1.0]


def test_sampler_passes_the_schedule_to_its_fusion():
    fusion = ScheduledFusion({"td_error": 1.0}, {"reward": 1.0})
    buffer = make_filled(24, 6, fusion=fusion)
    for fraction, expected in ((0.0, 1.0), (1.0, 0.0)):
        buffer.sampler.anneal(fraction)
        train_rounds(buffer, 1)
        assert buffer.sampler.weights["td_error"] == pytest.approx(expected)
