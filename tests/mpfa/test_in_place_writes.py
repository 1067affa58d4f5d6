"""Entries that are written in place: rewards and signals follow, or the write is rejected."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictRoundRobinWriter
from torchrl.data.replay_buffers.samplers import RandomSampler

from tests.mpfa.transitions import (
    make_transitions,
    rejected,
    same,
    seeded,
    snapshot,
    write_signals,
)
from torchrl_mpfa import (
    MPFASampler,
    Signal,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalSampler,
    SignalTensorStorage,
)

CAPACITY = 8
KEY = ("next", "reward")


def make_tracked_buffer(count, *, ndim=1, kind=SignalTensorStorage, sampler=None, wide=False):
    """A buffer of ``count`` transitions, of one environment, in the middle of its training."""
    buffer = SignalReplayBuffer(
        storage=kind(CAPACITY, ndim=ndim),
        sampler=MPFASampler(CAPACITY) if sampler is None else sampler,
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=4,
        generator=seeded(),
    )
    data = make_transitions(count)
    if wide:
        data["action"] = torch.zeros(count, 2)
        data["next", "observation"] = torch.zeros(count, 1)
    buffer.extend(data if ndim == 1 else data.unsqueeze(0))
    buffer.update_tensordict_priority(write_signals(buffer.sample()))
    return buffer


def all_rewards(buffer, value=50.0):
    return torch.full_like(buffer.storage[:][KEY], value)


def present(buffer):
    index = torch.arange(3)
    if buffer.storage.ndim == 2:
        index = torch.stack((index, torch.zeros_like(index)), -1)
    buffer.update_if_present(
        index=index,
        generation=buffer.writer.generations_of(index),
        patch={KEY: torch.full((3, 1), 50.0)},
    )


def by_key(buffer):
    buffer[KEY] = torch.full_like(buffer[:][KEY], 50.0)


def by_places(buffer):
    row = buffer[:]
    row[KEY] = torch.full_like(row[KEY], 50.0)
    buffer[:, ...] = row


WAYS = {
    "set_at_": lambda b: b.set_at_(KEY, all_rewards(b)[:3], torch.arange(3)),
    "set_": lambda b: b.set_(KEY, all_rewards(b)),
    "update_": lambda b: b.update_({"next": {"reward": all_rewards(b)}}),
    "update_if_present": present,
    "by key": by_key,
    "by places": by_places,
}


@pytest.mark.parametrize(
    ("kind", "count", "ndim"),
    [
        (SignalTensorStorage, 5, 1),
        (SignalTensorStorage, CAPACITY, 1),
        (SignalTensorStorage, 5, 2),
        (SignalMemmapStorage, CAPACITY, 1),
    ],
)
def test_rewards_and_signals_are_those_that_were_written_in_place(kind, count, ndim):
    for name, write in WAYS.items():
        if name == "by places" and (count < CAPACITY or kind is SignalMemmapStorage):
            continue  # TorchRL writes to a copy.
        buffer = make_tracked_buffer(count, ndim=ndim, kind=kind)
        before, table = snapshot(buffer), buffer.storage.signal_table
        write(buffer)
        stored = buffer.storage[:][KEY].flatten().double()
        changed = 3 if name in ("set_at_", "update_if_present") else count
        assert (stored == 50.0).sum() == changed, name
        assert buffer.rewards().equal(stored), name
        assert table.rows[:count, table.column["reward"]].equal(stored.abs()), name
        others = [table.column["td_error"], table.column["action_gradient"]]
        others += [table.count_column, table.time_column]
        found = before["_storage"]["_signals"]["rows"]
        assert same(table.rows[:count, others], found[:, others]), name
        assert same(before["_sampler"], buffer.sampler.state_dict()), name


def test_a_reward_that_was_written_in_place_makes_the_next_priority():
    sampler = SignalSampler(CAPACITY, 1.0, 0.4, 0.0, signals=["reward"])
    buffer = make_tracked_buffer(CAPACITY, sampler=sampler)
    buffer.set_(KEY, -torch.arange(1.0, 9.0).unsqueeze(1))
    assert buffer.storage.signal_table.writes == 2 * CAPACITY  # The fusion weighs again by it.
    batch = buffer.sample()
    buffer.update_tensordict_priority(batch)
    assert buffer.stale_updates == 0
    slots = batch["index"]
    assert buffer.sampler.priorities(slots).tolist() == (slots + 1.0).tolist()


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_a_reward_that_is_not_finite_is_rejected_and_taken_back(wrong):
    buffer = make_tracked_buffer(CAPACITY)
    before = snapshot(buffer)
    for write in (
        lambda: buffer.set_at_(KEY, torch.full((1, 1), wrong), torch.tensor([2])),
        lambda: buffer.set_(KEY, all_rewards(buffer, wrong)),
        lambda: buffer.update_({"next": {"reward": all_rewards(buffer, wrong)}}),
        lambda: buffer.__setitem__(KEY, all_rewards(buffer, wrong)),
    ):
        with pytest.raises(ValueError, match=rf"reward.* must be finite, got {wrong}"):
            write()
        assert same(before, snapshot(buffer))


ROWS = (CAPACITY, 1)
BAD_WRITES = [
    (lambda b: b.set_("observation", torch.full(ROWS, torch.nan)), "'observation' must be finite"),
    (lambda b: b.set_("action", torch.ones(ROWS)), r"'action' must have the shape \[2\].* \[1\]"),
    (
        lambda b: b.set_("action", torch.ones(2)),
        "must be of .* transitions: batch dimension mismatch",
    ),
    (
        lambda b: b.set_("action", torch.ones(CAPACITY, 2).double()),
        "'action' must be torch.float32",
    ),
    (lambda b: b.set_("none", torch.ones(ROWS)), "'none' is not in the storage"),
    (
        lambda b: b.__setitem__("observation", torch.full(ROWS, -torch.inf)),
        "'observation' must be finite, got -inf in row 0",
    ),
    (
        lambda b: b.set_at_(
            "observation", torch.tensor([[1.0], [torch.nan]]), torch.tensor([1, 2])
        ),
        "'observation' must be finite, got nan in row 1",
    ),
    (lambda b: b.set_at_("observation", torch.tensor([torch.inf]), 3), "'observation' must be fin"),
    (lambda b: b.set_at_("action", torch.ones(2), slice(2)), r"must have the shape \[2\]"),
    (lambda b: b.set_at_("action", torch.ones(2, 2), torch.tensor([0, 99])), "index 99 is out of"),
    (
        lambda b: b.update_({"observation": torch.ones(ROWS), "action": torch.ones(3, 2)}),
        "must be of .* transitions: batch dimension mismatch",
    ),
    (
        lambda b: b.update_({"next": {"observation": torch.full(ROWS, torch.nan)}}),
        r"\('next', 'observation'\) must be finite, got nan in row 0",
    ),
    (
        lambda b: b.update_if_present(
            index=torch.arange(2),
            generation=b.writer.generations_of(torch.arange(2)),
            patch={"observation": torch.tensor([[1.0], [torch.nan]])},
        ),
        "'observation' must be finite, got nan in row 1",
    ),
]


@pytest.mark.parametrize("case", range(len(BAD_WRITES)))
def test_what_extend_would_reject_is_rejected_in_place_and_nothing_changes(case):
    write, message = BAD_WRITES[case]
    buffer = make_tracked_buffer(CAPACITY, wide=True)
    with rejected(buffer, (ValueError, KeyError, RuntimeError, IndexError), message):
        write(buffer)


def test_some_of_the_entries_are_written_and_others_left_out():
    buffer = make_tracked_buffer(CAPACITY, wide=True)
    batch = buffer[:]
    batch["observation"], batch["extra"] = torch.full(ROWS, 3.0), torch.full(ROWS, torch.nan)
    buffer.update_(batch, keys_to_update=["observation"])
    buffer.set_at_("action", torch.full((2, 2), 4.0), torch.arange(CAPACITY) < 2)
    assert buffer[:]["observation"].flatten().tolist() == [3.0] * CAPACITY
    assert buffer[:]["action"][:3, 0].tolist() == [4.0, 4.0, 0.0]


def test_an_entry_that_may_be_nan_may_be_written_so_in_place():
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(CAPACITY, allow_nonfinite=["observation"]), batch_size=4
    )
    buffer.extend(make_transitions(3))
    buffer.set_at_("observation", torch.tensor([torch.nan]), 1)
    assert buffer[:]["observation"].isnan().flatten().tolist() == [False, True, False]


def test_a_signal_of_ones_own_follows_and_must_not_become_negative():
    novelty = Signal("novelty", key="novelty", known_at="write", priority=lambda value: value - 1)
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(CAPACITY, signals=[novelty]),
        sampler=SignalSampler(CAPACITY, 1.0, 0.4, signals=[novelty]),
        batch_size=4,
    )
    buffer.extend(make_transitions(3).set("novelty", torch.tensor([1.0, 2.0, 3.0])))
    buffer.set_at_("novelty", torch.tensor([5.0]), torch.tensor([1]))
    table = buffer.storage.signal_table
    assert table.rows[:3, table.column["novelty"]].tolist() == [0.0, 4.0, 2.0]
    with pytest.raises(ValueError, match=r"signal 'novelty' must not be negative, got -1.0"):
        buffer.set_at_("novelty", torch.tensor([0.0]), torch.tensor([1]))
    assert buffer[:]["novelty"].tolist() == [1.0, 5.0, 3.0]


def test_later_transitions_go_to_an_entry_written_by_its_key():
    buffer = make_tracked_buffer(CAPACITY)
    given = all_rewards(buffer)
    buffer[KEY] = given
    index = buffer.extend(make_transitions(2, rewards=[7.0, 8.0]))
    assert buffer[index][KEY].flatten().tolist() == [7.0, 8.0]
    assert buffer.rewards()[index].tolist() == [7.0, 8.0]
    assert (given == 50.0).all()


def test_a_storage_without_signals_is_written_in_place_as_by_torchrl():
    buffer = SignalReplayBuffer(
        storage=LazyTensorStorage(CAPACITY), sampler=RandomSampler(), batch_size=4
    )
    with pytest.raises(RuntimeError, match="non-initialized storage"):
        buffer.set_("reward", torch.ones(4))
    buffer.extend(TensorDict({"reward": torch.zeros(4)}, [4]))
    buffer.set_("reward", torch.ones(4))
    assert buffer[:]["reward"].tolist() == [1.0] * 4
