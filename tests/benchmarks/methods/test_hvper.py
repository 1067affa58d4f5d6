"""HVPER (reconstruction): value, error and replays in one priority whose weights move."""

import math

import pytest
import torch

from benchmarks.paper.methods.hvper import (
    RELATIVE_ERROR,
    RELATIVE_VALUE,
    HVPERPenalty,
    value_schedule,
)
from tests.methods.replays import make_buffer
from tests.mpfa.transitions import seeded
from torchrl_mpfa import SignalSampler

KAPPA, EPS = 0.25, 0.01


def by_hand(values, errors, counts, fraction):
    """Priorities in plain loops."""
    mean = sum(values) / len(values)
    spread = math.sqrt(sum((v - mean) ** 2 for v in values) / len(values))
    share = 0.5 * fraction
    found = []
    for value, error, count in zip(values, errors, counts, strict=True):
        high = 1 / (1 + math.exp(-(value - mean) / spread))
        fused = share * high + (1 - share) * error / max(errors) + EPS
        found.append(max(fused - KAPPA * count / max(counts), EPS))
    return found


@pytest.mark.parametrize("fraction", [0.0, 0.4, 1.0])
def test_priorities_are_those_of_the_formula(fraction):
    sampler = SignalSampler(
        6,
        0.6,
        0.4,
        EPS,
        signals=[RELATIVE_VALUE, RELATIVE_ERROR],
        fusion=value_schedule(),
        adjustments=[HVPERPenalty(penalty=KAPPA, floor=EPS)],
    )
    buffer = make_buffer(sampler, 6, 9)
    sampler.anneal(fraction)
    batch = buffer.sample()
    # A row for each slot that was sampled, as of a slot that is in a batch twice the last counts.
    index, first = batch["index"].unique(), {}
    for row, slot in enumerate(batch["index"].tolist()):
        first.setdefault(slot, row)
    batch = batch[torch.tensor([first[slot] for slot in index.tolist()])]
    count = len(batch)
    values = torch.randn(count, generator=seeded(1)) * 4 - 2
    errors = torch.rand(count, generator=seeded(2)) * 3
    batch["signals", "value"], batch["signals", "td_error"] = values, errors
    table = buffer._storage.signal_table
    counts = table.rows[index, table.count_column]
    buffer.update_tensordict_priority(batch)
    found = sampler.priorities(index)
    expected = by_hand(values.tolist(), errors.tolist(), counts.tolist(), fraction)
    assert found.tolist() == pytest.approx(expected, abs=1e-5)


def relative_errors(batches, errors, *, stale=()):
    """The relative TD errors that an update of these batches leaves in the table."""
    signals = [RELATIVE_VALUE, RELATIVE_ERROR]
    count = len(errors)
    sampler = SignalSampler(count, 0.6, 0.4, EPS, signals=signals, fusion=value_schedule())
    storage = make_buffer(sampler, count, 8).storage
    table = storage.signal_table
    slots = torch.arange(count)
    written_at = table.written_at(slots)
    written_at[list(stale)] -= 1
    sampler.update_signals(
        slots,
        {RELATIVE_VALUE.name: errors, RELATIVE_ERROR.name: errors},
        storage=storage,
        written_at=written_at,
        batches=batches,
    )
    return table.rows[:, table.column[RELATIVE_ERROR.name]]


def test_errors_of_several_batches_in_one_update_are_relative_to_their_own_batch():
    errors = torch.rand(16, generator=seeded(5)) + 0.1
    errors[8:] *= 100
    found = relative_errors(2, errors)
    assert found[:8].tolist() == pytest.approx((errors[:8] / errors[:8].max()).tolist())
    assert found[8:].tolist() == pytest.approx((errors[8:] / errors[8:].max()).tolist())


def test_overwritten_row_does_not_count_in_its_batch():
    errors = torch.tensor([1.0, 100.0, 2.0, 4.0])
    assert relative_errors(1, errors, stale=[1])[[0, 2, 3]].tolist() == [0.25, 0.5, 1.0]
    errors = torch.tensor([1.0, 2.0, 100.0, torch.nan])
    assert relative_errors(2, errors, stale=[2, 3])[:2].tolist() == [0.5, 1.0]
