"""Buffers whose parts are made at their first use, as in TorchRL."""

import pytest
import torch
from torchrl.envs.transforms import DoubleToFloat, RewardScaling

from tests.mpfa.transitions import (
    make_buffer,
    make_transitions,
    same,
    seeded,
    snapshot,
    write_signals,
)
from torchrl_mpfa import MPFASampler, SignalReplayBuffer, SignalTensorStorage


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


def test_statistics_do_not_make_the_parts():
    buffer = make_delayed()
    assert buffer.stats()["initialized"] is False
    assert not buffer.initialized


def test_parts_that_do_not_fit_are_rejected_at_every_use():
    buffer = make_delayed(8)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"max_capacity of the sampler is 8, max_size .* 16"):
            buffer.extend(make_transitions(2))
