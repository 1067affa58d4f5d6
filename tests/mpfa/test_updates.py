"""Several updates in one iteration: equal to as many loops of sample, update and write."""

import copy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, RandomSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler

from tests.mpfa import transitions
from tests.mpfa.second_device import DEVICE
from tests.mpfa.transitions import make_rows, same, seeded
from torchrl_mpfa import (
    ActorCritic,
    PositiveBoost,
    PositiveDecay,
    SignalTensorStorage,
    make_actor,
    make_critic,
    run_updates,
)
from torchrl_mpfa.methods import METHODS, loss_options, make_replay
from torchrl_mpfa.selection import SampledBatch, one_batch

MANY, BATCH, UPDATES = 4000, 16, 4


def make_learner(**options):
    torch.manual_seed(0)
    actor = make_actor(5, 2, width=8)
    critic = make_critic(5, 2, width=8)
    return ActorCritic(actor, critic, actor_lr=1e-2, critic_lr=1e-2, **options)


def make_buffer(count=MANY, *, device="cpu", **options):
    storage = SignalTensorStorage(count, device=device)
    buffer = transitions.make_buffer(count, BATCH, storage=storage, seed=3, **options)
    buffer.extend(make_rows(count))
    return buffer


def run_loop(buffer, learner, updates):
    """The plain loop, but for priorities that wait for the end; gives its batches."""
    batches = [buffer.sample() for _ in range(updates)]
    for batch in batches:
        log = learner.update(batch)
    for batch in batches:
        buffer.update_tensordict_priority(batch)
    return log, batches


def has_twins(batches):
    index = torch.cat([batch["index"] for batch in batches])
    return len(index.unique()) < len(index)


class Counting:
    """A learner that learns nothing: its signals are the number of the update."""

    policy = None

    def __init__(self):
        self.updates, self.batches = 0, []

    def update(self, draw):
        self.updates += 1
        batch = draw.batch
        value = torch.full((len(batch),), float(self.updates))
        batch["signals"] = TensorDict({"td_error": value, "action_gradient": value}, [len(batch)])
        batch["td_error"] = value
        self.batches.append(batch)
        return {"loss_value": torch.tensor(float(self.updates))}


@pytest.mark.parametrize("position", ["batch", "rank", "count"])
def test_updates_in_one_call_are_those_of_a_loop_whose_priorities_wait(position):
    adjustments = PositiveBoost(), PositiveDecay(position=position)
    ours, theirs = (make_buffer(adjustments=adjustments) for _ in range(2))
    first, second = make_learner(), make_learner()
    for _ in range(3):
        log, batch = run_updates(ours, first, updates=UPDATES)
        expected, batches = run_loop(theirs, second, UPDATES)
        assert same(log, expected)
        assert same(batch.to_dict(), batches[-1].to_dict())
    assert same(first.state_dict(), second.state_dict())
    assert same(ours.state_dict(), theirs.state_dict())
    assert first.updates == 3 * UPDATES


class OneBatch(PositiveBoost):
    """A boost whose own method takes a batch, ``[B]``."""

    def __call__(self, priority, batch):
        assert priority.shape == batch.reward.shape == batch.written_at.shape == (BATCH,)
        return super().__call__(priority, batch)


def test_an_own_adjustment_of_one_batch_gets_them_one_by_one_and_the_same_numbers():
    found = []
    for boost in (PositiveBoost, OneBatch):
        buffer = make_buffer(adjustments=(boost(), PositiveDecay(position="rank")))
        run_updates(buffer, make_learner(), updates=UPDATES)
        found.append(buffer.sampler.priorities())
    assert same(*found)


def test_of_a_transition_that_was_sampled_twice_the_last_update_counts():
    few = 12
    buffer = transitions.make_buffer(few, 8)
    buffer.extend(make_rows(few))
    learner = Counting()
    run_updates(buffer, learner, updates=UPDATES)
    last = {}
    for number, batch in enumerate(learner.batches, start=1):
        for slot in batch["index"].tolist():
            last[slot] = float(number)
    assert has_twins(learner.batches)
    assert len(set(last.values())) > 2
    table = buffer.storage.signal_table
    found = table.rows[:, table.column["td_error"]]
    assert {slot: found[slot].item() for slot in last} == last


