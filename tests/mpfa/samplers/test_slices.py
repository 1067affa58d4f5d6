"""Slices of trajectories: which can be sampled, how often, and what their steps bring back."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import TensorDictMaxValueWriter
from torchrl.envs import SerialEnv
from torchrl.testing.mocking_classes import CountingEnv

from tests.mpfa.transitions import (
    MISSING,
    make_buffer,
    rejected,
    restore,
    same,
    seeded,
    snapshot,
    spoil,
    train_rounds,
    write_signals,
)
from torchrl_mpfa import (
    ActorCritic,
    EntropyFusion,
    PositiveBoost,
    PositiveDecay,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalSampler,
    SignalSliceSampler,
    SignalTensorStorage,
    make_actor,
    make_critic,
    run_updates,
)
from torchrl_mpfa.signals import MPFA_SIGNALS

ENVS, CAPACITY, LENGTH, ALPHA, BETA = 3, 60, 4, 0.6, 0.4
BOTH_PATHS = pytest.mark.usefixtures("path")
READINGS = pytest.mark.parametrize(
    ("slice_priority", "strict_length"),
    [("mean", True), ("mean", False), ("start", True), ("start", False)],
)


def choices(kind, **kwargs):
    """A sampler with all that MPFA-PER does to the priority of a step."""
    return kind(
        CAPACITY,
        ALPHA,
        BETA,
        0.05,
        signals=MPFA_SIGNALS,
        fusion=EntropyFusion(),
        adjustments=(PositiveBoost(), PositiveDecay()),
        **kwargs,
    )


def make_slices(*, ndim=2, storage=SignalTensorStorage, seed=0, batch_size=8, **kwargs):
    sampler = choices(SignalSliceSampler, **{"slice_len": LENGTH, **kwargs})
    parts = {"storage": storage(CAPACITY, ndim=ndim), "sampler": sampler}
    return make_buffer(CAPACITY, batch_size, seed=seed, **parts)


def make_steps(first, steps, *, seed=0):
    """Steps ``[ENVS, steps]`` that count on for each environment; about every fifth ends."""
    generator = seeded(seed + first)
    number = 1000.0 * torch.arange(ENVS).unsqueeze(1) + torch.arange(first, first + steps)
    after = {
        "observation": number.unsqueeze(-1) + 1.0,
        "reward": torch.randn(ENVS, steps, 1, generator=generator),
        "done": torch.rand(ENVS, steps, 1, generator=generator) < 0.2,
    }
    return TensorDict({"observation": number.unsqueeze(-1), "next": after}, [ENVS, steps])


def filled(*, rounds=9, batch_size=8, **kwargs):
    """A buffer that was written in parts, more than once around, with an update after each."""
    buffer, generator, first = make_slices(batch_size=batch_size, **kwargs), seeded(5), 0
    for steps in [7, 1, 5, 3, 2, 6, 4, 1, 3][:rounds]:
        data = make_steps(first, steps)
        if buffer.storage.ndim == 1:  # The next row is another environment's.
            data["next", "done"][:, -1] = True
        index = buffer.extend(data)
        first += steps
        chosen = torch.randperm(len(index), generator=generator)[: len(index) // 2]
        values = torch.rand(len(chosen), generator=generator) * 5
        buffer.update_priority(index[chosen], values)
        if first > 10:
            batch = buffer.sample(2 * LENGTH if batch_size is None else batch_size)
            buffer.update_tensordict_priority(write_signals(batch, generator=generator))
    return buffer


def slices_by_hand(buffer):
    """Priority of each slice by its start, from a loop over the stored steps."""
    sampler = buffer.sampler
    number = buffer.storage._storage["observation"].reshape(CAPACITY)
    done = buffer.storage._storage["next", "done"].reshape(CAPACITY)
    stride = ENVS if buffer.storage.ndim == 2 else 1
    priorities, found = sampler.priorities(), {}
    for start in range(len(buffer)):
        slots = [start]
        while len(slots) < LENGTH and not done[slots[-1]]:
            after = (slots[-1] + stride) % CAPACITY
            if after >= len(buffer) or number[after] != number[slots[-1]] + 1:
                break
            slots.append(after)
        if len(slots) == LENGTH or not sampler.strict_length:
            steps = slots if sampler.slice_priority == "mean" else slots[:1]
            found[start] = float(priorities[steps].mean())
    return found


def check_leaves(buffer):
    expected, slots = slices_by_hand(buffer), torch.arange(CAPACITY)
    leaf = torch.tensor([expected.get(slot, 0.0) ** ALPHA for slot in slots.tolist()]).double()
    torch.testing.assert_close(buffer.sampler.trees.leaves(slots), leaf)
    if expected:
        lowest = buffer.sampler.trees.lowest(CAPACITY)
        assert lowest == pytest.approx(float(leaf[leaf > 0].min()))
    return expected


@BOTH_PATHS
@READINGS
@pytest.mark.parametrize("ndim", [1, 2])
def test_every_slice_has_the_priority_of_a_plain_loop_after_every_write(
    slice_priority, strict_length, ndim
):
    seen = set()
    for rounds in range(1, 10):
        buffer = filled(
            rounds=rounds, ndim=ndim, slice_priority=slice_priority, strict_length=strict_length
        )
        seen.add(len(check_leaves(buffer)))
    assert len(seen) > 3
    assert len(buffer) == CAPACITY


@BOTH_PATHS
@READINGS
def test_no_slice_crosses_the_end_of_a_trajectory_or_the_newest_step(slice_priority, strict_length):
    buffer = filled(slice_priority=slice_priority, strict_length=strict_length, batch_size=40)
    lengths = set()
    for _ in range(50):
        batch = buffer.sample()
        last = batch["next", "truncated"].squeeze(1).nonzero().squeeze(1) + 1
        assert batch["next", "done"][last - 1].all()
        sizes = last.diff(prepend=torch.zeros(1, dtype=torch.long))
        assert sizes.sum() == len(batch)
        lengths |= set(sizes.tolist())
        for piece in batch["observation"].squeeze(1).split(sizes.tolist()):
            assert piece.diff().eq(1).all()
        done = buffer.storage[:]["next", "done"][tuple(batch["index"].unbind(1))]
        inside = torch.ones(len(batch), dtype=torch.bool)
        inside[last - 1] = False
        assert not done.squeeze(1)[inside].any()
    assert lengths == ({LENGTH} if strict_length else {1, 2, 3, 4})


@BOTH_PATHS
def test_weights_are_those_of_the_starts_and_of_every_step_of_a_slice():
    buffer = filled()
    priority = slices_by_hand(buffer)
    lowest = min(priority.values())
    batch = buffer.sample()
    for slots, weights in zip(
        (batch["index"] @ torch.tensor([ENVS, 1])).reshape(-1, LENGTH),
        batch["priority_weight"].reshape(-1, LENGTH),
        strict=True,
    ):
        expected = (priority[int(slots[0])] / lowest) ** (-ALPHA * BETA)
        assert weights.tolist() == pytest.approx([expected] * LENGTH)
    known = buffer.sampler.batch_weights(CAPACITY).isfinite().nonzero().squeeze(1)
    assert known.tolist() == sorted(priority)


@BOTH_PATHS
def test_priorities_of_steps_equal_those_without_slices():
    sliced = filled(batch_size=32)
    storage = SignalTensorStorage(CAPACITY, ndim=2)
    storage.load_state_dict(snapshot(sliced)["_storage"])
    single = SignalReplayBuffer(storage=storage, sampler=choices(SignalSampler))
    batch = write_signals(sliced.sample()).exclude("written_at")
    sliced.update_tensordict_priority(batch)
    single.update_tensordict_priority(batch)
    slots = (batch["index"] @ torch.tensor([ENVS, 1])).unique()
    updated = sliced.sampler.priorities(slots)
    torch.testing.assert_close(updated, single.sampler.priorities(slots))
    assert updated.unique().numel() > 10
    check_leaves(sliced)


@BOTH_PATHS
@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
@READINGS
def test_loaded_buffer_of_slices_trains_like_the_saved_one(
    slice_priority, strict_length, kind, tmp_path
):
    options = {"slice_priority": slice_priority, "strict_length": strict_length}
    first = filled(**options)
    for after, folder in ((32, None), (35, tmp_path / "buffer")):
        second = make_slices(seed=3, storage=kind, **options)
        second.extend(make_steps(0, 2))
        restore(second, first, folder)
        assert same(snapshot(first)["_sampler"], snapshot(second)["_sampler"])
        for buffer in (first, second):
            buffer.extend(make_steps(after, 3))
            train_rounds(buffer, 3) if strict_length else None
            check_leaves(buffer)
        assert same(first.sample().to_dict(), second.sample().to_dict())


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("_joined", MISSING, "'_joined' is missing"),
        ("_joined", torch.ones(3, dtype=torch.bool), r"must be torch.bool of shape \[60\]"),
        ("_stride", 7, "'_stride' .* a divisor of 60, got 7"),
        ("slice_priority", "start", "'slice_priority' .* must be 'mean', got 'start'"),
        ("_kind", "signals", "'_kind' .* must be 'slices', got 'signals'"),
    ],
)
def test_wrong_state_of_slices_is_rejected_and_changes_nothing(name, value, words):
    buffer = filled()
    state = snapshot(buffer)
    spoil(state, ("_sampler", name), value)
    with rejected(buffer, (KeyError, ValueError), words):
        buffer.load_state_dict(state)


@BOTH_PATHS
def test_rounding_never_samples_what_has_the_probability_zero(monkeypatch):
    buffer, steps = make_slices(batch_size=32), make_steps(0, 20)
    steps["next", "done"][:, 0] = True
    buffer.extend(steps)
    mass, zeros = buffer.sampler._mass, [4]

    def first_at_zero(count):
        found = mass(count)
        if zeros:
            found[: zeros.pop()] = 0.0
        return found

    monkeypatch.setattr(buffer.sampler, "_mass", first_at_zero)
    assert 0 not in slices_by_hand(buffer)
    starts = buffer.sample()["index"].reshape(-1, LENGTH, 2)[:, 0] @ torch.tensor([ENVS, 1])
    assert set(starts.tolist()) <= set(slices_by_hand(buffer))


@BOTH_PATHS
def test_emptied_buffer_has_no_old_slices():
    buffer = filled()
    buffer.empty()
    buffer.extend(make_steps(0, LENGTH - 1))
    with pytest.raises(RuntimeError, match="no trajectory in the buffer has 4 steps"):
        buffer.sample()
    buffer.extend(make_steps(LENGTH - 1, 8))
    check_leaves(buffer)
    assert len(buffer.sample()) == 8


@pytest.mark.parametrize("ndim", [1, 2])
def test_trajectories_of_a_collector_are_kept_apart_even_without_their_ends(ndim):
    buffer = make_slices(ndim=ndim, end_key="never", batch_size=80)
    env = SerialEnv(ENVS, lambda: CountingEnv(max_steps=5))
    collector = Collector(env, env.rand_action, frames_per_batch=30, total_frames=120)
    for steps in collector:
        steps["never"] = torch.zeros(*steps.shape, 1, dtype=torch.bool)
        buffer.extend(steps)
        pieces = buffer.sample().reshape(-1, LENGTH)
        assert pieces["next", "observation"][:, :-1].equal(pieces["observation"][:, 1:])
        assert pieces["collector", "traj_ids"].diff(dim=1).unique().tolist() == [0]
    collector.shutdown()


def test_trajectories_are_kept_apart_where_the_next_one_begins_as_the_last_one_ended():
    storage, sampler = SignalTensorStorage(8), SignalSliceSampler(8, ALPHA, BETA, slice_len=2)
    buffer = make_buffer(8, 2, storage=storage, sampler=sampler)
    still, end = torch.zeros(8, 1), torch.zeros(8, 1, dtype=torch.bool)
    after = {"observation": still, "reward": still, "done": end}
    steps = TensorDict({"observation": still, "next": after}, [8])
    steps["collector", "traj_ids"] = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1])
    buffer.extend(steps)
    joined = [True, True, True, False, True, True, True, False]
    assert sampler.trees.leaves(torch.arange(8)).gt(0).tolist() == joined


def test_rows_of_several_environments_in_turn_are_no_trajectory():
    buffer = make_slices(ndim=1, traj_key="robot")
    rows = make_steps(0, 10)
    rows["robot"] = torch.arange(ENVS).unsqueeze(1).expand(ENVS, 10)
    buffer.extend(rows.transpose(0, 1).reshape(-1))
    with pytest.raises(RuntimeError, match="several environments go to a storage with ndim=2"):
        buffer.sample()


def test_a_step_in_the_place_of_another_follows_no_older_one_without_observations():
    storage, sampler = SignalTensorStorage(8), SignalSliceSampler(8, ALPHA, BETA, slice_len=2)
    writer = TensorDictMaxValueWriter(rank_key=("next", "reward"))
    buffer = make_buffer(8, 2, storage=storage, sampler=sampler, writer=writer)
    reward = torch.tensor([1.0, 2, 3, 0, 4, 5, 6, 7]).unsqueeze(1)
    after = {"reward": reward, "done": torch.zeros(8, 1, dtype=torch.bool)}
    buffer.extend(TensorDict({"next": after}, [8]))
    assert sampler.trees.leaves(torch.arange(8)).gt(0).tolist() == [True] * 7 + [False]
    better = {"reward": torch.full((1, 1), 9.0), "done": torch.zeros(1, 1, dtype=torch.bool)}
    assert buffer.extend(TensorDict({"next": better}, [1])).tolist() == [3]
    joined = [True, True, False, False, True, True, True, False]
    assert sampler.trees.leaves(torch.arange(8)).gt(0).tolist() == joined


def test_a_batch_can_leave_the_ends_as_they_were_stored():
    buffer = filled(truncated_key=None)
    batch = buffer.sample()
    assert batch.get(("next", "truncated"), None) is None
    stored = buffer.storage[:][tuple(batch["index"].unbind(1))]
    assert batch["next", "done"].equal(stored["next", "done"])


@BOTH_PATHS
@pytest.mark.parametrize("strict_length", [True, False])
def test_updates_of_an_iteration_learn_from_whole_slices(strict_length):
    sampler = SignalSliceSampler(
        CAPACITY,
        ALPHA,
        BETA,
        signals=["td_error"],
        slice_len=LENGTH,
        strict_length=strict_length,
    )
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(CAPACITY, ndim=2), sampler=sampler, batch_size=8
    )
    data = make_steps(0, 20)
    data["action"] = torch.zeros(ENVS, 20, 2)
    data["next", "observation"] = data["observation"] + 1
    data["next", "terminated"] = data["next", "done"].clone()
    buffer.extend(data)
    networks = make_actor(1, 2, width=8), make_critic(1, 2, width=8)
    learner = ActorCritic(*networks)
    _, batch = run_updates(buffer, learner, updates=3)
    last = batch["next", "truncated"].squeeze(1)
    assert last[-1]
    assert batch["observation"].squeeze(1).diff()[~last[:-1]].eq(1).all()
    assert batch["signals", "td_error"].shape == batch.shape
    check_leaves(buffer)


def test_a_batch_that_is_not_of_whole_slices_is_rejected():
    buffer = filled(batch_size=None)
    with rejected(buffer, ValueError, "batch_size must be a multiple of slice_len, 4, got 10"):
        buffer.sample(10)


def test_steps_without_the_end_of_their_trajectory_are_rejected_before_they_are_written():
    buffer = make_slices()
    with rejected(
        buffer, KeyError, r"transitions lack \('next', 'done'\), which the sampler reads"
    ):
        buffer.extend(make_steps(0, 5).exclude(("next", "done")))
    assert len(buffer) == 0
