"""Parts of a buffer that are not its own, that do not fit, or that are made at their first use."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import DoubleToFloat, RewardScaling

from tests.mpfa.transitions import (
    make_buffer,
    make_filled,
    make_transitions,
    rejected,
    same,
    seeded,
    snapshot,
    train_rounds,
    write_signals,
)
from torchrl_mpfa import (
    Adjustment,
    MPFASampler,
    SignalReplayBuffer,
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


@pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized:UserWarning")
@pytest.mark.parametrize("kind", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("write", ["extend", "add", "in place"])
def test_a_storage_of_torchrl_gives_the_same_batches_and_priorities(kind, write):
    ours, theirs = make_filled(16), make_filled(16, storage=kind(16))
    for buffer in (ours, theirs):
        new = make_transitions(3, seed=7, first=50)
        if write == "extend":
            buffer.extend(new)
        elif write == "add":
            buffer.add(new[0])
        else:
            buffer[torch.tensor([5, 2, 9])] = new
    assert train_rounds(ours, 4).equal(train_rounds(theirs, 4))
    assert same(ours.sampler.state_dict(), theirs.sampler.state_dict())
    again = make_buffer(16, storage=kind(16), seed=3)
    again.load_state_dict(snapshot(theirs))
    assert train_rounds(ours, 2).equal(train_rounds(again, 2))


def test_trajectories_in_a_list_of_torchrl_s_stay_whole():
    trajectories = TensorDict({"observation": torch.rand(3, 4, 5)}, [3, 4])
    buffer = SignalReplayBuffer(sampler=TreeSampler(5, 0.7, 0.9), batch_size=3)
    buffer.extend(trajectories)
    assert len(buffer) == 3
    assert buffer.sample()["observation"].shape == (3, 4, 5)


@pytest.mark.parametrize("storage", [SignalTensorStorage, LazyTensorStorage])
def test_sampler_without_a_capacity_takes_that_of_the_storage(storage):
    given, taken = (
        make_filled(16, storage=storage(16), sampler=MPFASampler(n)) for n in (16, None)
    )
    assert taken.sampler.max_size == taken.sampler.table.capacity == 16
    assert train_rounds(given, 3).equal(train_rounds(taken, 3))
    assert same(given.sampler.state_dict(), taken.sampler.state_dict())
    with pytest.raises(ValueError, match=r"max_capacity of the sampler is 16, max_size .* 8"):
        make_buffer(8, storage=storage(8), sampler=taken.sampler)


def test_signals_follow_each_write_of_two_buffers_that_share_a_storage():
    storage = SignalTensorStorage(16)
    first, second = make_buffer(16, storage=storage), make_buffer(16, storage=storage)
    first.extend(make_transitions(16))
    second.extend(make_transitions(3, seed=4))
    expected = storage[:]["next", "reward"].squeeze(1)
    for buffer in (first, second):
        assert buffer.sampler.table.rewards.float().equal(expected)


def test_a_rejected_update_changes_nothing_at_all():
    """Not even the weights, which were counted before an adjustment failed."""

    class Broken(Adjustment):
        def __call__(self, priority, batch):
            return priority * torch.nan

    buffer = make_filled(8, entropy_refresh=0)
    train_rounds(buffer, 2)
    batch = write_signals(buffer.sample())
    buffer.extend(make_transitions(2, seed=5))
    buffer.sampler.adjustments = (Broken(),)
    with rejected(buffer, ValueError, "adjusted priorities must be finite"):
        buffer.update_tensordict_priority(batch)


# Buffers whose parts are made at their first use.


def make_delayed(capacity=16, **kwargs):
    return SignalReplayBuffer(
        storage=lambda: SignalTensorStorage(16),
        sampler=lambda: MPFASampler(capacity),
        batch_size=4,
        generator=seeded(),
        **({"delayed_init": True} | kwargs),
    )


def test_parts_that_are_made_later_equal_those_made_at_once():
    now, later = make_buffer(), make_delayed()
    for buffer in (now, later):
        buffer.extend(make_transitions(15))
        buffer.add(make_transitions(1, first=15)[0])
        buffer.update_tensordict_priority(write_signals(buffer.sample()))
    assert same(now.state_dict(), later.state_dict())
    lacking = make_transitions(2).exclude(("next", "reward"))
    with pytest.raises(KeyError, match="reward"):
        later.extend(lacking)


def test_the_transforms_of_a_factory_act_on_what_is_written_and_sampled():
    later = make_delayed(
        delayed_init=None,
        transform_factory=lambda: RewardScaling(0.0, 10.0, in_keys=[("next", "reward")]),
    )
    later.extend(make_transitions(10))
    batch = later.sample()
    written = later.rewards()[batch["index"]]
    torch.testing.assert_close(batch["next", "reward"].flatten().double(), written * 10)
    later = make_delayed(
        transform_factory=lambda: DoubleToFloat(
            in_keys=["observation"], in_keys_inv=["observation"]
        )
    )
    later.add(make_transitions(1)[0])
    assert later.storage[:]["observation"].dtype is torch.float64


def test_any_first_call_makes_the_parts(tmp_path):
    filled = make_buffer()
    filled.extend(make_transitions(10))
    filled.dumps(tmp_path / "buffer")
    first = {
        "extend": lambda buffer: buffer.extend(make_transitions(1)),
        "add": lambda buffer: buffer.add(make_transitions(1)[0]),
        "empty": lambda buffer: buffer.empty(),
        "rewards": lambda buffer: buffer.rewards(),
        "distributions": lambda buffer: buffer.distributions(),
        "anneal": lambda buffer: buffer.anneal(0.5, 0.5),
        "state_dict": lambda buffer: buffer.state_dict(),
        "load_state_dict": lambda buffer: buffer.load_state_dict(snapshot(filled)),
        "loads": lambda buffer: buffer.loads(tmp_path / "buffer"),
    }
    for name, call in first.items():
        buffer = make_delayed()
        call(buffer)
        assert buffer.storage.signal_table is buffer.sampler.table, name
    with pytest.raises(RuntimeError, match="cannot sample from an empty buffer"):
        make_delayed().sample()


def test_parts_that_do_not_fit_are_rejected_at_every_use():
    buffer = make_delayed(8)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"max_capacity of the sampler is 8, max_size .* 16"):
            buffer.extend(make_transitions(2))
