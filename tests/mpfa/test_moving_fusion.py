"""Fusions whose weights move with the training or with the scale of the signals."""

import pytest

from tests.mpfa.transitions import make_filled, train_rounds
from torchrl_mpfa import FixedFusion, Fusion, ScaledFusion
from torchrl_mpfa.methods.hvper import ScheduledFusion
from torchrl_mpfa.samplers.table import SignalTable

NAMES = ["td_error", "reward"]


def make_table(rows):
    """A table of two signals, reward unknown where it is None."""
    table = SignalTable(10, ["td_error", "reward"])
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
        found.append(fusion.weights(NAMES, None, None).tolist())
    assert found == [pytest.approx(w) for w in ([1.0, 0.0], [0.8, 0.2], [0.2, 0.8])]
    assert isinstance(fusion, Fusion)


def test_scaled_signals_have_the_shares_that_their_weights_say():
    table = make_table([(1.0, 100.0), (3.0, 300.0), (None, 800.0)])
    weights = ScaledFusion(FixedFusion(dict.fromkeys(NAMES, 1.0))).weights(NAMES, table, None)
    # Means of what is known: 2 and 400.
    assert weights.tolist() == pytest.approx([1 / 2, 1 / 400])


def test_a_signal_without_a_scale_is_not_scaled():
    table = make_table([(None, 0.0), (None, 0.0)])
    weights = ScaledFusion(FixedFusion(dict.fromkeys(NAMES, 1.0))).weights(NAMES, table, None)
    assert weights.tolist() == [1.0, 1.0]


def test_scaled_fusion_passes_the_schedule_on():
    inner = ScheduledFusion({"td_error": 1.0}, {"reward": 1.0})
    fusion = ScaledFusion(inner)
    assert fusion.every_batch
    fusion.anneal(1.0)
    assert inner.weights(NAMES, None, None).tolist() == [0.0, 1.0]
    ScaledFusion(FixedFusion()).anneal(0.5)  # Nothing to tell, and no error.


def test_sampler_passes_the_schedule_to_its_fusion():
    fusion = ScheduledFusion({"td_error": 1.0}, {"reward": 1.0})
    buffer = make_filled(24, 6, fusion=fusion)
    for fraction, expected in ((0.0, 1.0), (1.0, 0.0)):
        buffer.sampler.anneal(fraction)
        train_rounds(buffer, 1)
        assert buffer.sampler.weights["td_error"] == pytest.approx(expected)
