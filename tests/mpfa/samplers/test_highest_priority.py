"""Fresh transitions get the highest priority that an update gave, and one outlier dies out."""

import pytest
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.mpfa.transitions import make_buffer, make_transitions, seeded, write_signals
from torchrl_mpfa import FixedFusion, SignalTensorStorage
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.samplers import TreeSampler


def make_plain(capacity, **kwargs):
    """Priorities are the TD error."""
    settings = {"adjustments": [], "fusion": FixedFusion({"td_error": 1.0}), "eps": 0.0, **kwargs}
    return make_buffer(capacity, 4, **settings)


def update(buffer, index, values):
    batch = buffer[torch.as_tensor(index)]
    batch["index"] = torch.as_tensor(index)
    write_signals(batch)["signals", "td_error"] = torch.as_tensor(values)
    buffer.update_tensordict_priority(batch)


def test_fresh_rows_do_not_hand_on_their_priority():
    buffer = make_plain(8)
    buffer.extend(make_transitions(4))
    update(buffer, [0, 1], [20.0, 0.4])
    update(buffer, [1], [0.3])  # A lower one leaves it as it is.
    buffer.extend(make_transitions(3))
    assert buffer.sampler.priorities()[4:7].tolist() == [20.0] * 3
    update(buffer, [0], [0.5])  # Its slot was sampled again.
    assert buffer.sampler.default_priority == 0.5
    buffer.extend(make_transitions(1))
    assert buffer.sampler.priorities()[7] == 0.5


def test_an_outlier_that_is_overwritten_is_forgotten():
    buffer = make_plain(4)
    buffer.extend(make_transitions(4))
    update(buffer, [0, 1], [20.0, 3.0])
    buffer.extend(make_transitions(1))  # Takes the slot of the outlier, and its priority.
    assert buffer.sampler.priorities()[0] == 20.0
    assert buffer.sampler.default_priority == 3.0


@pytest.mark.parametrize("fate", ["sampled again", "overwritten"])
def test_one_outlier_dies_out_at_a_capacity_of_a_hundred_thousand(fate):
    buffer = make_plain(100_000)
    buffer.extend(make_transitions(100_000))
    update(buffer, list(range(256)), torch.rand(256, generator=seeded(1)))
    update(buffer, [7], [20.0])
    buffer.extend(make_transitions(5))  # Slots 0 to 4.
    assert (buffer.sampler.priorities()[:5] == 20.0).all()
    if fate == "sampled again":
        update(buffer, [7], [0.5])
    else:
        buffer.extend(make_transitions(3))
    assert buffer.sampler.default_priority < 1.0
    buffer.extend(make_transitions(100))
    # What was given 20 is itself sampled before long; nothing new gets it any more.
    assert (buffer.sampler.priorities()[8:105] < 1.0).all()


def test_the_highest_ever_is_an_option_and_stays():
    buffer = make_plain(4, max_priority_within_buffer=False)
    buffer.extend(make_transitions(4))
    update(buffer, [0], [20.0])
    update(buffer, [0], [0.5])
    buffer.extend(make_transitions(4))
    assert buffer.sampler.priorities().tolist() == [20.0] * 4


@pytest.mark.parametrize("name", ["per", "lap", "la3p", "mpfa_per"])
def test_methods_differ_in_it_as_their_authors_code_does(name):
    sampler = make_replay(name, capacity=8).buffer.sampler
    assert sampler._max_priority_within_buffer == (name not in {"lap", "la3p"})


@pytest.mark.parametrize("within", [True, False])
def test_highest_priority_is_saved_with_learned_slots(within):
    first, second = (make_plain(8, max_priority_within_buffer=within) for _ in range(2))
    first.extend(make_transitions(4))
    update(first, [0, 1], [9.0, 3.0])
    first.extend(make_transitions(2))
    second.load_state_dict(first.state_dict())
    for buffer in (first, second):
        update(buffer, [0], [0.1])
        assert buffer.sampler.default_priority == (3.0 if within else 9.0)
        assert buffer.sampler.priorities()[4:6].tolist() == [9.0, 9.0]


def test_priority_from_torchrls_buffer_does_not_count_as_learned():
    """It reads the default priority, and writes it for batches without one."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(8),
        sampler=TreeSampler(8, 0.6, 0.4, 0.0, max_priority_within_buffer=True),
        batch_size=2,
    )
    buffer.extend(torch.arange(4))
    buffer.update_priority(torch.tensor([0]), torch.tensor([0.37]))
    buffer.extend(torch.arange(2))
    buffer.update_priority(torch.tensor([4, 5]), torch.tensor([0.37, 0.37]))
    buffer.update_priority(torch.tensor([0]), torch.tensor([0.2]))
    assert buffer.sampler.default_priority == pytest.approx(0.2)


def test_a_storage_that_was_filled_before_has_learned_nothing():
    storage = SignalTensorStorage(8)
    storage.set(torch.arange(4), make_transitions(4))
    buffer = make_buffer(8, 2, storage=storage, sampler=make_plain(8).sampler)
    update(buffer, [0], [0.25])
    assert buffer.sampler.default_priority == 0.25
