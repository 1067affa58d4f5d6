"""Batches that are sampled ahead: as by hand, never from a state that is gone, and safe."""

import pickle
import time
from collections import deque
from concurrent.futures import Future
from threading import Event, Thread

import pytest
import torch
from torchrl.data import RandomSampler
from torchrl.data.replay_buffers import PrioritizedSampler

from tests.mpfa.transitions import make_transitions, same, seeded, train_rounds, write_signals
from torchrl_mpfa import (
    FixedFusion,
    MPFASampler,
    SignalReplayBuffer,
    SignalSampler,
    SignalTensorStorage,
    run_updates,
)
from torchrl_mpfa.methods.la3p import LA3PSampler, la3p_batches
from torchrl_mpfa.samplers import TreeSampler
from torchrl_mpfa.selection import SampledBatch

SIGNALS = ["reward", "td_error", "action_gradient"]
SAMPLERS = {
    "mpfa": MPFASampler,
    "tree": lambda capacity: TreeSampler(capacity, 0.6, 0.4),
    "torchrl": lambda capacity: PrioritizedSampler(capacity, 0.6, 0.4),
    "uniform": lambda capacity: RandomSampler(),
}


def late(sample):
    """A buffer's ``_sample`` that waits before it locks, so that everything else could go first."""

    def wait_and_sample(batch_size):
        time.sleep(0.003)
        return sample(batch_size)

    return wait_and_sample


def make_buffer(prefetch=None, *, kind="mpfa", capacity=16, sampler=None, **options):
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(capacity, signals=SIGNALS),
        sampler=SAMPLERS[kind](capacity) if sampler is None else sampler,
        batch_size=4,
        generator=seeded(),
        prefetch=prefetch,
        **options,
    )
    index = buffer.extend(make_transitions(capacity))
    if kind != "uniform":
        buffer.update_priority(index, torch.rand(capacity, generator=seeded(1)))
    return buffer


class ByHand:
    """Samples ahead without a thread."""

    def __init__(self, buffer, count):
        self.buffer, self.count, self.queue = buffer, count, deque()

    def sample(self):
        batch = self.queue.popleft() if self.queue else self.buffer.sample()
        while len(self.queue) < self.count:
            self.queue.append(self.buffer.sample())
        return batch


def learned(batch, generator):
    batch = write_signals(batch, generator=generator)
    batch["td_error"] = batch["signals", "td_error"]
    return batch


def state_of(buffer):
    state = buffer.state_dict()
    del state["_prefetch_state"]  # How many batches may be in the queue, which is empty.
    return state


def update(buffer, batch, round):
    buffer.update_tensordict_priority(batch)


def set_priorities(buffer, batch, round):
    buffer.update_priority(batch["index"], batch["td_error"] * 10)


def extend(buffer, batch, round):
    buffer.extend(make_transitions(5, seed=round, first=100 * round))


def add(buffer, batch, round):
    buffer.add(make_transitions(1, seed=round, first=100 * round)[0])


def write_in_place(buffer, batch, round):
    buffer.set_("observation", torch.full((16, 1), float(round)))


def write_at_places(buffer, batch, round):
    buffer[round % 16] = make_transitions(1, seed=round, first=100 * round)[0]


def write_at_wrapped_places(buffer, batch, round):
    buffer[(slice(round % 8),)] = make_transitions(round % 8, seed=round, first=100 * round)


def anneal(buffer, batch, round):
    buffer.anneal(beta=0.4 + 0.05 * round, fraction=0.1 * round)


def look(buffer, batch, round):
    buffer.found = [*getattr(buffer, "found", []), buffer.stats()]


EVENTS = [
    update,
    set_priorities,
    extend,
    add,
    write_in_place,
    write_at_places,
    write_at_wrapped_places,
    anneal,
    look,
]
HAVE_NOT = {"uniform": [set_priorities]}
"""What a sampler does not have."""


def run(source, buffer, events, *, rounds=8):
    """A training loop; gives its batches."""
    generator, batches = seeded(5), []
    for round in range(1, rounds):
        batch = source.sample()
        batches.append(batch.clone())
        batch = learned(batch, generator)
        for event in events:
            event(buffer, batch, round)
    return batches


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("kind", SAMPLERS)
@pytest.mark.parametrize("event", [*EVENTS, None], ids=lambda e: e.__name__ if e else "all")
def test_the_batches_are_those_that_were_sampled_ahead_by_hand(monkeypatch, event, kind, count):
    events = [e for e in ([event] if event else EVENTS) if e not in HAVE_NOT.get(kind, [])]
    ours, plain = make_buffer(count, kind=kind), make_buffer(kind=kind)
    monkeypatch.setattr(ours, "_sample", late(ours._sample))
    found = run(ours, ours, events)
    expected = run(ByHand(plain, count), plain, events)
    for one, other in zip(found, expected, strict=True):
        assert same(one.to_dict(), other.to_dict())
    # The state of TorchRL's own sampler has its trees, which cannot be compared.
    assert kind == "torchrl" or same(state_of(ours), state_of(plain))
    for one, other in zip(getattr(ours, "found", []), getattr(plain, "found", []), strict=True):
        assert one.pop("prefetch_queue_size") == count
        assert other.pop("prefetch_queue_size") == 0
        assert same(one, other)


