"""Each entry of the statistics against a plain computation."""

import pytest

from tests import oracles
from tests.mpfa.transitions import (
    make_buffer,
    make_transitions,
    train_rounds,
    write_signals,
)

NAMES = ["td_error", "action_gradient", "reward"]


@pytest.fixture
def trained():
    """A wrapped buffer after some rounds, with a last batch that was sampled and updated."""
    buffer = make_buffer(24, 12, entropy_refresh=0)
    buffer.extend(make_transitions(30))
    train_rounds(buffer, 5)
    batch = write_signals(buffer.sample())
    buffer.update_tensordict_priority(batch)
    return buffer, batch


def test_weights_and_entropies_are_those_of_the_whole_buffer(trained):
    buffer, _ = trained
    rewards = buffer[:]["next", "reward"].squeeze(1).tolist()
    of_reward = oracles.entropy_of_reward(rewards)
    of_positive = oracles.entropy_of_positive(rewards)
    a, beta, nu = oracles.fusion_weights(of_reward, of_positive, of_positive)
    stats = buffer.stats()
    for name, entropy, weight in zip(
        NAMES, (of_positive, of_positive, of_reward), (beta, nu, a), strict=True
    ):
        assert stats[f"entropy/{name}"] == pytest.approx(entropy)
        assert stats[f"weight/{name}"] == pytest.approx(weight, rel=1e-5)


def test_shares_are_of_the_last_batch_after_its_update(trained):
    buffer, batch = trained
    stats = buffer.stats()
    table = buffer.storage.signal_table
    parts = []
    for name in NAMES:
        values = table.rows[batch["index"], table.column[name]].tolist()
        parts.append(stats[f"weight/{name}"] * sum(values) / len(values))
    for name, part in zip(NAMES, parts, strict=True):
        assert stats[f"share/{name}"] == pytest.approx(part / sum(parts))
    assert sum(stats[f"share/{name}"] for name in NAMES) == pytest.approx(1.0)


@pytest.mark.parametrize("level", [-1.0, "mean"])
@pytest.mark.filterwarnings("ignore:positive_above='mean'")
def test_fractions_of_positive_transitions_are_above_the_level_of_the_sampler(level):
    buffer = make_buffer(4, 2, positive_above=level)
    buffer.extend(make_transitions(4, rewards=[-9.0, -3.0, -2.0, -0.5]))
    batch, least = buffer.sample(), -3.625 if level == "mean" else level
    sampled, stats = batch["next", "reward"].flatten().tolist(), buffer.stats()
    assert stats["positive_fraction_buffer"] == (0.75 if level == "mean" else 0.25)
    assert stats["positive_fraction_batch"] == sum(reward > least for reward in sampled) / 2


def test_effective_sample_size_age_and_replays_of_the_last_batch(trained):
    buffer, batch = trained
    stats = buffer.stats()
    weight = batch["priority_weight"].tolist()
    expected = sum(weight) ** 2 / sum(w * w for w in weight)
    assert stats["effective_sample_size"] == pytest.approx(expected, rel=1e-5)
    # The observation is the number of the transition; the youngest is number 29.
    ages = [29 - number for number in batch["observation"].squeeze(1).tolist()]
    assert stats["sampled_age_mean"] == pytest.approx(sum(ages) / 12)
    assert stats["sampled_age_max"] == max(ages)
    table = buffer.storage.signal_table
    counts = table.rows[batch["index"], table.count_column]
    assert stats["replay_count_mean"] == pytest.approx(float(counts.mean()))
    assert counts.min() >= 1
