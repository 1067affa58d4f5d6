"""A sampler in a buffer or storage that is not its own, and names and slots that are none."""

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.mpfa.transitions import (
    make_buffer,
    make_transitions,
    same,
    seeded,
    snapshot,
    train_rounds,
    write_signals,
)
from torchrl_mpfa import (
    MPFASampler,
    SignalTensorStorage,
)
from torchrl_mpfa.samplers import TreeSampler


@pytest.mark.parametrize("key", ["td_error", "unknown"])
def test_a_buffer_of_torchrl_causes_one_warning(key):
    buffer = TensorDictReplayBuffer(
        storage=SignalTensorStorage(16), sampler=MPFASampler(16), batch_size=4, priority_key=key
    )
    buffer.extend(make_transitions(16))
    with pytest.warns(UserWarning, match="neither fused nor adjusted.*SignalReplayBuffer") as seen:
        for _ in range(3):
            batch = buffer.sample()
            batch["td_error"] = torch.rand(4)
            buffer.update_tensordict_priority(batch)
    assert len(seen) == 1


def test_a_storage_of_torchrl_causes_one_warning():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(16), sampler=MPFASampler(16), batch_size=4
    )
    buffer.extend(make_transitions(16))
    with pytest.warns(UserWarning, match="LazyTensorStorage, which keeps no signals") as seen:
        for _ in range(3):
            buffer.sample()
    assert len(seen) == 1


def test_a_buffer_and_storage_of_ours_need_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        buffer = make_buffer(16)
        buffer.extend(make_transitions(16))
        train_rounds(buffer, 2)
        buffer.update_priority(torch.tensor([1]), torch.tensor([2.0]))  # By hand, on purpose.


@pytest.mark.parametrize(
    "index",
    [
        torch.tensor([True, False, True]),
        torch.tensor([0.0, 1.7]),
        np.array([True, False]),
        [0.5],
        (torch.tensor([0.0]), torch.tensor([1.0])),
    ],
)
def test_masks_and_floats_are_no_index(index):
    buffer = make_buffer(8)
    buffer.extend(make_transitions(8))
    train_rounds(buffer, 2)
    before = snapshot(buffer)
    count = 1 if isinstance(index, tuple) else len(index)
    signals = {"td_error": torch.ones(count), "action_gradient": torch.ones(count)}
    for call in (
        lambda: buffer.sampler.update_priority(index, torch.ones(count)),
        lambda: buffer.sampler.mark_update(index),
        lambda: buffer.sampler.update_signals(index, signals, storage=buffer.storage),
    ):
        with pytest.raises(TypeError, match="index must hold integers, got"):
            call()
    assert same(before, snapshot(buffer))


@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_priorities_whose_sum_overflows_are_rejected(alpha):
    sampler = TreeSampler(1000, alpha, 0.4)
    sampler.mark_update(torch.arange(1000))
    before = sampler.state_dict()
    with pytest.raises(ValueError, match=r"priority must not be so high that sums overflow, got"):
        sampler.update_priority([3], torch.tensor([1e306], dtype=torch.double))
    assert same(before, sampler.state_dict())
    sampler.update_priority([3], torch.tensor([2e38]))  # Would overflow in single precision.
    assert sampler.priorities(torch.tensor([3])).item() == pytest.approx(2e38)


def test_a_rejected_update_changes_nothing_at_all():
    """Not even the weights, which were counted before an adjustment failed."""

    def broken(priority, batch):
        return priority * torch.nan

    buffer = make_buffer(8, entropy_refresh=0)
    buffer.extend(make_transitions(8))
    train_rounds(buffer, 2)
    batch = write_signals(buffer.sample())
    buffer.extend(make_transitions(2, seed=5))
    before = snapshot(buffer)
    buffer.sampler.adjustments = (broken,)
    with pytest.raises(ValueError, match="adjusted priorities must be finite"):
        buffer.update_tensordict_priority(batch)
    assert same(before, snapshot(buffer))


def make_two_dimensional(steps=6, robots=3):
    number = torch.arange(steps * robots).reshape(steps, robots)
    sampler = TreeSampler(steps * robots, 1.0, 0.4, 0.0)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(steps * robots, ndim=2),
        sampler=sampler,
        batch_size=200,
        generator=seeded(2),
    )
    buffer.extend(TensorDict({"number": number}, [steps, robots]))
    return buffer, sampler


def test_a_storage_of_two_dimensions_is_sampled_and_updated_as_torchrl_does():
    buffer, sampler = make_two_dimensional()
    batch = buffer.sample()
    assert batch["index"].shape == (200, 2)
    # TorchRL turns the two dimensions around.
    assert batch["number"].equal(batch["index"][:, 0] + batch["index"][:, 1] * 3)
    slots = batch["index"][:, 0] * 6 + batch["index"][:, 1]
    batch["td_error"] = slots.float() + 1.0
    buffer.update_tensordict_priority(batch)
    assert sampler.priorities().tolist() == [float(n + 1) for n in range(18)]
    place = torch.tensor([2]), torch.tensor([5])
    sampler.update_priority(place, torch.tensor([7.0]), storage=buffer._storage)
    assert sampler.priorities()[17] == 7.0


def test_a_place_outside_a_storage_of_two_dimensions_is_rejected():
    buffer, sampler = make_two_dimensional()
    before = sampler.state_dict()
    # As a number it would be a slot: 0 * 6 + 6.
    with pytest.raises(IndexError, match=r"within the storage's shape \[3, 6\], got \[0, 6\]"):
        sampler.update_priority(torch.tensor([[0, 6]]), torch.ones(1), storage=buffer._storage)
    with pytest.raises(RuntimeError, match="index must have one dimension"):
        sampler.update_priority(torch.tensor([[0, 6]]), torch.ones(1))
    assert same(before, sampler.state_dict())


def test_large_batches_with_twins_keep_the_last_of_each():
    sampler = TreeSampler(50, 1.0, 0.4, 0.0)
    slots = torch.randint(50, (40_000,), generator=seeded(3))
    priority = torch.rand(40_000, generator=seeded(4), dtype=torch.double) + 0.1
    sampler.update_priority(slots, priority)
    expected = {slot: value for slot, value in zip(slots.tolist(), priority.tolist(), strict=True)}
    assert sampler.priorities().tolist() == [expected[slot] for slot in range(50)]
    assert torch.as_tensor(sampler._sum_tree[torch.arange(50)]).equal(sampler.priorities())
