"""Buffers that other processes write to: signals and priorities of all rows, or an error."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictMaxValueWriter
from torchrl.envs import GymEnv

from tests.mpfa.transitions import make_buffer, make_transitions, same, train_rounds
from torchrl_mpfa import MPFASampler, SignalMemmapStorage, SignalReplayBuffer, SignalTensorStorage
from torchrl_mpfa.samplers import TreeSampler
from torchrl_mpfa.samplers.uniform import CERSampler

STORAGES = [SignalTensorStorage, SignalMemmapStorage, LazyTensorStorage, LazyMemmapStorage]


def write(buffer, firsts):
    """Write rows in another process, where all else is rejected, and wrong rows are."""
    for first in firsts:
        buffer.extend(make_transitions(4, first=first))
    for forbidden in (
        buffer.sample,
        buffer.empty,
        lambda: buffer.load_state_dict(buffer.state_dict()),
        lambda: buffer.__setitem__(slice(0, 4), make_transitions(4)),
    ):
        with pytest.raises(RuntimeError, match="another process can only write"):
            forbidden()
    wrong = make_transitions(4)
    wrong["next", "reward"][2] = torch.nan
    with pytest.raises(ValueError, match=r"reward.* must be finite"):
        buffer.extend(wrong)
    if buffer.sampler.by_priority:
        first = make_transitions(4).set("td_error", torch.ones(4))
        with pytest.raises(ValueError, match="must not be given in another process"):
            buffer.extend(first)


def elsewhere(work, *args, method="spawn"):
    process = multiprocessing.get_context(method).Process(target=work, args=args)
    process.start()
    process.join()
    assert process.exitcode == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make_sampler", "make_storage"),
    [*((MPFASampler, storage) for storage in STORAGES), (CERSampler, SignalTensorStorage)],
)
def test_rows_of_another_process_count_as_those_of_this_one(make_sampler, make_storage):
    shared, alone = (
        make_buffer(16, 8, storage=make_storage(16), sampler=make_sampler()) for _ in range(2)
    )
    shared.share()
    for buffer in (shared, alone):
        buffer.extend(make_transitions(10))
        if make_sampler is MPFASampler:
            train_rounds(buffer, 3)
    before = shared.sample()
    alone.sample()
    saved = shared.state_dict()
    elsewhere(write, shared, (100, 104))
    for first in (100, 104):
        alone.extend(make_transitions(4, first=first))
    with pytest.raises(ValueError, match="written to since"):
        shared.load_state_dict(saved)
    assert shared.storage[:]["observation"].equal(alone.storage[:]["observation"])
    for _ in range(3):
        assert shared.sample()["index"].equal(alone.sample()["index"])
    for first in (200, 204):
        for buffer in (shared, alone):
            buffer.extend(make_transitions(4, first=first))
    if make_sampler is MPFASampler:
        assert same(shared.distributions(), alone.distributions())
        assert shared.rewards().equal(alone.rewards())
        before["signals"] = {"td_error": torch.rand(8), "action_gradient": torch.rand(8)}
        shared.update_tensordict_priority(before)
        assert shared.stale_updates == 8
        assert train_rounds(shared, 5).shape == train_rounds(alone, 5).shape


def write_past(buffer, first):
    """Write as another process does: the sampler of this one does not hear of it."""
    slots = (buffer.writer._cursor + torch.arange(4)) % 16
    buffer.storage.set(slots, make_transitions(4, first=first).set("index", slots))
    buffer.writer._cursor, buffer.writer._write_count = int(slots[-1]) + 1 & 15, first + 4


@pytest.mark.parametrize("count", [2, 8])
def test_rows_that_the_sampler_did_not_hear_of_are_read_once_and_in_their_order(count):
    shared, alone = (
        make_buffer(16, 8, storage=SignalMemmapStorage(16), max_priority_within_buffer=False)
        for _ in range(2)
    )
    shared.share()
    for buffer in (shared, alone):
        buffer.extend(make_transitions(8))
        train_rounds(buffer, 3)
    saved = shared.state_dict()
    for first in range(8, 4 * count, 4):
        write_past(shared, first)
        alone.extend(make_transitions(4, first=first))
    if count > 2:
        with pytest.raises(ValueError, match="written to since"):
            shared.load_state_dict(saved)
    for buffer in (shared, alone):
        with buffer._write_lock:  # By whom it is held the rows are read once as well.
            for _ in range(2):
                buffer.extend(make_transitions(4, first=4 * count))
    assert same(shared.distributions(), alone.distributions())
    if count == 2:
        assert shared.sampler.table.writes == alone.sampler.table.writes
    write_past(shared, 4 * count + 8)
    alone.extend(make_transitions(4, first=4 * count + 8))
    shared.share(False)
    assert same(shared.distributions(), alone.distributions())
    assert train_rounds(shared, 3).equal(train_rounds(alone, 3))


def test_newest_transition_may_be_of_another_process():
    buffer = make_buffer(16, 8, storage=SignalMemmapStorage(16), sampler=CERSampler())
    buffer.share()
    buffer.extend(make_transitions(8))
    write_past(buffer, 8)
    assert buffer.sample()["index"][0] == 11


def test_an_error_of_reading_leaves_the_lock_to_others():
    buffer = make_buffer(16, 8)
    buffer.share()
    buffer.extend(make_transitions(8))
    write_past(buffer, 8)
    with pytest.raises(RuntimeError, match="not in shared memory"):
        buffer.sample()
    with ThreadPoolExecutor(1) as other:
        assert other.submit(buffer._write_lock._lock.acquire, False).result()


def extend(buffer, first):
    buffer.extend(make_transitions(4, first=first))


@pytest.mark.slow
def test_rows_of_another_process_are_packed_in_the_files_of_this_one(tmp_path):
    storage = SignalMemmapStorage(16, scratch_dir=tmp_path)
    buffer = make_buffer(16, 8, storage=storage, sampler=MPFASampler())
    buffer.share()
    buffer.extend(make_transitions(10))
    elsewhere(extend, buffer, 100)
    assert buffer.sample().shape == (8,)
    assert buffer[:]["observation"].flatten().tolist() == [*range(10), *range(100, 104)]


@pytest.mark.slow
def test_rows_that_a_fork_kept_to_itself_are_an_error():
    buffer = make_buffer(16, 8, storage=SignalTensorStorage(16), sampler=MPFASampler())
    buffer.share()
    buffer.extend(make_transitions(10))
    elsewhere(extend, buffer, 100, method="fork")
    with pytest.raises(RuntimeError, match="not in shared memory: start it by 'spawn'"):
        buffer.sample()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, r"be shared, by buffer.share\(\)"),
        ({"storage": SignalTensorStorage(16, ndim=2), "shared": True}, "have a storage of one dim"),
        ({"writer": TensorDictMaxValueWriter(), "shared": True}, "have a RoundRobinWriter"),
        (
            {"storage": LazyMemmapStorage(16, shared_init=True), "shared": True},
            "have a storage without shared_init",
        ),
    ],
)
@pytest.mark.parametrize("sampler", [MPFASampler, lambda: TreeSampler(16, 0.6, 0.4), CERSampler])
def test_a_buffer_that_would_lose_rows_of_another_process_is_rejected(parts, message, sampler):
    parts = {"storage": SignalTensorStorage(16), "sampler": sampler(), **parts}
    buffer = SignalReplayBuffer(**parts)
    context = multiprocessing.get_context("spawn")
    with pytest.raises(
        RuntimeError, match=f"another process writes to must {message}.*make_ray_repl"
    ):
        context.Process(target=extend, args=(buffer, 0)).start()


def make_env():
    return GymEnv("Pendulum-v1")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [MultiSyncCollector, MultiAsyncCollector])
def test_collectors_of_torchrl_write_from_their_processes(kind):
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(1_000), sampler=MPFASampler(positive_above=-5.0), batch_size=16
    )
    collector = kind(
        [make_env] * 2, None, frames_per_batch=40, total_frames=200, replay_buffer=buffer
    )
    try:
        for _ in collector:
            train_rounds(buffer, 2)
    finally:
        collector.shutdown()
    count = len(buffer)
    assert count == buffer.write_count >= 200
    stored = buffer.storage[:]["next", "reward"].reshape(-1).double()
    assert buffer.rewards().equal(stored)
    assert stored.unique().numel() > count // 2
    assert buffer.distributions()["priority"].isfinite().all()
