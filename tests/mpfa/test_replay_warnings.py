"""What a buffer warns of: mistakes that would raise no error and end in uniform replay or worse."""

import pytest
from torchrl.data.replay_buffers import PrioritizedSampler
from torchrl.data.replay_buffers.samplers import RandomSampler

from tests.mpfa.transitions import make_buffer, make_transitions, write_signals
from torchrl_mpfa import MPFASampler, SignalReplayBuffer, SignalTensorStorage, TreeSampler

PRIORITIZED = {
    "fused": MPFASampler,
    "one number": lambda capacity: TreeSampler(capacity, 0.6, 0.4),
    "torchrl": lambda capacity: PrioritizedSampler(capacity, 0.6, 0.4),
}


def buffer_with(sampler):
    storage = SignalTensorStorage(20, signals=["reward", "td_error", "action_gradient"])
    buffer = SignalReplayBuffer(storage=storage, sampler=sampler, batch_size=4)
    buffer.extend(make_transitions(10))
    return buffer


@pytest.mark.parametrize("info", [False, True])
@pytest.mark.parametrize("kind", PRIORITIZED)
def test_a_loop_that_never_updates_priorities_is_told_once_whatever_its_loss_writes(kind, info):
    buffer = buffer_with(PRIORITIZED[kind](20))
    with pytest.warns(UserWarning, match=r"100 batches in a row .* update_tens") as told:
        for _ in range(300):
            buffer.sample(return_info=info)
    assert len(told) == 1


@pytest.mark.parametrize("kind", PRIORITIZED)
def test_a_loop_that_updates_priorities_now_and_then_is_not_told(kind):
    buffer = buffer_with(PRIORITIZED[kind](20))
    for number in range(300):
        batch = write_signals(buffer.sample())
        if number % 50 == 0:
            batch["td_error"] = batch["signals", "td_error"]
            buffer.update_tensordict_priority(batch)


@pytest.mark.parametrize(
    "sampler", [RandomSampler(), MPFASampler(20, alpha=0.0)], ids=["", "alpha"]
)
def test_a_loop_of_uniform_replay_is_not_told_to_update_priorities(sampler):
    buffer = buffer_with(sampler)
    for _ in range(300):
        buffer.sample()


def test_an_update_that_is_refused_does_not_count_as_one():
    buffer = make_buffer()
    buffer.extend(make_transitions(10))
    with pytest.warns(UserWarning, match="100 batches in a row"):
        for _ in range(101):
            batch = write_signals(buffer.sample())
            with pytest.raises(KeyError, match="'index' is missing"):
                buffer.update_tensordict_priority(batch.exclude("index"))
