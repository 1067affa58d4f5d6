"""Storages: a slot never keeps the signals of the transition that was there before."""

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torchrl.data import LazyTensorStorage, TensorDictMaxValueWriter

from tests.mpfa.compiled import fail_with
from tests.mpfa.transitions import (
    make_buffer,
    make_filled,
    make_transitions,
    rejected,
    same,
    seeded,
    write_signals,
)
from torchrl_mpfa import (
    MPFASampler,
    Signal,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalTensorStorage,
    native,
)
from torchrl_mpfa.storages.plan import NewRows

KINDS = ["memory", "memmap", "memmap_scratch"]


@pytest.fixture(params=KINDS)
def make_storage(request, tmp_path):
    def make(capacity, **kwargs):
        if request.param == "memory":
            return SignalTensorStorage(capacity, **kwargs)
        if request.param == "memmap_scratch":
            kwargs["scratch_dir"] = tmp_path / "scratch"
        return SignalMemmapStorage(capacity, **kwargs)

    return make


def column(storage, name):
    table = storage.signal_table
    return table.rows[: table.size, table.column[name]]


def fill_signals(storage):
    """Give every slot learned signals and a replay count, as training would."""
    table = storage.signal_table
    table.rows[:, table.column["td_error"]] = 7.0
    table.rows[:, table.count_column] = 3.0


def is_fresh(storage, slots):
    table = storage.signal_table
    rows = table.rows[slots]
    learned = [table.column["td_error"], table.column["action_gradient"]]
    return rows[:, learned].isnan().all() and (rows[:, table.count_column] == 0).all()


@pytest.mark.parametrize(
    ("cursor", "slots"),
    [
        (3, [3]),
        (slice(1, 4), [1, 2, 3]),
        (torch.tensor([5, 0]), [5, 0]),
        (range(2, 4), [2, 3]),
        (torch.tensor([True, False, True, False, False, False]), [0, 2]),
        (torch.tensor([-1]), [-1]),
    ],
    ids=["number", "slice", "tensor", "range", "mask", "negative"],
)
def test_writing_in_place_resets_the_slots_it_names(make_storage, cursor, slots):
    storage = make_storage(6)
    make_buffer(6, storage=storage).extend(make_transitions(6))
    fill_signals(storage)
    rewards = torch.arange(len(slots)) + 10.0
    new = make_transitions(len(slots), rewards=rewards)
    storage[cursor] = new[0] if isinstance(cursor, int) else new
    assert is_fresh(storage, slots)
    assert storage.signal_table.rewards[slots].tolist() == rewards.tolist()
    others = [slot for slot in range(6) if slot not in [s % 6 for s in slots]]
    assert column(storage, "td_error")[others].tolist() == [7.0] * len(others)
    torch.testing.assert_close(
        storage.signal_table.rewards.float(), storage[:]["next", "reward"].squeeze(1)
    )


def test_write_outside_of_the_storage_adds_no_rows(make_storage):
    storage = make_storage(8)
    rows = make_transitions(2)
    storage.set(torch.arange(2), rows)
    # TorchRL, which writes lazy stacks, counts the rows first.
    for data in (rows, lazy_stack([*rows.unbind(0)])):
        with pytest.raises(IndexError, match="out of"):
            storage.set(torch.tensor([7, 8]), data)
    assert len(storage) == 2


def test_a_writer_that_keeps_the_best_keeps_signals_and_data_together():
    storage = SignalTensorStorage(4)
    buffer = make_buffer(4, storage=storage)
    buffer.set_writer(TensorDictMaxValueWriter(rank_key=("next", "reward")))
    for seed in range(4):
        buffer.extend(make_transitions(6, seed=seed))
    torch.testing.assert_close(
        storage.signal_table.rewards.float(), storage[:]["next", "reward"].squeeze(1)
    )


def test_nothing_of_the_signals_shows_in_a_batch(make_storage):
    buffer = make_filled(8, storage=make_storage(8))
    buffer.update_tensordict_priority(write_signals(buffer.sample()))
    batch = buffer.sample()
    bookkeeping = {"index", "priority_weight", "written_at"}
    assert set(batch.keys()) == {"observation", "next"} | bookkeeping
    assert set(buffer.storage[:].keys()) - {"index"} == {"observation", "next"}


@pytest.mark.parametrize(
    "index",
    [
        torch.tensor([3, 0, 3]),
        torch.tensor([], dtype=torch.long),
        torch.tensor([-1, 1]),
        torch.tensor([[0, 1], [2, 3]]),
        torch.tensor([True, False] * 3),
        slice(1, 5, 2),
        range(3),
        [4, 1],
        2,
    ],
    ids=["tensor", "empty", "negative", "matrix", "mask", "slice", "range", "list", "number"],
)
def test_get_equals_plain_indexing(make_storage, index):
    # Only six of eight slots are filled: -1 is the last filled one.
    ours, plain = make_storage(8), LazyTensorStorage(8)
    data = make_transitions(6)
    data["pixels"] = torch.randint(255, (6, 2, 3), generator=seeded(), dtype=torch.uint8)
    data["long", "nested", "flag"] = torch.tensor([True, False] * 3)
    data["walkers"] = TensorDict({"place": torch.rand(6, 4, 2)}, [6, 4])
    for storage in (ours, plain):
        storage.set(torch.arange(6), data)
    found, expected = ours.get(index), plain.get(index)
    for key in ((), "long", "walkers"):
        assert found[key].batch_size == expected[key].batch_size
    assert same(found.to_dict(), expected.to_dict())
    assert found.device == expected.device
    if not isinstance(index, slice):
        found["observation"].fill_(-1)
        assert (ours[:]["observation"] >= 0).all() or isinstance(index, int)