def test_rows_that_were_overwritten_meanwhile_are_left_out_of_their_own_batch():
    ours, theirs = make_buffer(), make_buffer()
    lost = {}

    def overwrite(buffer, learner):
        count = 0

        def update(draw):
            nonlocal count
            count += 1
            if count == UPDATES:
                lost[id(buffer)] = buffer.extend(make_rows(MANY // 2, seed=9))
            return type(learner).update(learner, draw)

        return update

    first, second = make_learner(), make_learner()
    first.update = overwrite(ours, first)
    second.update = overwrite(theirs, second)
    run_updates(ours, first, updates=UPDATES)
    run_loop(theirs, second, UPDATES)
    assert 0 < ours.stale_updates == theirs.stale_updates < UPDATES * BATCH
    assert same(ours.sampler.priorities(), theirs.sampler.priorities())


@pytest.mark.parametrize("name", METHODS)
def test_every_method_makes_as_many_updates_and_gives_log_and_batch(name):
    learner = make_learner(**loss_options(name))
    replay = make_replay(
        name, capacity=200, batch_size=BATCH, generator=seeded(0), policy=learner.policy, sigma=0.2
    )
    replay.buffer.extend(make_rows(200))
    log, batch = run_updates(replay.buffer, learner, replay.select, updates=3)
    assert learner.updates == 3
    assert {"loss_value", "loss_actor", "td_error"} <= log.keys()
    for signal in replay.signals:
        assert batch["signals", signal].shape == batch.batch_size
    if name in {"mpfa_per", "per", "lap", "rank_per"}:
        weight = batch["priority_weight"]
        assert weight.shape == (BATCH,) and bool((weight > 0).all())
        assert replay.buffer.sampler.weights


def newest_in(batch):
    return batch["index"][0].item() == 199


@pytest.mark.usefixtures("reconstructed")
@pytest.mark.parametrize(
    ("name", "settings", "calls"),
    [
        ("mpfa_per", {}, 1),
        ("ddpg", {}, 1),
        ("rank_per", {}, 1),
        ("mpfa_per", {"stratified": True}, 3),
        ("mw", {}, 3),
        ("cer", {}, 3),
        ("geometric", {}, 1),
        ("uniform_halves", {}, 3),
        ("la3p", {}, 9),
        ("klper", {}, 3),
    ],
)
def test_batches_that_are_more_than_their_rows_are_sampled_one_by_one(name, settings, calls):
    learner = make_learner(**loss_options(name))
    replay = make_replay(
        name,
        capacity=200,
        batch_size=BATCH,
        generator=seeded(0),
        policy=learner.policy,
        sigma=0.2,
        **settings,
    )
    replay.buffer.extend(make_rows(200))
    sampled = []
    sample = replay.buffer.sample

    def spy(*args):
        sampled.append(sample(*args))
        return sampled[-1]

    replay.buffer.sample = spy
    run_updates(replay.buffer, learner, replay.select, updates=3)
    assert len(sampled) == calls
    if name == "cer":
        assert all(map(newest_in, sampled))


def test_an_own_selection_sees_the_priorities_of_the_update_before():
    buffer, seen = make_buffer(), []

    def select(buffer):
        seen.append(buffer.sampler.priorities())
        yield from one_batch(buffer)

    learner = Counting()
    run_updates(buffer, learner, select, updates=3)
    assert len(seen) == 3
    for before, after, batch in zip(seen, seen[1:], learner.batches, strict=False):
        changed = (before != after).nonzero().squeeze(1)
        assert set(changed.tolist()) <= set(batch["index"].tolist())
        assert len(changed) > 0


@pytest.mark.parametrize("updates", [1, 3])
def test_batches_are_prepared_before_the_learner_gets_them(updates):
    learner = Counting()

    def prepare(draw):
        batch = draw.batch.copy()
        batch["next", "reward"] = batch["next", "reward"] + 100.0
        return replace(draw, batch=batch)

    buffer = make_buffer()
    before = buffer.storage["next", "reward"].clone()
    _, batch = run_updates(buffer, learner, updates=updates, prepare=prepare)
    assert all(bool((each["next", "reward"] > 50).all()) for each in learner.batches)
    assert bool((batch["next", "reward"] > 50).all())
    assert same(buffer.storage["next", "reward"], before)
    found = buffer.storage.signal_table
    written = found.rows[batch["index"], found.column["td_error"]]
    assert bool((written == updates).all())


def test_prepare_gets_the_batches_of_a_round_together_with_their_number():
    learner, seen = Counting(), []

    def prepare(sampled):
        seen.append(sampled)
        return sampled

    run_updates(make_buffer(), learner, updates=UPDATES, prepare=prepare)
    (sampled,) = seen
    assert (sampled.batches, len(sampled.batch)) == (UPDATES, UPDATES * BATCH)
    parts = [part.batch["index"] for part in sampled.parts()]
    assert all(part.equal(each["index"]) for part, each in zip(parts, learner.batches, strict=True))


@pytest.mark.parametrize("sampler", [RandomSampler(), PrioritizedSampler(300, 0.6, 0.4)])
def test_buffers_of_torchrl_are_updated_too(sampler):
    def make():
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(300),
            sampler=copy.deepcopy(sampler),
            batch_size=BATCH,
            generator=seeded(0),
            priority_key="td_error",
        )
        buffer.extend(make_rows(300))
        return buffer

    buffer, learner = make(), make_learner()
    log, batch = run_updates(buffer, learner, updates=3)
    assert learner.updates == 3
    assert len(batch) == BATCH
    assert "loss_value" in log
    if isinstance(buffer.sampler, PrioritizedSampler):
        index = batch["index"]
        found = torch.as_tensor(buffer.sampler._sum_tree[index])
        expected = (batch["td_error"] + buffer.sampler._eps) ** 0.6
        torch.testing.assert_close(found.float(), expected.float(), rtol=1e-4, atol=1e-6)


def test_a_buffer_without_a_batch_size_or_with_too_few_rows_is_rejected():
    learner = make_learner()
    buffer = transitions.make_buffer(MANY, None)
    with pytest.raises(ValueError, match="buffer must have a batch_size, got None"):
        run_updates(buffer, learner)
    buffer = transitions.make_buffer(MANY, BATCH)
    buffer.extend(make_rows(BATCH - 1))
    with pytest.raises(ValueError, match="at least one batch of 16, got 15 transitions"):
        run_updates(buffer, learner, updates=2)
    assert learner.updates == 0
    buffer.extend(make_rows(1))
    run_updates(buffer, learner, updates=2)
    assert learner.updates == 2


def test_a_selection_without_a_batch_for_the_critic_is_rejected():
    def none(buffer):
        yield SampledBatch(buffer.sample(), trains="actor")

    with pytest.raises(ValueError, match="select must give the critic a batch"):
        run_updates(make_buffer(), make_learner(), none)


def test_rows_that_make_no_equal_batches_are_rejected():
    buffer = make_buffer()
    learner = Counting()
    batch = buffer.sample()
    learner.update(SampledBatch(batch))
    before = buffer.sampler.priorities()
    with pytest.raises(ValueError, match="16 slots cannot make 3 equal batches"):
        buffer.update_tensordict_priority(batch, batches=3)
    assert same(buffer.sampler.priorities(), before)


# Batches, signals and learner on different devices.


@pytest.mark.parametrize("updates", [1, 3])
@pytest.mark.parametrize(("home", "away"), [("cpu", DEVICE), (DEVICE, DEVICE), (DEVICE, "cpu")])
@pytest.mark.usefixtures("second_device")
def test_batches_go_to_the_device_of_the_learner_and_signals_come_back(updates, home, away):
    home, away = torch.device(home), torch.device(away)
    learner, buffer = Counting(), make_buffer(device=home)
    _, batch = run_updates(
        buffer,
        learner,
        updates=updates,
        prepare=lambda draw: replace(draw, batch=draw.batch.to(away)),
    )
    assert all(each.device == away for each in learner.batches)
    assert batch.device == home
    table = buffer.storage.signal_table
    assert table.rows.device == buffer.sampler.priorities().device == home
    assert bool((table.rows[batch["index"], table.column["td_error"]] == updates).all())
