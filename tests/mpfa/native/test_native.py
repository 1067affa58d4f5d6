"""Compiled loops do what PyTorch does."""

import copy
from itertools import product

import pytest
import torch
from torchrl.data import LazyTensorStorage
from torchrl.data.replay_buffers.samplers.prioritized import MinSegmentTreeFp64, SumSegmentTreeFp64

from tests.mpfa.native.paths import PATHS, take
from tests.mpfa.second_device import DEVICE
from tests.mpfa.transitions import make_buffer, make_transitions, seeded, write_signals
from torchrl_mpfa import (
    EntropyFusion,
    FixedFusion,
    Fusion,
    MPFASampler,
    PositiveBoost,
    PositiveDecay,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalTensorStorage,
)
from torchrl_mpfa.samplers.trees import MinTree, SumTree, set_leaves, slots_at

CAPACITY, BATCH = 37, 8
ONE = torch.ones(1, dtype=torch.double)
"""Of the sum: rounding can carry a mass past the last slot."""


pytestmark = pytest.mark.usefixtures("own_library")


def per_signal(name):
    return {"signals": [name], "fusion": FixedFusion({name: 1.0}), "adjustments": ()}


OPTIONS = {
    "paper": {},
    "td_error": per_signal("td_error"),
    "reward": per_signal("reward"),
    "boost": {"adjustments": [PositiveBoost(2.0, "cap")]},
    "unbounded": {"adjustments": [PositiveBoost(2.0, "none")]},
    "decay": {"adjustments": [PositiveDecay(0.5)]},
    "share": {"adjustments": [PositiveBoost(target_share=0.5), PositiveDecay()]},
    "level": {"positive_above": 0.4},
    "stratified": {"stratified": True},
    "ever": {"max_priority_within_buffer": False},
    "uniform": {"alpha": 0.0},
    "batch": {"fusion": EntropyFusion(population="batch")},
    "refresh": {"entropy_refresh": 0.0},
    "rank": {"adjustments": [PositiveBoost(), PositiveDecay(position="rank")]},
}


def stream(path, monkeypatch, options, *, updates=1, rounds=30):
    """What is sampled, written and kept of a training on one path, and its buffer."""
    take(path, monkeypatch)
    buffer = make_buffer(CAPACITY, BATCH * updates, **copy.deepcopy(options))
    generator, numbers, before = seeded(3), [], None
    for turn in range(rounds):
        data = make_transitions(1 + turn % 11, seed=turn, first=100 * turn)
        slots = buffer.extend(data)
        batch = write_signals(buffer.sample(), generator=generator)
        if turn % 5 == 4:  # Some slots are written again before the update.
            buffer.extend(make_transitions(9, seed=turn))
        buffer.update_tensordict_priority(batch, batches=updates)
        if before is not None and turn % 7 == 0:  # A batch that comes late.
            buffer.update_tensordict_priority(before, batches=updates)
        before = batch
        entries = (slots, batch["index"], batch["observation"], batch["priority_weight"])
        numbers.append(torch.cat([entry.double().flatten() for entry in entries]))
    return numbers, buffer


@pytest.mark.parametrize(
    ("name", "updates"), [*((name, 3) for name in OPTIONS), ("paper", 1), ("share", 1)]
)
def test_both_paths_sample_the_same_slots_and_keep_the_same_numbers(name, updates, monkeypatch):
    found, expected = (stream(path, monkeypatch, OPTIONS[name], updates=updates) for path in PATHS)
    for one, other in zip(found[0], expected[0], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=0.0)  # Weights are single.
    ours, theirs = (pair[1] for pair in (found, expected))
    assert ours.stale_updates == theirs.stale_updates > 0
    close = {"rtol": 1e-12, "atol": 0.0, "equal_nan": True}
    torch.testing.assert_close(ours.sampler.table.rows, theirs.sampler.table.rows, **close)
    torch.testing.assert_close(ours.sampler.priorities(), theirs.sampler.priorities(), **close)
    states = [buffer.sampler.state_dict() for buffer in (ours, theirs)]
    for leaves in ("_sum_tree", "_min_tree", "_learned"):
        torch.testing.assert_close(states[0][leaves], states[1][leaves], **close)
    assert states[0]["_highest"] == pytest.approx(states[1]["_highest"], rel=1e-12)
    assert states[0]["_highest_slot"] == states[1]["_highest_slot"]


