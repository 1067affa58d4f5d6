"""Histograms of a buffer over time."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import RandomSampler

from benchmarks.paper.methods.mw import MWSampler
from tests.mpfa.transitions import make_buffer
from torchrl_mpfa import (
    MPFASampler,
    SignalSampler,
    SignalTensorStorage,
)
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from training.run.updates import ReplayHistory


def filled(sampler, rows=200):
    torch.manual_seed(0)
    buffer = make_buffer(rows, rows, storage=SignalTensorStorage(rows), sampler=sampler)
    buffer.extend(TensorDict({"next": {"reward": torch.rand(rows, 1) - 0.5}}, [rows]))
    return buffer


def learn(buffer):
    batch = buffer.sample()
    count = len(batch)
    batch["signals"] = TensorDict(
        {"td_error": 10.0 * torch.rand(count), "action_gradient": torch.rand(count)}, [count]
    )
    buffer.update_tensordict_priority(batch)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (SignalSampler, {}),
        (RankPERSampler, {}),
        (LA3PSampler, {}),
        (MWSampler, {"replay_cap": 2}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_the_weights_of_all_transitions_are_those_that_batches_have(kind, options):
    buffer = filled(kind(200, 0.6, 0.4, 0.01, **options))
    learn(buffer)
    weights = buffer.distributions()["weight"]
    index, found = buffer.sampler.sample(buffer.storage, 40)
    torch.testing.assert_close(weights[index].float(), found["priority_weight"])
    spent = getattr(buffer.sampler, "_spent", torch.zeros(200, dtype=torch.bool))
    assert torch.equal(weights.isnan(), spent)
    assert spent.any() == (kind is MWSampler)
    assert kind is LA3PSampler or weights[~spent].unique().numel() > 10


def test_histograms_count_all_rows_of_the_buffer():
    buffer = filled(MPFASampler(200, alpha=0.6, beta=0.4))
    history = ReplayHistory()
    history.add(0, buffer)
    learn(buffer)
    history.add(1000, buffer)
    found = history.histograms()
    assert sorted(found) == ["action_gradient", "priority", "reward", "td_error", "weight"]
    steps, edges, counts = found["td_error"]
    table = buffer.storage.signal_table
    known = table.rows[:, table.column["td_error"]]
    known = known[known.isfinite()].numpy()
    # At first no transition has an error.
    assert steps.tolist() == [1000]
    np.testing.assert_array_equal(counts[0], np.histogram(known, edges)[0])
    for name in ("priority", "weight", "reward"):
        steps, _, counts = found[name]
        assert steps.tolist() == [0, 1000]
        assert counts.sum(1).tolist() == [200, 200]
    priorities = buffer.sampler.priorities()
    weight = (priorities / priorities.min()) ** (-0.6 * 0.4)
    np.testing.assert_array_equal(found["weight"][2][1], np.histogram(weight, edges)[0])


def test_numbers_beyond_the_bins_count_to_the_outermost():
    buffer = filled(MPFASampler(4), rows=4)
    table = buffer.storage.signal_table
    table.rows[:, table.column["td_error"]] = torch.tensor([0.0, 1e-9, 1e9, torch.nan])
    history = ReplayHistory(bins=1)
    history.add(0, buffer)
    _, edges, counts = history.histograms()["td_error"]
    assert len(edges) == 13
    assert counts[0, 0] == 2 and counts[0, -1] == 1 and counts.sum() == 3


def test_a_buffer_without_priorities_adds_nothing():
    history = ReplayHistory()
    history.add(0, filled(RandomSampler()))
    history.add(0, make_buffer(9))
    assert history.histograms() == {}


def test_loaded_history_continues():
    buffer = filled(MPFASampler(200))
    history, other = ReplayHistory(), ReplayHistory()
    history.add(0, buffer)
    other.load_state_dict(history.state_dict())
    for each in (history, other):
        each.add(5, buffer)
    for name, (steps, _, counts) in history.histograms().items():
        np.testing.assert_array_equal(steps, other.histograms()[name][0])
        np.testing.assert_array_equal(counts, other.histograms()[name][2])
    with pytest.raises(ValueError, match="counts of 'priority' must have shape"):
        ReplayHistory(bins=3).load_state_dict({"priority": history.state_dict()["priority"]})


@pytest.mark.parametrize("wrong", [-1, 1.5, True, "3"])
def test_step_of_a_history_that_is_no_count_is_rejected_and_adds_nothing(wrong):
    history = ReplayHistory()
    with pytest.raises((TypeError, ValueError), match="step must be"):
        history.add(wrong, filled(MPFASampler(200)))
    assert history.state_dict() == {}
