"""Padded trajectories: what a mask leaves out is never stored."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors.utils import split_trajectories
from torchrl.envs.transforms.rb_transforms import MultiStepTransform

from tests.mpfa.transitions import make_buffer
from torchrl_mpfa import SignalSliceSampler, SignalTensorStorage
from torchrl_mpfa.methods.her import HindsightGoals


def steps(lengths, *, first=1.0):
    """Trajectories of these lengths, one after the other, with steps numbered from the first."""
    count = sum(lengths)
    number = torch.arange(first, first + count).unsqueeze(1)
    ends = torch.zeros(count, 1, dtype=torch.bool)
    ends[torch.tensor(lengths).cumsum(0) - 1] = True
    ids = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    after = {"observation": number + 1, "reward": number, "done": ends, "terminated": ends.clone()}
    rows = {"observation": number, "next": after, "collector": {"traj_ids": ids}}
    return TensorDict(rows, [count])


def padded(lengths, *, prefix="collector", **kwargs):
    """The same, as TorchRL's collectors with ``split_trajs`` give them."""
    found = split_trajectories(steps(lengths, **kwargs), trajectory_key=("collector", "traj_ids"))
    mask = found.pop(("collector", "mask"), None)
    mask = found.pop("mask") if mask is None else mask
    key = (prefix, "mask") if prefix else "mask"
    return found.set(key, mask)


def stored(buffer):
    return buffer[:]["observation"].flatten().tolist()


@pytest.mark.parametrize("prefix", ["collector", ""])
def test_padding_of_split_trajectories_is_left_out(prefix):
    buffer = make_buffer(batch_size=8)
    index = buffer.extend(padded([2, 4, 1], prefix=prefix))
    assert index.tolist() == list(range(7))
    assert stored(buffer) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    # The next ones may have no padding at all.
    buffer.extend(padded([3, 3], prefix=prefix, first=8.0))
    assert stored(buffer) == [float(number) for number in range(1, 14)]


def test_a_single_step_of_padding_is_not_added():
    buffer = make_buffer()
    rows = padded([2, 1])
    assert buffer.add(rows[1, 1]).numel() == 0
    assert len(buffer) == 0
    assert buffer.add(rows[1, 0]) == 0


def test_slices_of_padded_trajectories_have_no_step_of_another_one():
    sampler = SignalSliceSampler(32, 0.6, 0.4, slice_len=3, signals=["reward"])
    buffer = make_buffer(32, 30, sampler=sampler)
    buffer.extend(padded([3, 5, 4]))
    slices = buffer.sample().reshape(10, 3)
    assert slices["observation"].diff(dim=1).unique().tolist() == [1.0]
    assert (slices["collector", "traj_ids"].diff(dim=1) == 0).all()


def test_mask_of_ones_own_is_data():
    buffer = make_buffer()
    rows = steps([4]).set("mask", torch.tensor([[True], [False], [True], [False]]))
    buffer.extend(rows)
    assert stored(buffer) == [1.0, 2.0, 3.0, 4.0]


def of_two_dimensions():
    return make_buffer(16, storage=SignalTensorStorage(16, ndim=2))


def with_hindsight():
    goals = HindsightGoals(lambda rows, goals: rows, episode_key="episode")
    return make_buffer(32, transform=goals)


def with_steps():
    return make_buffer(32, transform=MultiStepTransform(n_steps=2, gamma=0.9, done_keys=["done"]))


@pytest.mark.parametrize("make", [of_two_dimensions, with_hindsight, with_steps])
def test_padding_that_cannot_be_left_out_is_rejected_and_changes_nothing(make):
    buffer = make()
    with pytest.raises(ValueError, match=r"padding, which \('collector', 'mask'\) marks"):
        buffer.extend(padded([2, 4]))
    assert len(buffer) == 0
