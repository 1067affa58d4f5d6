"""MPFASampler: the whole chain of Eqs. (12)-(24) in a buffer, against the oracle."""

import math

import pytest
import torch
from torchrl.data import LazyTensorStorage
from torchrl.data.replay_buffers import PrioritizedSampler

from tests import oracles
from tests.mpfa.transitions import (
    make_buffer,
    make_filled,
    make_transitions,
    seeded,
    set_signals,
    train_rounds,
    write_signals,
)
from torchrl_mpfa import (
    EntropyFusion,
    FixedFusion,
    Fusion,
    MPFASampler,
    PositiveBoost,
    PositiveDecay,
    SignalSampler,
)

pytestmark = pytest.mark.usefixtures("path")


def priorities(buffer):
    """Priorities of all filled slots: eps included, alpha not applied."""
    return buffer.sampler.priorities(torch.arange(len(buffer)))


def leaves(buffer):
    return buffer.sampler.trees.leaves(torch.arange(len(buffer)))


def oracle_batch(batch, rewards):
    """A batch as the oracle wants it: the norm of a gradient is a gradient of one entry."""
    signals = batch["signals"]
    triples = zip(signals["td_error"].tolist(), signals["action_gradient"].tolist(), strict=True)
    slots = batch["index"].tolist()
    return [(rewards[i], td, [g]) for i, (td, g) in zip(slots, triples, strict=True)]


def set_batch(buffer, index):
    """A batch of chosen slots, as if they had been sampled."""
    batch = buffer[torch.as_tensor(index)]
    batch["index"] = torch.as_tensor(index)
    return batch


@pytest.mark.parametrize("seed", range(4))
def test_priorities_of_a_batch_equal_the_oracle_and_all_others_stay(seed):
    buffer = make_buffer(64, 16)
    buffer.extend(make_transitions(64, seed=seed))
    rewards = buffer[:]["next", "reward"].squeeze(1).tolist()
    before = priorities(buffer)
    index = torch.randperm(64, generator=seeded(seed))[:16]
    batch = write_signals(set_batch(buffer, index), seed=seed)
    buffer.update_tensordict_priority(batch)
    expected = oracles.mpfa_priorities(oracle_batch(batch, rewards), rewards)
    after = priorities(buffer)
    assert after[index].tolist() == pytest.approx(expected, rel=1e-5)
    others = torch.ones(64, dtype=torch.bool).index_fill(0, index, False)
    assert after[others].equal(before[others])
    torch.testing.assert_close(leaves(buffer), after.pow(0.6))


def test_a_hand_example_of_the_whole_chain():
    # Rewards 1, 1, -1, -1: both entropies are one bit, hence all weights 1/3.
    # Fused: (1 + 2 + 3)/3 = 2, (1 + 0 + 0)/3 = 1/3, (1 + 5 + 0)/3 = 2, each + 0.05.
    # Boosted: 6.15, max(1.15, 1), 2.05 unchanged; mean (6.15 + 1.15 + 2.05)/3 = 3.1167.
    # Only the first is positive and above it: 6.15 / (1 + e^-0.01).
    buffer = make_buffer(4)
    buffer.extend(make_transitions(4, rewards=[1.0, 1.0, -1.0, -1.0]))
    set_signals(buffer, [0, 1, 2], td_error=[2.0, 0, 5], action_gradient=[3.0, 0, 0])
    expected = [6.15 / (1 + math.exp(-0.01)), 1.15, 2.05, 1.0 + 0.05]
    assert priorities(buffer).tolist() == pytest.approx(expected, rel=1e-5)
    assert buffer.sampler.weights == pytest.approx(
        {"td_error": 1 / 3, "action_gradient": 1 / 3, "reward": 1 / 3}
    )


def test_options_reach_the_chain():
    options = {
        "fusion": EntropyFusion(floor=0.2),
        "adjustments": [PositiveBoost(boost=2.0, bound="none"), PositiveDecay(position="rank")],
        "eps": 0.5,
        "alpha": 1.0,
    }
    buffer = make_buffer(4, **options)
    buffer.extend(make_transitions(4, rewards=[1.0, 2.0, 6.0, 7.0]))
    set_signals(buffer, [0, 3], td_error=[1.0, 1], action_gradient=[1.0, 1])
    # Weights 0.2, 0.2, 1 over 1.4; then 2 (w.p + 0.5); the mean lies between the two.
    first, last = 2 * (0.4 / 1.4 + 1 / 1.4 + 0.5), 2 * (0.4 / 1.4 + 7 / 1.4 + 0.5)
    expected = [first, last / (1 + math.exp(-0.01))]
    assert priorities(buffer)[[0, 3]].tolist() == pytest.approx(expected, rel=1e-5)


