"""Warnings of a buffer: mistakes that raise no error, and make its batches or targets wrong."""

import pytest
import torch
from torchrl.data.replay_buffers import PrioritizedSampler
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs.transforms import Compose, DoubleToFloat, MultiStepTransform

from tests.mpfa.transitions import make_buffer, make_transitions, write_signals
from torchrl_mpfa import MPFASampler, SignalTensorStorage
from torchrl_mpfa.samplers import TreeSampler

PRIORITIZED = {
    "fused": MPFASampler,
    "one number": lambda capacity: TreeSampler(capacity, 0.6, 0.4),
    "torchrl": lambda capacity: PrioritizedSampler(capacity, 0.6, 0.4),
}


def buffer_with(sampler, **options):
    return make_buffer(20, sampler=sampler, storage=SignalTensorStorage(20), **options)


def filled_buffer(sampler):
    buffer = buffer_with(sampler)
    buffer.extend(make_transitions(10))
    return buffer


@pytest.mark.parametrize("info", [False, True])
@pytest.mark.parametrize("kind", PRIORITIZED)
def test_loop_that_never_updates_priorities_is_warned_once(kind, info):
    buffer = filled_buffer(PRIORITIZED[kind](20))
    with pytest.warns(UserWarning, match=r"100 batches in a row .* update_tens") as found:
        for _ in range(300):
            buffer.sample(return_info=info)
    assert len(found) == 1


@pytest.mark.parametrize("kind", PRIORITIZED)
def test_loop_that_updates_priorities_now_and_then_is_not_warned(kind):
    buffer = filled_buffer(PRIORITIZED[kind](20))
    for number in range(300):
        batch = write_signals(buffer.sample())
        if number % 50 == 0:
            batch["td_error"] = batch["signals", "td_error"]
            buffer.update_tensordict_priority(batch)


@pytest.mark.parametrize(
    "sampler", [RandomSampler(), MPFASampler(20, alpha=0.0)], ids=["", "alpha"]
)
def test_loop_of_uniform_replay_is_not_warned(sampler):
    buffer = filled_buffer(sampler)
    for _ in range(300):
        buffer.sample()


def test_an_update_that_is_rejected_does_not_count_as_one():
    buffer = make_buffer()
    buffer.extend(make_transitions(10))
    with pytest.warns(UserWarning, match="100 batches in a row"):
        for _ in range(101):
            batch = write_signals(buffer.sample())
            with pytest.raises(KeyError, match="'index' is missing"):
                buffer.update_tensordict_priority(batch.exclude("index"))


def test_transform_that_bootstraps_past_an_episode_causes_one_warning():
    buffer, rows = buffer_with(RandomSampler()), make_transitions(4)
    rows["next", "done"] = rows["next", "terminated"] = torch.zeros(4, 1, dtype=torch.bool)
    buffer.append_transform(Compose(DoubleToFloat(), MultiStepTransform(n_steps=3, gamma=0.99)))
    with pytest.warns(UserWarning, match=r"bootstrapped past .* done_keys=\['done'\]") as found:
        buffer.extend(rows)
        buffer.extend(rows)
    assert len(found) == 1


@pytest.mark.parametrize("done_keys", [["done"], ["done", "truncated"], None])
def test_transform_that_stops_at_the_end_of_an_episode_causes_no_warning(done_keys):
    buffer, rows = buffer_with(RandomSampler()), make_transitions(4)
    for key in done_keys or ("done", "terminated", "truncated"):
        rows["next", key] = torch.zeros(4, 1, dtype=torch.bool)
    steps = 3 if done_keys else 1
    buffer.append_transform(MultiStepTransform(steps, gamma=0.99, done_keys=done_keys))
    buffer.extend(rows)