def test_rows_that_were_overwritten_meanwhile_are_learned_from_and_keep_their_priorities():
    buffer = make_buffer(1)
    buffer.sample()
    buffer.extend(make_transitions(16, first=16))
    before = buffer.sampler.priorities()
    batch = buffer.sample()
    assert (batch["observation"] < 16).all()
    buffer.update_tensordict_priority(write_signals(batch))
    assert same(before, buffer.sampler.priorities())
    assert buffer.stats()["stale_updates"] == 4
    assert (buffer.sample()["observation"] >= 16).all()


def load(buffer, other, folder):
    buffer.load_state_dict(other.state_dict())


def load_of_torchrl(buffer, other, folder):
    """A state with a batch in its queue, as TorchRL's has."""
    queue = (other.sample(return_info=True),)
    state = {"version": 1, "capacity": 1, "queue": queue}
    buffer.load_state_dict({**other.state_dict(), "_prefetch_state": state})


def load_from_a_folder(buffer, other, folder):
    other.dumps(folder)
    buffer.loads(folder)


@pytest.mark.parametrize("event", [load, load_of_torchrl, load_from_a_folder])
def test_no_batch_of_before_a_state_was_loaded_is_handed_out(event, tmp_path):
    buffer, other = make_buffer(2), make_buffer()
    other.extend(make_transitions(7, first=30))
    buffer.sample()
    event(buffer, other, tmp_path / "dump")
    assert len(buffer._prefetch_queue) == 0
    assert same(buffer.sample().to_dict(), other.sample().to_dict())


def test_no_batch_is_handed_out_once_the_buffer_is_empty():
    buffer = make_buffer(2)
    buffer.sample()
    buffer.empty()
    with pytest.raises(RuntimeError, match="cannot sample from an empty buffer"):
        buffer.sample()
    buffer.extend(make_transitions(4, first=50))
    for _ in range(4):
        assert (buffer.sample()["observation"] >= 50).all()


def test_a_state_that_is_rejected_leaves_the_queue():
    buffer, plain = make_buffer(1), ByHand(make_buffer(), 1)
    for source in (buffer, plain):
        source.sample()
    with pytest.raises(KeyError):
        buffer.load_state_dict({})
    for _ in range(3):
        assert same(buffer.sample().to_dict(), plain.sample().to_dict())


@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
def test_a_batch_has_the_size_that_it_is_asked_for():
    buffer = make_buffer(2)
    for size in (None, 7, 7, None, 3, 4, None):
        assert len(buffer.sample(size)) == (size or 4)
    assert len(buffer.sample(5, return_info=True)[0]) == 5


def test_a_transform_acts_on_the_very_next_batch():
    buffer = make_buffer(2)
    buffer.sample()
    buffer.append_transform(lambda batch: batch.set("seen", batch["observation"] + 1))
    assert "seen" in buffer.sample()


@pytest.mark.parametrize("how", ["state", "folder", "pickle"])
def test_who_goes_on_and_who_resumes_sample_the_same(how, tmp_path):
    buffer, other = make_buffer(2), make_buffer(2)
    train_rounds(buffer, 3)
    if how == "pickle":
        other = pickle.loads(pickle.dumps(buffer))
    else:
        (load if how == "state" else load_from_a_folder)(other, buffer, tmp_path / "dump")
    assert train_rounds(buffer, 5).equal(train_rounds(other, 5))
    assert same(state_of(buffer), state_of(other))


@pytest.mark.parametrize(("before", "after"), [(None, 2), (2, None), (2, 3)])
def test_a_state_fits_whether_or_not_batches_are_sampled_ahead(before, after):
    buffer, other = make_buffer(before), make_buffer(after)
    train_rounds(buffer, 3)
    load(other, buffer, None)
    assert same(state_of(buffer), state_of(other))


def test_an_error_in_the_thread_is_raised_where_the_batch_is_taken():
    buffer, fail = make_buffer(1), Event()

    def transform(batch):
        if fail.is_set():
            raise ZeroDivisionError("of the transform")
        return batch

    buffer.append_transform(transform)
    fail.set()
    with pytest.raises(ZeroDivisionError):
        buffer.sample()
    fail.clear()
    batch = buffer.sample()
    buffer._wait_for_queue()
    fail.set()
    buffer.sample()
    buffer.update_tensordict_priority(write_signals(batch))
    buffer.extend(make_transitions(2))
    with pytest.raises(ZeroDivisionError):
        buffer.sample()
    fail.clear()
    assert len(buffer.sample()) == 4
    buffer._wait_for_queue()
    fail.set()
    buffer.sample()
    buffer._wait_for_queue()
    fail.clear()
    buffer.load_state_dict(buffer.state_dict())
    assert len(buffer.sample()) == 4