def test_importance_weights_of_a_batch_equal_the_oracle():
    buffer = make_buffer(32, 16, beta=0.7)
    buffer.extend(make_transitions(40))
    train_rounds(buffer, 10)
    buffer.update_priority(torch.tensor([5]), torch.tensor([0.0]))
    batch = buffer.sample()
    assert 5 not in batch["index"]  # The lowest of the buffer, and not of the batch, counts.
    expected = oracles.importance_weights(
        priorities(buffer).tolist(), 0.6, 0.7, batch["index"].tolist()
    )
    assert batch["priority_weight"].tolist() == pytest.approx(expected, rel=1e-4)


def test_one_signal_is_torchrls_prioritized_replay():
    sampler = SignalSampler(32, 0.6, 0.4, 0.05, fusion=FixedFusion({"td_error": 1.0}))
    ours = make_buffer(32, 8, sampler=sampler)
    theirs, storage = PrioritizedSampler(32, 0.6, 0.4, 0.05), LazyTensorStorage(32)
    ours.extend(make_transitions(32))
    storage.set(torch.arange(32), make_transitions(32))
    theirs.mark_update(torch.arange(32), storage=storage)
    for seed in range(30):
        batch = write_signals(ours.sample(), seed=seed)
        ours.update_tensordict_priority(batch)
        theirs.update_priority(batch["index"], batch["signals", "td_error"])
        slots = torch.arange(32)
        # TorchRL's trees are in single precision.
        torch.testing.assert_close(leaves(ours).float(), torch.as_tensor(theirs._sum_tree[slots]))
    assert ours.sampler.default_priority == pytest.approx(float(theirs.default_priority))


def test_a_fresh_transition_gets_the_highest_priority_in_the_buffer_before_alpha():
    buffer = make_buffer(16)
    buffer.extend(make_transitions(4))
    assert priorities(buffer).tolist() == pytest.approx([1.05] * 4)
    train_rounds(buffer, 10)
    highest = priorities(buffer).max()
    index = buffer.extend(make_transitions(3, first=4))
    assert priorities(buffer)[index].equal(highest.expand(3))
    assert leaves(buffer)[index].tolist() == pytest.approx([float(highest) ** 0.6] * 3)


def test_replays_are_counted_with_duplicates_and_start_again_with_a_new_transition():
    buffer = make_filled(4, 64)
    index = buffer.sample()["index"]
    table = buffer.storage.signal_table
    counts = table.rows[:, table.count_column]
    assert counts.tolist() == torch.bincount(index, minlength=4).tolist()
    buffer.extend(make_transitions(1, first=4))
    assert counts[0] == 0
    assert counts[1:].sum() == (index > 0).sum()


class CountingFusion(Fusion):
    """Equal weights, and how often they were asked for."""

    def __init__(self):
        self.asked = 0

    def weights(self, names, table, index):
        self.asked += 1
        return torch.full((len(names),), 1 / len(names))


@pytest.mark.parametrize(
    ("refresh", "expected"),
    [(0.0, [1, 2, 3, 4, 5, 6]), (0.25, [1, 1, 1, 1, 1, 2]), (100.0, [1] * 6)],
    ids=["always", "quarter", "never"],
)
def test_entropies_are_counted_again_when_that_share_of_the_buffer_was_rewritten(refresh, expected):
    fusion = CountingFusion()
    buffer = make_filled(16, fusion=fusion, entropy_refresh=refresh)
    asked = []
    for number in range(6):
        buffer.update_tensordict_priority(write_signals(buffer.sample()))
        asked.append(fusion.asked)
        buffer.add(make_transitions(1, first=16 + number)[0])
    assert asked == expected


def test_weights_counted_over_the_batch_are_those_of_each_batch():
    # Without this, one batch would weigh for all that follow until enough was written.
    buffer = make_buffer(8, fusion=EntropyFusion(population="batch"))
    buffer.extend(make_transitions(8, rewards=[1.0, -1, -1, -1, 5, 6, 7, 8]))
    buffer.update_tensordict_priority(write_signals(set_batch(buffer, [0, 1, 2, 3])))
    assert buffer.sampler.weights == pytest.approx(
        {"td_error": 1 / 3, "action_gradient": 1 / 3, "reward": 1 / 3}
    )
    buffer.update_tensordict_priority(write_signals(set_batch(buffer, [4, 5, 6, 7])))
    assert buffer.sampler.weights == pytest.approx(
        {"td_error": 0.0, "action_gradient": 0.0, "reward": 1.0}
    )


def test_defaults_are_those_of_the_paper():
    sampler = MPFASampler(8)
    assert (sampler.alpha, sampler.beta, sampler._eps) == (0.6, 0.4, 0.05)
    assert sampler.fusion == EntropyFusion()
    assert sampler.adjustments == (PositiveBoost(3.0, "floor"), PositiveDecay(0.01, "batch"))
    assert [signal.name for signal in sampler.signals] == ["reward", "td_error", "action_gradient"]
