"""The check of parts of one's own: all of ours pass, and broken ones are caught."""

import pytest
import torch

from benchmarks.paper.methods.hvper import (
    RELATIVE_ERROR,
    RELATIVE_VALUE,
    HVPERPenalty,
    ScheduledFusion,
    value_schedule,
)
from benchmarks.paper.methods.mw import MWSampler
from torchrl_mpfa import (
    Adjustment,
    EntropyFusion,
    FixedFusion,
    Fusion,
    MPFASampler,
    PositiveBoost,
    PositiveDecay,
    ScaledFusion,
    SignalSampler,
)
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.lap import LAPFloor
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.testing import check_sampler


def with_parts(signals=("reward", "td_error"), fusion=None, adjustment=None):
    adjustments = () if adjustment is None else [adjustment]
    return SignalSampler(
        40, 0.6, 0.4, 0.05, signals=signals, fusion=fusion, adjustments=adjustments
    )


@pytest.mark.parametrize(
    "adjustment",
    [
        PositiveBoost(),
        PositiveBoost(bound="cap"),
        PositiveBoost(target_share=0.5),
        PositiveDecay(),
        PositiveDecay(position="rank"),
        PositiveDecay(position="count"),
        LAPFloor(1.0),
        HVPERPenalty(),
    ],
)
def test_our_adjustments_pass(adjustment):
    check_sampler(lambda: with_parts(adjustment=adjustment))


@pytest.mark.parametrize(
    ("fusion", "signals"),
    [
        (EntropyFusion(), ["reward", "td_error", "action_gradient"]),
        (EntropyFusion(population="batch", floor=0.1), ["reward", "novelty"]),
        (EntropyFusion(), ["td_error", "action_gradient"]),
        (FixedFusion({"td_error": 1.0}), ["reward", "td_error"]),
        (ScaledFusion(FixedFusion({"reward": 1.0, "td_error": 1.0})), ["reward", "td_error"]),
        (ScheduledFusion({"reward": 1.0}, {"td_error": 1.0}), ["reward", "td_error"]),
        (value_schedule(), [RELATIVE_VALUE, RELATIVE_ERROR]),
    ],
)
def test_our_fusions_pass(fusion, signals):
    check_sampler(lambda: with_parts(signals, fusion))


@pytest.mark.parametrize(
    "make",
    [
        lambda: MPFASampler(40),
        lambda: MPFASampler(40, stratified=True, max_priority_within_buffer=False),
        lambda: SignalSampler(40, 0.6, 0.4, 0.05, dtype=torch.double),
        lambda: SignalSampler(40, 0.0, 0.4),
        lambda: RankPERSampler(40, 0.7, 0.5, 0.05),
        lambda: MWSampler(40, 0.6, 0.4, 0.05, replay_cap=1000),
        lambda: LA3PSampler(40, 0.4, 0.0, 0.01),
    ],
    ids=["mpfa", "stratified", "double", "uniform", "rank", "capped", "la3p"],
)
def test_our_samplers_pass(make):
    check_sampler(make)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda priority, batch: priority[:0], r"must be a tensor of shape \[1\], got shape \[0\]"),
        (lambda priority, batch: 3.0, r"must be a tensor of shape \[1\], got float"),
        (lambda priority, batch: -priority, "must be finite and not negative, got -"),
        (lambda priority, batch: priority / 0.0, "must be finite and not negative, got inf"),
        (lambda priority, batch: priority * torch.rand(()), "update as the one that saved it"),
    ],
)
def test_broken_adjustments_are_caught(broken, message):
    class Broken(Adjustment):
        def __call__(self, priority, batch):
            return broken(priority, batch)

    with pytest.raises((AssertionError, ValueError), match=message):
        check_sampler(lambda: with_parts(adjustment=Broken()))
    with pytest.raises(TypeError, match=r"torchrl_mpfa\.Adjustment"):
        check_sampler(lambda: with_parts(adjustment=broken))


class Broken(Fusion):
    def __init__(self, weigh):
        self.weights = weigh


def scribble(names, table, index):
    table.rows[:10] = 1.0
    return torch.ones(len(names))


@pytest.mark.parametrize(
    ("weigh", "message"),
    [
        (lambda names, table, index: torch.ones(1), r"weights of the fusion must be .*\[3\]"),
        (lambda names, table, index: [1.0] * len(names), "weights of the fusion .*got list"),
        (lambda names, table, index: torch.zeros(len(names)), "one weight must be positive"),
        (lambda names, table, index: -torch.ones(len(names)), "must be finite and not negative"),
        (lambda names, table, index: table.rewards.mean().log().expand(3), "got nan|got -inf"),
        (lambda names, table, index: torch.arange(1.0, 4.0), "must follow the order of names"),
        (scribble, "must not change the rewards"),
    ],
)
def test_broken_fusions_are_caught(weigh, message):
    with pytest.raises((AssertionError, ValueError), match=message):
        check_sampler(lambda: with_parts(["reward", "td_error", "novelty"], Broken(weigh)))
    with pytest.raises(TypeError, match=r"torchrl_mpfa\.Fusion"):
        check_sampler(lambda: with_parts(fusion=object()))


class SamplesSlotZero(SignalSampler):
    def _sample_slots(self, size, batch_size):
        index, weight = super()._sample_slots(size, batch_size)
        return torch.where(torch.rand(batch_size, generator=self._rng) < 0.1, 0, index), weight


class GivesNegativeWeights(SignalSampler):
    def _sample_slots(self, size, batch_size):
        index, weight = super()._sample_slots(size, batch_size)
        return index, -weight


class SamplesTooFew(SignalSampler):
    def _sample_slots(self, size, batch_size):
        index, weight = super()._sample_slots(size, batch_size)
        return index[1:], weight[1:]


class KeepsACountToItself(SignalSampler):
    """Batches depend on a count that is not saved."""

    calls = 0

    def _sample_slots(self, size, batch_size):
        self.calls += 1
        index, weight = super()._sample_slots(size, batch_size)
        return (index + self.calls) % size, weight


class ForgetsAlpha(SignalSampler):
    def load_state_dict(self, state_dict):
        super().load_state_dict(state_dict)
        self._alpha = 0.123


class TakesEverything(SignalSampler):
    def update_priority(self, index, priority, *, storage=None):
        super().update_priority(index, priority.nan_to_num(1.0).abs(), storage=storage)


class ChangesFirst(SignalSampler):
    def update_priority(self, index, priority, *, storage=None):
        self._beta += 0.1
        super().update_priority(index, priority, storage=storage)


class LoadsAnything(SignalSampler):
    def load_state_dict(self, state_dict):
        if len(state_dict) == len(self.state_dict()):
            super().load_state_dict(state_dict)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (SamplesSlotZero, "slot 0 must be sampled with probability"),
        (GivesNegativeWeights, r"priority_weight must be in \(0, 1\]"),
        (SamplesTooFew, "a batch must have 16 integer slots"),
        (KeepsACountToItself, "must sample and update as the one that saved it"),
        (ForgetsAlpha, "must have that state"),
        (TakesEverything, "a priority of nan must be rejected"),
        (ChangesFirst, "was rejected, but changed the sampler"),
        (LoadsAnything, "a state without .* must be rejected"),
    ],
)
def test_broken_samplers_are_caught(broken, message):
    with pytest.raises(AssertionError, match=message):
        check_sampler(lambda: broken(40, 0.6, 0.4, 0.05))
