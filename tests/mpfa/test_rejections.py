"""Rejections by a buffer: the error names argument and value, and nothing has changed."""

import pytest
import torch
from torchrl.data import PrioritizedSampler, Sequence, Transition

from tests.mpfa.transitions import (
    make_buffer,
    make_transitions,
    rejected,
    same,
    snapshot,
    train_rounds,
    write_signals,
)
from torchrl_mpfa import MPFASampler, Signal, SignalReplayBuffer, SignalSampler, SignalTensorStorage
from torchrl_mpfa.samplers.uniform import CERSampler


@pytest.fixture
def buffer():
    """A buffer in the middle of its training, not yet full."""
    buffer = make_buffer(16)
    buffer.extend(make_transitions(10))
    train_rounds(buffer, 3)
    return buffer


def put(key, value, place=slice(None)):
    def change(batch):
        batch[key][place] = value
        return batch

    return change


def replaced(key, value):
    return lambda batch: batch.set(key, value)


def without(key):
    return lambda batch: batch.exclude(key)


TD_ERROR = ("signals", "td_error")
LEARNED = ("td_error", "action_gradient")
UPDATES = [
    *[
        (
            without(("signals", name)),
            f"signal '{name}' is missing: .*'signals', '{name}'.*ActorCritic.*batch",
        )
        for name in LEARNED
    ],
    (without("signals"), "signal 'td_error' is missing"),
    (without("index"), r"'index' is missing in the batch, got \["),
    *[
        (
            put(("signals", name), wrong, 2),
            f"signal '{name}' must be finite and not negative, got {wrong}",
        )
        for name in LEARNED
        for wrong in (torch.nan, torch.inf, -torch.inf, -0.25)
    ],
    *[
        (
            replaced(TD_ERROR, torch.ones(shape)),
            r"'td_error' must have one .*\[4, .* 4 transitions",
        )
        for shape in ((4, 2), (4, 3, 1))
    ],
    (
        replaced(TD_ERROR, torch.tensor([1 + 5j, 2, 3, 4])),
        r"must have one real number .* torch.complex64 of shape",
    ),
    *[
        (put("index", slot, 1), rf"index must be in \[0, 10\).*got {slot}")
        for slot in (10, 16, 1000, -2, -1)
    ],
    *[
        (replaced("index", index), "index must hold integers, got")
        for index in (torch.tensor([True, False, True, True]), torch.tensor([0.0, 1.7, 2, 3]))
    ],
]


@pytest.mark.parametrize(("change", "message"), UPDATES)
def test_wrong_batch_is_rejected_and_changes_nothing(buffer, change, message):
    batch = change(write_signals(buffer.sample()))
    with rejected(buffer, (KeyError, ValueError, IndexError, TypeError), message):
        buffer.update_tensordict_priority(batch)


def test_times_of_writing_for_half_of_the_batch_are_rejected(buffer):
    batch = write_signals(buffer.sample())
    with rejected(buffer, ValueError, r"written_at must have one .*shape \[2\] for 4 slots"):
        buffer.sampler.update_signals(
            batch["index"],
            dict(batch["signals"].items()),
            storage=buffer.storage,
            written_at=batch["written_at"][:2],
        )


NOVELTY = ["td_error", Signal("novelty", key="novelty", known_at="write")]
PARTS = [
    *(
        ({"prefetch": count, "sampler": sampler}, f"prefetch must be None with .*, got {count}")
        for count in (1, 3)
        for sampler in (MPFASampler(8), PrioritizedSampler(8, 0.6, 0.4), CERSampler())
    ),
    *(
        (
            {
                "storage": SignalTensorStorage(8),
                "sampler": SignalSampler(8, 0.6, 0.4, signals=NOVELTY),
                "priority_key": key,
            },
            "priority_key must not be the key of a reward .*, got ",
        )
        for key in (("next", "reward"), "novelty", ("novelty",))
    ),
    ({"storage": SignalTensorStorage(16)}, "max_capacity of the sampler is 8, max_size .* 16"),
    ({"sample_unit": Sequence(3)}, "sample_unit must be None .*, got Sequence: signals"),
]


@pytest.mark.parametrize(("parts", "message"), PARTS)
def test_parts_that_do_not_fit_together_are_rejected(parts, message):
    default = {"storage": SignalTensorStorage(8), "sampler": MPFASampler(8), "batch_size": 4}
    with pytest.raises((TypeError, ValueError), match=message):
        SignalReplayBuffer(**{**default, **parts})
    SignalReplayBuffer(**default, sample_unit=Transition())


@pytest.mark.parametrize("wrong", [-1, 0, "4", 2.5, True, [3]])
@pytest.mark.parametrize(
    "sample",
    [
        lambda _, size: SignalReplayBuffer(storage=SignalTensorStorage(8), batch_size=size),
        lambda buffer, size: buffer.sample(size),
        lambda buffer, size: buffer.sampler.sample(buffer.storage, size),
    ],
    ids=["constructor", "buffer", "sampler"],
)
def test_a_batch_size_that_is_no_count_is_rejected_before_anything_changes(buffer, sample, wrong):
    before = snapshot(buffer)
    with pytest.raises((TypeError, ValueError)) as error:
        sample(buffer, wrong)
    assert f"batch_size must be an integer from 1 to 2147483647, got {wrong!r}" in str(error.value)
    assert same(before, snapshot(buffer))


def test_stored_transitions_that_lack_a_reward_are_found_at_the_update():
    # A storage that was filled before it got to a buffer that fuses signals.
    storage = SignalTensorStorage(8)
    storage.set(torch.arange(4), make_transitions(4).exclude(("next", "reward")))
    buffer = make_buffer(8, storage=storage)
    batch = write_signals(buffer.sample())
    with pytest.raises(KeyError, match="signal 'reward' is missing: the stored transitions lack"):
        buffer.update_tensordict_priority(batch)


def test_update_signals_can_be_called_by_hand_with_the_same_rejections(buffer):
    sampler, storage = buffer.sampler, buffer.storage
    signals = {"td_error": torch.ones(2), "action_gradient": torch.ones(2)}
    assert sampler.update_signals(torch.tensor([0, 1]), signals, storage=storage) == 0
    assert sampler.update_signals(torch.tensor([], dtype=torch.long), {}, storage=storage) == 0
    before = snapshot(buffer)
    with pytest.raises(KeyError, match=r"signal 'action_gradient' is missing, got \['td_error'\]"):
        sampler.update_signals(torch.tensor([0]), {"td_error": torch.ones(1)}, storage=storage)
    assert same(before, snapshot(buffer))


def test_a_complex_reward_is_rejected_and_changes_nothing(buffer):
    before = snapshot(buffer)
    data = make_transitions(2)
    data["next", "reward"] = torch.tensor([[1 + 2j], [0.5]])
    empty = make_buffer(8)
    with rejected(empty, ValueError, r"one real number .* torch\.complex64"):
        empty.extend(data)
    with pytest.raises(ValueError, match=r"must be torch\.float32 as in"):
        buffer.extend(data)
    assert same(before, snapshot(buffer))
