"""A sampler in a buffer or storage that is not its own, and names and slots that are none."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from tests.mpfa.transitions import (
    make_filled,
    make_transitions,
    rejected,
    same,
    seeded,
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
        buffer = make_filled(16)
        train_rounds(buffer, 2)
        buffer.update_priority(torch.tensor([1]), torch.tensor([2.0]))  # By hand, on purpose.


def test_a_rejected_update_changes_nothing_at_all():
    """Not even the weights, which were counted before an adjustment failed."""

    def broken(priority, batch):
        return priority * torch.nan

    buffer = make_filled(8, entropy_refresh=0)
    train_rounds(buffer, 2)
    batch = write_signals(buffer.sample())
    buffer.extend(make_transitions(2, seed=5))
    buffer.sampler.adjustments = (broken,)
    with rejected(buffer, ValueError, "adjusted priorities must be finite"):
        buffer.update_tensordict_priority(batch)


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
