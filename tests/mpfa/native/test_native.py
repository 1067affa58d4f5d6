"""Compiled loops do what PyTorch does."""

import copy
from types import SimpleNamespace

import pytest
import torch
from torchrl.data import LazyTensorStorage

from tests.mpfa.native.paths import PATHS, take
from tests.mpfa.second_device import DEVICE
from tests.mpfa.transitions import make_buffer, make_transitions, write_signals
from torchrl_mpfa import (
    MPFASampler,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalTensorStorage,
    native,
)
from torchrl_mpfa.storages import plan

CAPACITY, BATCH = 37, 8
ONE = torch.ones(1, dtype=torch.double)
"""Of the sum: rounding can carry a mass past the last slot."""


pytestmark = pytest.mark.usefixtures("own_library")


def test_a_sampler_made_with_loops_says_that_it_needs_them(monkeypatch):
    take("compiled", monkeypatch)
    buffer = make_buffer()
    buffer.extend(make_transitions(16))
    take("pytorch", monkeypatch)
    with pytest.raises(RuntimeError, match="needs them, and here are none: load its state_dict"):
        buffer.sample()


@pytest.mark.parametrize("path", PATHS)
def test_statistics_say_which_path_a_buffer_takes(path, monkeypatch):
    take(path, monkeypatch)
    assert make_buffer().stats()["compiled"] == (path == "compiled")


@pytest.mark.parametrize("capacity", [2**16, 2**16 + 1, 100_000])
def test_a_slot_takes_no_more_memory_than_the_documents_say(capacity, monkeypatch):
    take("compiled", monkeypatch)
    buffer = make_buffer(capacity)
    kept = buffer.sampler.table.rows, *vars(buffer.sampler.trees).values()
    index = 8  # An entry of TorchRL's writers, in the storage.
    assert sum(t.nbytes for t in kept if isinstance(t, torch.Tensor)) / capacity + index < 74


def test_rows_of_no_numbers_and_of_any_type_are_read_and_written(monkeypatch):
    take("compiled", monkeypatch)
    storage = SignalTensorStorage(6)
    rows = make_transitions(4)
    for name, value in {
        "empty": torch.zeros(4, 0),
        "half": torch.rand(4, 3).half(),
        "whole": torch.arange(12, dtype=torch.int16).reshape(4, 3),
        "yes": torch.tensor([True, False, True, True]),
        "image": torch.randint(0, 255, (4, 2, 5, 3), dtype=torch.uint8),
        "complex": torch.rand(4, 2, dtype=torch.cfloat),
    }.items():
        rows[name] = value
    storage.set(torch.arange(4), rows)
    slots = torch.tensor([3, 0, 0, 2])
    storage.set(torch.tensor([1, 5]), rows[:2])
    assert (storage.get(torch.tensor([1, 5])) == rows[:2]).all()
    assert (storage.get(slots) == rows[slots]).all()


def test_values_that_do_not_lie_one_after_the_other_are_written_as_they_are(monkeypatch):
    take("compiled", monkeypatch)
    buffer = make_buffer(16)
    buffer.extend(make_transitions(4))
    rows = make_transitions(4, seed=1)
    rows["observation"] = torch.arange(8.0).reshape(4, 2)[:, :1]
    rows["next", "reward"] = torch.arange(4.0).flip(0).unsqueeze(1).requires_grad_()
    slots = buffer.extend(rows)
    assert buffer[:]["observation"][slots].flatten().tolist() == [0.0, 2.0, 4.0, 6.0]
    assert buffer.sampler.table.rewards[slots].tolist() == [3.0, 2.0, 1.0, 0.0]
    assert rows.get("index", None) is None


@pytest.mark.parametrize("number", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("dtype", [torch.half, torch.float, torch.double])
def test_a_number_that_is_not_finite_is_rejected_and_nothing_written(number, dtype, monkeypatch):
    take("compiled", monkeypatch)
    buffer = make_buffer(16)
    rows = make_transitions(4).set("further", torch.zeros(4, 3, dtype=dtype))
    buffer.extend(rows)
    before = copy.deepcopy(buffer.state_dict())
    wrong = rows.clone()
    wrong["further"][2, 1] = number
    with pytest.raises(ValueError, match="'further' must be finite"):
        buffer.extend(wrong)
    assert buffer.writer._cursor == len(buffer) == 4
    assert torch.equal(before["_sampler"]["_sum_tree"], buffer.sampler.state_dict()["_sum_tree"])


def test_a_storage_larger_than_its_sampler_samples_no_slot_outside_of_it(monkeypatch):
    take("compiled", monkeypatch)
    storage, sampler = LazyTensorStorage(50), MPFASampler(10)
    storage.set(range(50), make_transitions(50))
    sampler.mark_update(torch.arange(10), storage=storage)
    slots, _ = sampler.sample(storage, 1000)
    assert slots.max() < 10


def test_signals_on_another_device_are_learned_from(monkeypatch, second_device):
    take("compiled", monkeypatch)
    buffer = make_buffer(16)
    buffer.extend(make_transitions(16))
    batch = write_signals(buffer.sample())
    expected = copy.deepcopy(buffer)
    expected.update_tensordict_priority(batch)
    buffer.update_tensordict_priority(batch.to(DEVICE))
    priorities = [part.sampler.priorities() for part in (buffer, expected)]
    torch.testing.assert_close(*priorities, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_each_storage_of_this_package_is_written_by_compiled_loops(kind, monkeypatch):
    take("compiled", monkeypatch)
    buffer = make_buffer(16, storage=kind(16))
    buffer.extend(make_transitions(4))  # Makes room for the form of the transitions.
    monkeypatch.setattr(buffer.writer, "extend", None)
    rows = make_transitions(3, seed=1)
    slots = buffer.extend(rows)
    assert slots.tolist() == [4, 5, 6]
    assert buffer[slots]["observation"].equal(rows["observation"])


def test_several_threads_write_and_sample_one_buffer(monkeypatch):
    from threading import Thread

    take("compiled", monkeypatch)
    buffer: SignalReplayBuffer = make_buffer(64, 16)
    buffer.extend(make_transitions(64))

    def work(seed):
        for turn in range(40):
            buffer.extend(make_transitions(5, seed=seed + turn))
            buffer.update_tensordict_priority(write_signals(buffer.sample(), seed=turn))

    threads = [Thread(target=work, args=(100 * n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sampler = buffer.sampler
    leaves = sampler.state_dict()["_sum_tree"]
    assert sampler.trees.sum(64) == pytest.approx(float(leaves.sum()), rel=1e-12)
    assert sampler.table.writes == 64 + 3 * 40 * 5


def test_pages_of_mapped_rows_are_asked_for_while_they_are_waited_for(monkeypatch):
    take("compiled", monkeypatch)
    storage, rows = SignalMemmapStorage(64), make_transitions(64)
    storage.set(torch.arange(64), rows)
    slots, asked = torch.tensor([3, 0, 0, 63]), []
    assert (storage.get(slots) == rows[slots]).all()
    reading = storage.plan(slots)
    assert not reading._is_cold  # They are in memory, as they have just been written.
    loops = native.loops()
    ask = lambda *batch: asked.append(loops.ask(*batch))  # noqa: E731
    monkeypatch.setattr(plan, "loops", lambda: SimpleNamespace(**{**vars(loops), "ask": ask}))
    monkeypatch.setattr(plan, "_FEW", -1)
    for _ in range(2 * plan._LOOK):
        assert (storage.get(slots) == rows[slots]).all()
    # But for the first of them, and for one in so many.
    assert len(asked) == 2 * plan._LOOK - 3
