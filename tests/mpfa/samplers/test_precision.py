"""Sampling in double precision, and stratified: frequencies within the noise of chi-square."""

import math

import pytest
import torch
from torchrl.data import LazyTensorStorage

from tests.mpfa.transitions import seeded
from torchrl_mpfa.samplers import TreeSampler

pytestmark = pytest.mark.usefixtures("path")


def filled(sampler, count, *, spread=3.0):
    """A storage of so many slots with random priorities, and their probabilities."""
    storage = LazyTensorStorage(count)
    storage.set(torch.arange(count), torch.zeros(count))
    priority = (torch.randn(count, generator=seeded(0), dtype=torch.double) * spread).exp() + 1e-3
    sampler.mark_update(torch.arange(count), storage=storage)
    sampler.update_priority(torch.arange(count), priority.float())
    sampler._rng = seeded(1)
    return storage, priority / priority.sum()


def score(index, probability):
    """Standard score of chi-square over the slots that are expected five times or more."""
    count, samples = torch.bincount(index, minlength=len(probability)), len(index)
    expected = probability * samples
    often = expected >= 5
    # All others together are one more cell.
    found = torch.cat((count[often], count[~often].sum().reshape(1)))
    wanted = torch.cat((expected[often], expected[~often].sum().reshape(1)))
    found, wanted = found[wanted > 0], wanted[wanted > 0]
    degrees = len(wanted) - 1
    square = float(((found - wanted).square() / wanted).sum())
    return (square - degrees) / math.sqrt(2 * degrees)


def sampled(sampler, storage, samples):
    return torch.cat([sampler.sample(storage, samples // 10)[0] for _ in range(10)])


def test_single_slots_of_many_have_their_frequencies():
    slots, samples = 1_000_000, 6_000_000
    sampler = TreeSampler(slots, 1.0, 0.4, 0.0)
    storage, probability = filled(sampler, slots, spread=0.3)
    assert abs(score(sampled(sampler, storage, samples), probability)) < 4


def test_the_weight_of_a_batch_of_one_is_in_the_precision_that_is_asked_for():
    for dtype, error in ((torch.double, 1e-14), (torch.float, 1e-6)):
        sampler = TreeSampler(100, 0.6, 0.4, dtype=dtype)
        storage, _ = filled(sampler, 100)
        slots, info = sampler.sample(storage, 1)
        expected = sampler.batch_weights(100)[slots].to(dtype)
        torch.testing.assert_close(info["priority_weight"], expected, rtol=error, atol=0.0)


def test_stratified_batches_take_one_slot_from_each_part_of_the_priority():
    sampler = TreeSampler(50, 1.0, 0.4, 0.0, stratified=True)
    storage, probability = filled(sampler, 50, spread=1.0)
    edges = probability.cumsum(0)
    for _ in range(20):
        index, _ = sampler.sample(storage, 64)
        count = torch.bincount(index, minlength=50)
        # A slot that has a share of the priority is sampled so often, give or take one.
        whole = (64 * edges).floor() - (64 * (edges - probability)).ceil()
        assert (count >= whole.clamp_min(0)).all()
        assert ((count - 64 * probability).abs() < 2).all()


def test_stratified_batches_have_the_same_frequencies_and_come_in_no_order():
    sampler = TreeSampler(200, 1.0, 0.4, 0.0, stratified=True)
    storage, probability = filled(sampler, 200, spread=0.5)
    batches = torch.stack([sampler.sample(storage, 64)[0] for _ in range(3000)])
    found = torch.bincount(batches.flatten(), minlength=200) / batches.numel()
    # Less than the noise of independent samples.
    sigma = (probability * (1 - probability) / batches.numel()).sqrt()
    assert ((found - probability).abs() < 4 * sigma).all()
    # No place of a batch holds other slots than another one does.
    means = batches.double().mean(0)
    assert ((means - means.mean()).abs() < 5 * batches.double().std() / math.sqrt(3000)).all()
