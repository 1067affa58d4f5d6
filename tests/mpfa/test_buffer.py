"""SignalReplayBuffer: from batch to sampler, beside TorchRL's other parts; its warnings."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage
from torchrl.data.replay_buffers import PrioritizedSampler
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs.transforms import Compose, DoubleToFloat, MultiStepTransform, RewardScaling

from tests.mpfa.transitions import (
    make_buffer,
    make_filled,
    make_transitions,
    rejected,
    same,
    snapshot,
    write_signals,
)
from torchrl_mpfa import (
    MPFASampler,
    Signal,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalTensorStorage,
)
from torchrl_mpfa.samplers import TreeSampler


def leaves(buffer):
    return buffer.sampler.trees.leaves(torch.arange(len(buffer)))


def test_rows_that_were_overwritten_since_they_were_sampled_are_dropped_and_counted():
    buffer = make_filled(8, 16)
    batch = write_signals(buffer.sample())
    overwritten = buffer.extend(make_transitions(3, first=8))
    fresh = leaves(buffer)[overwritten]
    buffer.update_tensordict_priority(batch)
    stale = int(torch.isin(batch["index"], overwritten).sum())
    assert 0 < stale < 16
    assert buffer.stale_updates == stale
    assert leaves(buffer)[overwritten].equal(fresh)
    table = buffer.storage.signal_table
    assert table.rows[overwritten, table.column["td_error"]].isnan().all()
    live = batch["index"][~torch.isin(batch["index"], overwritten)]
    assert not table.rows[live, table.column["td_error"]].isnan().any()


def test_writes_count_each_row_also_of_a_write_that_is_longer_than_the_buffer():
    buffer = make_buffer(8, 4)
    for count in (3, 20, 1):
        buffer.extend(make_transitions(count))
    assert buffer.sampler.table.writes == 24


def test_a_batch_whose_rows_are_all_gone_changes_nothing():
    buffer = make_filled(8)
    batch = write_signals(buffer.sample())
    buffer.extend(make_transitions(8, first=8))
    before = buffer.state_dict()
    buffer.update_tensordict_priority(batch)
    assert buffer.stale_updates == 4
    assert same(before, buffer.state_dict())


@pytest.mark.parametrize("filled", [0, 3, 8])
@pytest.mark.parametrize("times", [1, 2])
def test_a_batch_from_before_the_buffer_was_emptied_is_stale(filled, times):
    # The count of writes must not start again, or the new rows would carry the old times.
    buffer = make_filled(8)
    batch = write_signals(buffer.sample())
    batch["index"], batch["written_at"] = torch.tensor([1, 4, 6, 7]), torch.tensor([1.0, 4, 6, 7])
    for _ in range(times):
        buffer.empty()
    if filled:
        buffer.extend(make_transitions(filled))
    before = snapshot(buffer)
    buffer.update_tensordict_priority(batch)
    assert buffer.stale_updates == 4
    assert same(before, snapshot(buffer))
    if filled == 8:
        return
    with pytest.raises(IndexError, match=rf"index must be in \[0, {filled}\), got 7"):
        buffer.update_tensordict_priority(batch.exclude("written_at"))


def test_without_the_time_of_writing_every_row_is_taken():
    buffer = make_filled(8)
    batch = write_signals(buffer.sample()).exclude("written_at")
    buffer.extend(make_transitions(8, first=8))
    buffer.update_tensordict_priority(batch)
    assert buffer.stale_updates == 0


def test_a_part_of_a_batch_may_be_updated_and_signals_may_be_columns():
    buffer = make_filled(8, 6)
    batch = write_signals(buffer.sample())[:3]
    batch["signals"] = TensorDict(
        {key: value.unsqueeze(1) for key, value in batch["signals"].items()}, [3]
    )
    batch["index"] = batch["index"].unsqueeze(1)
    buffer.update_tensordict_priority(batch)
    table = buffer.storage.signal_table
    known = table.rows[:, table.column["td_error"]].isfinite().nonzero().squeeze(1)
    assert known.tolist() == batch["index"].unique().tolist()


def test_signals_are_read_under_nested_and_renamed_keys():
    slope = Signal("slope", key=("agent", "critic", "slope"))
    reward = Signal("reward", key=("next", "agent", "r"), known_at="write")
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(8),
        sampler=MPFASampler(
            8, reward_key=reward.key, signals=[slope, reward], adjustments=[], eps=0.0
        ),
        batch_size=4,
    )
    rewards = torch.tensor([1.0, -3.0])
    buffer.extend(TensorDict({"next": {"agent": {"r": rewards.unsqueeze(1)}}}, [2]))
    batch = TensorDict(
        {"index": torch.arange(2), "agent": {"critic": {"slope": torch.tensor([4.0, 5.0])}}}, [2]
    )
    buffer.update_tensordict_priority(batch)
    assert leaves(buffer).tolist() == pytest.approx([2.5**0.6, 4.0**0.6])


def test_batch_has_the_entries_of_loss_and_update():
    buffer = make_filled(8)
    batch = buffer.sample()
    assert not batch.is_locked
    for key in ("index", "priority_weight", "written_at"):
        assert batch[key].shape == (4,)
    batch, info = buffer.sample(return_info=True)
    assert info["priority_weight"].equal(batch["priority_weight"])
    assert batch["observation"].squeeze(1).equal(batch["index"].float())
    with pytest.warns(UserWarning, match="conflicting batch_sizes"):
        assert buffer.sample(3).batch_size == (3,)


def test_nothing_is_written_while_the_buffer_is_emptied(monkeypatch):
    # The writer would be at the third slot of a storage that holds none.
    buffer = make_filled(8)
    other, written, emptied = ThreadPoolExecutor(1), [], buffer.sampler._empty

    def empty():
        written.append(other.submit(buffer.extend, make_transitions(2, first=8)))
        wait(written, timeout=0.1)
        emptied()

    monkeypatch.setattr(buffer.sampler, "_empty", empty)
    buffer.empty()
    assert written[0].result().tolist() == [0, 1]
    assert len(buffer) == 2
    assert buffer[:]["observation"].flatten().tolist() == [8, 9]
    assert buffer.extend(make_transitions(1)).tolist() == [2]


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_reading_through_a_transform_does_not_change_the_storage(kind):
    buffer = make_buffer(8, storage=kind(8))
    buffer.append_transform(RewardScaling(loc=0.0, scale=10.0, in_keys=[("next", "reward")]))
    data = make_transitions(8)
    buffer.extend(data)
    for _ in range(2):
        torch.testing.assert_close(buffer[:]["next", "reward"], data["next", "reward"] * 10)
    assert buffer.storage[:]["next", "reward"].equal(data["next", "reward"])
    buffer.extend(make_transitions(1, rewards=[7.0]))
    assert buffer.storage[:]["next", "reward"][0] == 7.0
    buffer.storage[:]["observation"].fill_(3.0)
    assert (buffer.storage[:]["observation"] == 3.0).all()


@pytest.mark.parametrize(
    "make_sampler",
    [
        RandomSampler,
        lambda: PrioritizedSampler(16, 0.6, 0.4, 0.05),
        lambda: TreeSampler(16, 0.6, 0.4, 0.05),
    ],
    ids=["uniform", "stock", "tree"],
)
@pytest.mark.parametrize("make_storage", [LazyTensorStorage, SignalTensorStorage])
def test_with_any_other_sampler_it_is_torchrls_buffer(make_sampler, make_storage):
    buffer = make_buffer(16, 8, storage=make_storage(16), sampler=make_sampler())
    buffer.extend(make_transitions(10))
    buffer.add(make_transitions(1)[0])
    batch = buffer.sample()
    batch["td_error"] = torch.arange(8.0)
    buffer.update_tensordict_priority(batch)
    assert len(buffer) == 11
    assert batch["index"].max() < 11
    assert "stale_updates" in buffer.stats()
    if hasattr(buffer.sampler, "trees"):
        last = {int(slot): float(td) for td, slot in enumerate(batch["index"])}
        for slot, td_error in last.items():
            assert float(buffer.sampler.trees.leaves(torch.tensor([slot]))) == pytest.approx(
                (td_error + 0.05) ** 0.6
            )


@pytest.mark.parametrize("forget", ["empty", "load", "loads", "save", "dumps"])
def test_batches_of_a_uniform_sampler_are_sampled_ahead_and_forgotten_with_the_buffer(
    forget, tmp_path
):
    def make(first):
        parts = {"storage": SignalTensorStorage(16), "sampler": RandomSampler()}
        buffer = SignalReplayBuffer(**parts, batch_size=8, prefetch=3)
        buffer.extend(make_transitions(16, first=first))
        return buffer

    buffer, other = make(0), make(100)
    assert buffer.sample()["observation"].max() < 16
    assert buffer.stats()["prefetch_queue_size"] == 3
    if forget == "load":
        buffer.load_state_dict(other.state_dict())
    elif forget == "loads":
        other.dumps(tmp_path / "buffer")
        buffer.loads(tmp_path / "buffer")
    elif forget == "empty":
        buffer.empty()
        buffer.extend(make_transitions(16, first=100))
    else:
        # What was saved continues as what goes on.
        saved = buffer.state_dict() if forget == "save" else buffer.dumps(tmp_path / "buffer")
        twin = make(100)
        twin.load_state_dict(saved) if saved else twin.loads(tmp_path / "buffer")
        assert buffer.sample()["index"].equal(twin.sample()["index"])
        return
    assert all(buffer.sample()["observation"].min() >= 100 for _ in range(5))


def test_a_dump_does_not_wait_for_a_batch_that_waits_for_it(tmp_path):
    class Slow(RandomSampler):
        def sample(self, *args, **kwargs):
            time.sleep(0.2)
            return super().sample(*args, **kwargs)

    parts = {"storage": SignalTensorStorage(16), "sampler": Slow()}
    buffer = SignalReplayBuffer(**parts, batch_size=8, prefetch=3)
    buffer.extend(make_transitions(16))
    buffer.sample()
    saving = threading.Thread(target=buffer.dumps, args=(tmp_path / "buffer",), daemon=True)
    saving.start()
    saving.join(20)
    assert not saving.is_alive()


@pytest.mark.filterwarnings("ignore:Calling update_priority:UserWarning")
@pytest.mark.parametrize(
    ("make_sampler", "key"),
    [
        (RandomSampler, ("next", "reward")),
        (RandomSampler, "td_error"),
        (lambda: PrioritizedSampler(16, 1.0, 0.4, 0.0), "td_error"),
        (lambda: TreeSampler(16, 1.0, 0.4, 0.0), "td_error"),
    ],
)
def test_a_priority_is_stored_with_the_transition_where_no_signals_are_fused(make_sampler, key):
    buffer = make_buffer(16, sampler=make_sampler(), priority_key=key)
    data = make_transitions(6).set("td_error", torch.arange(6.0) + 1)
    for row in range(2):
        buffer.extend(data[3 * row : 3 * row + 3])
    batch = buffer.sample()
    assert batch[key].equal(data[key][batch["index"]])
    if hasattr(buffer.sampler, "trees"):
        assert leaves(buffer).tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    "write",
    [
        lambda b: b.set_("observation", torch.ones(8, 1)),
        lambda b: b.set_at_("observation", torch.ones(1, 1), torch.tensor([2])),
        lambda b: b.update_({"observation": torch.ones(8, 1)}),
        lambda b: b.update_if_present(index=0, generation=0, patch={}),
        lambda b: b.__setitem__(("next", "reward"), torch.ones(8, 1)),
        lambda b: b.__setitem__("observation", torch.ones(8, 1)),
    ],
)
def test_write_in_place_is_rejected_and_changes_nothing(write):
    buffer = make_filled(8)
    with rejected(buffer, NotImplementedError, r"cannot be changed in place, .* by extend"):
        write(buffer)


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