def test_entries_that_were_replaced_or_added_since_are_read():
    storage, slots = SignalTensorStorage(4), torch.tensor([1])
    storage.set(torch.arange(4), make_transitions(4))
    assert storage.get(slots)["observation"] == 1
    storage._storage["observation"] = torch.full((4, 1), 7.0)
    assert storage.get(slots)["observation"] == 7
    storage._storage["more"] = torch.ones(4)
    assert storage.get(slots)["more"] == 1


def test_reading_a_slot_that_was_never_written_is_an_error(make_storage):
    storage = make_storage(8)
    storage.set(torch.arange(3), make_transitions(3))
    with pytest.raises(IndexError):
        storage.get(torch.tensor([1, 5]))


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_entries_that_are_no_tensors_come_back(kind):
    storage = kind(4)
    data = make_transitions(3)
    data.set_non_tensor("world", "A")
    storage.set(torch.arange(3), data)
    found = storage.get(torch.tensor([2, 0]))
    assert found.batch_size == (2,)
    assert found["world"] == ["A", "A"]
    assert found["observation"].squeeze(1).tolist() == [2.0, 0.0]


def test_a_priority_function_that_gives_a_negative_signal_is_rejected():
    bad = Signal("bad", key=("next", "reward"), known_at="write", priority=torch.neg)
    buffer = make_buffer(4, signals=["td_error", bad])
    with rejected(buffer, ValueError, r"signal 'bad' must be finite and not negative, got -1.0"):
        buffer.extend(make_transitions(1, rewards=[1.0]))


def test_buffer_of_a_storage_that_was_filled_without_slots_writes_them():
    storage = SignalTensorStorage(8)
    storage.set(torch.arange(8), make_transitions(8))
    slots = make_buffer(8, storage=storage).extend(make_transitions(2))
    assert storage.get(slots)["index"].equal(slots)


def test_rows_that_are_written_out_of_order_count_as_in_torchrl():
    ours, theirs = make_buffer(8).storage, LazyTensorStorage(8)
    rows = make_transitions(1).set("index", torch.zeros(1, dtype=torch.long))
    for storage in (ours, theirs):
        for slot in (0, 5, 5):
            before = int(storage._mutation_revision)
            storage.set(torch.tensor([slot]), rows.clone())
            assert int(storage._mutation_revision) > before  # TorchRL's caches of rows end there.
    assert len(ours) == len(theirs) == 3


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_a_first_write_that_fails_leaves_no_form(kind, tmp_path, monkeypatch):
    storage = kind(8, **({"scratch_dir": tmp_path} if kind is SignalMemmapStorage else {}))
    files = sorted(tmp_path.rglob("*"))
    wrong = TensorDict({"a": torch.zeros(3, 2), "b": torch.zeros(3, 1)}, [3])
    with monkeypatch.context() as patched:
        patched.setattr(TensorDict, "__setitem__", fail_with(RuntimeError("no room")))
        patched.setattr(NewRows, "write", fail_with(RuntimeError("no room")))
        with pytest.raises(RuntimeError, match="no room"):
            storage.set(torch.arange(3), wrong)
    assert len(storage) == 0 and not storage.initialized
    assert sorted(tmp_path.rglob("*")) == files
    storage.set(torch.arange(3), TensorDict({"a": torch.ones(3, 1)}, [3]))
    assert storage.get(torch.arange(3))["a"].tolist() == [[1.0]] * 3


@pytest.mark.skipif(native.find_loops() is None, reason="PyTorch writes no such numbers")
@pytest.mark.parametrize("dtype", [torch.uint16, torch.uint32, torch.float8_e4m3fn])
def test_numbers_that_pytorch_cannot_write_by_index_are_stored_from_the_first_write(dtype):
    storage = SignalTensorStorage(8)
    buffer = SignalReplayBuffer(storage=storage, sampler=MPFASampler(), batch_size=4)
    numbers = torch.arange(6.0).reshape(3, 2).to(dtype)
    for turn in range(2):
        rows = {"depth": numbers, "next": {"reward": torch.rand(3, 1)}}
        slots = buffer.extend(TensorDict(rows, [3]))
        stored = buffer.storage.get(slots)["depth"]
        assert stored.view(torch.uint8).equal(numbers.view(torch.uint8)), turn