def test_a_state_of_one_path_trains_on_the_other_as_there(monkeypatch):
    _, first = stream("compiled", monkeypatch, {})
    state = copy.deepcopy(first.state_dict())
    expected = first.sample()["index"]
    take("pytorch", monkeypatch)
    second = make_buffer(CAPACITY, BATCH)
    second.load_state_dict(state)
    assert second.sample()["index"].equal(expected)


def test_a_sampler_made_with_loops_says_that_it_needs_them(monkeypatch):
    _, buffer = stream("compiled", monkeypatch, {})
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
    kept = buffer.sampler.table.rows, buffer.sampler._sum_tree.nodes
    index = 8  # An entry of TorchRL's writers, in the storage.
    assert sum(tensor.nbytes for tensor in kept) / capacity + index < 96.01


def test_adjustments_of_ones_own_take_pytorch(monkeypatch):
    take("compiled", monkeypatch)

    class Half(PositiveBoost):
        def __call__(self, priority, batch):
            return 0.5 * priority

    buffer = make_buffer(adjustments=[Half()])
    assert not buffer.sampler.compiled
    buffer.extend(make_transitions(16))
    buffer.update_tensordict_priority(write_signals(buffer.sample()))
    assert make_buffer().sampler.compiled


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


def test_weights_of_a_fusion_that_share_one_number_count_for_each_signal(monkeypatch):
    class Equal(Fusion):
        def weights(self, names, table, index):
            return torch.tensor([0.5], dtype=torch.double).expand(len(names))

    found = []
    for path in PATHS:
        _, buffer = stream(path, monkeypatch, {"fusion": Equal()}, rounds=5)
        found.append(buffer.sampler.priorities())
    torch.testing.assert_close(*found, rtol=1e-12, atol=0.0, equal_nan=True)


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


def test_a_tree_rejects_slots_outside_of_it_and_takes_leaves_of_any_precision(monkeypatch):
    take("compiled", monkeypatch)
    tree = SumTree(3)
    for slots in ([0, 3], [-1, 0]):
        with pytest.raises(IndexError, match=r"slots must be in \[0, 3\)"):
            tree[torch.tensor(slots)] = torch.ones(2)
    assert tree.query(0, 3) == 0.0
    tree[torch.tensor([0, 2])] = torch.tensor([1.5, 2.0])
    assert [float(leaf) for leaf in tree[torch.arange(3)]] == [1.5, 0.0, 2.0]
    assert tree.query(0, 3) == 3.5


@pytest.mark.parametrize("capacity", [1, 15, 16, 17, 32, 33, 64, 100, 1000, 4096])
def test_trees_are_those_of_torchrl_to_the_last_bit(capacity, monkeypatch):
    take("compiled", monkeypatch)
    trees = SumTree(capacity), MinTree(capacity)
    theirs = SumSegmentTreeFp64(capacity), MinSegmentTreeFp64(capacity)
    generator = seeded(1)
    for count in (1, 7, 300):
        slots = torch.randint(capacity, (count,), generator=generator)
        leaf = torch.rand(count, dtype=torch.double, generator=generator)
        set_leaves(slots, leaf, *trees)
        set_leaves(slots, leaf, *theirs)
        for start, end in [(0, capacity), *product(range(0, capacity, 9), range(1, capacity, 7))]:
            if start < end:
                assert [t.query(start, end) for t in trees] == [t.query(start, end) for t in theirs]
        for size in (capacity, 1 + capacity // 2):
            shares = torch.cat([torch.rand(50, dtype=torch.double, generator=generator), ONE])
            expected = slots_at(shares.clone(), theirs[0], size)
            assert trees[0].slots_at(shares, size).equal(expected)


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_each_storage_of_this_package_is_written_by_compiled_loops(kind, monkeypatch):
    take("compiled", monkeypatch)
    buffer = make_buffer(16, storage=kind(16))
    buffer.extend(make_transitions(4))  # Makes room for the form of the transitions.
    monkeypatch.setattr(buffer, "_extend_checked", None)
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
    assert float(sampler._sum_tree.query(0, 64)) == pytest.approx(float(leaves.sum()), rel=1e-12)
    assert sampler.table.writes == 64 + 3 * 40 * 5