def test_only_batches_that_were_handed_out_count_as_never_updated(recwarn):
    buffer = make_buffer(50)
    for _ in range(100):
        buffer.sample()
    assert not recwarn.list
    with pytest.warns(UserWarning, match="100 batches in a row"):
        buffer.sample()


class Learner:
    """Writes random signals."""

    def __init__(self):
        self.generator, self.batches = seeded(2), []

    def update(self, sampled):
        self.batches.append(sampled.batch.clone())
        learned(sampled.batch, self.generator)
        return {}


def test_updates_of_one_iteration_take_the_batches_of_the_queue_one_by_one():
    ours, plain, first, second = make_buffer(1), make_buffer(), Learner(), Learner()
    run_updates(ours, first, updates=4)
    by_hand = ByHand(plain, 1)
    for _ in range(4):
        run_updates(plain, second, lambda _: iter([SampledBatch(by_hand.sample())]))
    assert len(first.batches) == 4
    for one, other in zip(first.batches, second.batches, strict=True):
        assert same(one.to_dict(), other.to_dict())
    assert same(state_of(ours), state_of(plain))


def test_la3p_rejects_batches_that_are_sampled_ahead():
    sampler = LA3PSampler(16, 0.4, 0.0, signals=["td_error"])
    with pytest.raises(ValueError, match="prefetch must be None with LA3P"):
        next(la3p_batches(make_buffer(1, sampler=sampler)))


def settle(future, call, *args):
    try:
        future.set_result(call(*args))
    except BaseException as error:
        future.set_exception(error)


def test_writers_and_learners_at_once_leave_whole_trees_and_lose_nothing(monkeypatch):
    capacity, rounds, alpha, eps = 64, 40, 0.7, 0.01
    fusion = FixedFusion(values=dict(zip(SIGNALS, (0.5, 1.0, 2.0), strict=True)))
    sampler = SignalSampler(capacity, alpha, 0.4, eps, signals=SIGNALS, fusion=fusion)
    buffer = make_buffer(3, capacity=capacity, sampler=sampler)
    stale, torn = [], []
    update_signals = sampler.update_signals
    monkeypatch.setattr(
        sampler,
        "update_signals",
        lambda *a, **k: stale.append(update_signals(*a, **k)) or stale[-1],
    )

    def write(number):
        for round in range(rounds):
            rewards = torch.randn(5, generator=seeded(round + rounds * number))
            buffer.extend(make_transitions(5, rewards=rewards).set("observation", rewards[:, None]))
            last = make_transitions(1, rewards=rewards[:1]).set("observation", rewards[:1, None])
            buffer.add(last[0])

    def learn(number):
        for round in range(rounds):
            batch = buffer.sample(4 if round % 7 else 6)
            torn.append(not batch["observation"].equal(batch["next", "reward"]))
            buffer.update_tensordict_priority(write_signals(batch, seed=round + rounds * number))
            buffer.anneal(beta=0.5, fraction=0.5)
            buffer.stats()
            if round % 20 == 19:
                buffer.state_dict()

    buffer.set_("observation", buffer[:]["next", "reward"])
    monkeypatch.setattr(buffer, "_warned_batch_size_conflict", True)
    # Daemons, so that those that wait for each other end with the test.
    done = {
        (each, number): Future()
        for each, count in ((write, 2), (learn, 3))
        for number in range(count)
    }
    for (each, number), future in done.items():
        Thread(target=settle, args=(future, each, number), daemon=True).start()
    for future in done.values():
        future.result(timeout=120)
    assert not any(torn)
    assert len(stale) == 3 * rounds
    assert buffer.stale_updates == sum(stale) > 0
    table = buffer.storage.signal_table
    assert buffer.write_count == capacity + 2 * rounds * 6
    assert table.writes == buffer.write_count
    rows = table.rows[:, : table.reward_column]
    known = ~rows.isnan().any(1)
    assert known.any()
    torch.testing.assert_close(table.rewards.float(), buffer[:]["next", "reward"].flatten())
    weights = torch.tensor([fusion.values[name] for name in table.names], dtype=torch.double)
    fused = rows[known] @ weights + eps
    torch.testing.assert_close(sampler.priorities()[known], fused)
    leaf = sampler.priorities().pow(alpha)
    assert sampler._sum_tree.query(0, capacity) == pytest.approx(float(leaf.sum()))
    assert sampler._min_tree.query(0, capacity) == pytest.approx(float(leaf.min()))
