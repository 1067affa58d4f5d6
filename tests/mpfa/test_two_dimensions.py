"""Several environments: batches of trajectories, storages of two dimensions, collectors."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SliceSampler
from torchrl.envs import SerialEnv
from torchrl.testing.mocking_classes import CountingEnv

from tests.mpfa.transitions import make_buffer, make_transitions, rejected, restore, write_signals
from torchrl_mpfa import SignalMemmapStorage, SignalTensorStorage

ENVS, STEPS, CAPACITY = 3, 4, 24


def make_trajectories(first=0, steps=STEPS):
    """Transitions ``[ENVS, steps]`` whose reward is 100 times the environment, plus the step."""
    step = torch.arange(first, first + steps, dtype=torch.float32)
    number = 100 * torch.arange(ENVS).unsqueeze(1) + step
    return TensorDict(
        {"observation": number.unsqueeze(-1), "next": {"reward": number.unsqueeze(-1)}},
        [ENVS, steps],
    )


def make_deep_buffer(kind=SignalTensorStorage, *, ndim=2, seed=0, **kwargs):
    storage = kind(CAPACITY, ndim=ndim, **kwargs)
    return make_buffer(CAPACITY, 8, storage=storage, seed=seed)


@pytest.mark.parametrize("kind", [SignalTensorStorage, SignalMemmapStorage])
def test_a_ring_of_two_dimensions_keeps_signals_and_data_together(kind):
    ours = make_deep_buffer(kind)
    stock = TensorDictReplayBuffer(
        storage=LazyTensorStorage(CAPACITY, ndim=2),
        batch_size=8,
    )
    for first in range(0, 40, STEPS):
        found = ours.extend(make_trajectories(first))
        assert found.equal(stock.extend(make_trajectories(first)))
        assert len(ours) == len(stock)
        assert ours.storage[:]["observation"].equal(stock.storage[:]["observation"])
        rewards = ours.storage[:]["next", "reward"].flatten()
        torch.testing.assert_close(ours.storage.signal_table.rewards.float(), rewards)


def test_batches_carry_places_and_updates_find_them():
    buffer = make_deep_buffer()
    buffer.extend(make_trajectories())
    batch = write_signals(buffer.sample())
    assert batch["index"].shape == (8, 2)
    place = batch["index"]
    stored = buffer.storage[:]["observation"][place[:, 0], place[:, 1]]
    assert batch["observation"].equal(stored)
    buffer.update_tensordict_priority(batch)
    table = buffer.storage.signal_table
    slots = place[:, 0] * ENVS + place[:, 1]
    known = table.rows[:, table.column["td_error"]].isfinite().nonzero().squeeze(1)
    assert known.tolist() == slots.unique().tolist()
    leaves = buffer.sampler.trees.leaves(torch.arange(ENVS * STEPS))
    fresh = leaves[[slot for slot in range(ENVS * STEPS) if slot not in slots.tolist()]]
    assert fresh.unique().numel() == 1
    assert not torch.isin(leaves[slots], fresh).all()


def test_priorities_by_hand_take_places_too():
    buffer = make_deep_buffer()
    buffer.extend(make_trajectories())
    for index in (torch.tensor([[1, 2], [3, 0]]), (torch.tensor([1, 3]), torch.tensor([2, 0]))):
        buffer.update_priority(index, torch.tensor([7.0, 9.0]))
        slots = torch.tensor([1 * ENVS + 2, 3 * ENVS])
        found = buffer.sampler.trees.leaves(slots)
        assert found.tolist() == pytest.approx([7.05**0.6, 9.05**0.6])
    # As a number it would be a slot: 0 * 3 + 3.
    with rejected(buffer, IndexError, r"within the storage's shape \[8, 3\], got \[0, 3\]"):
        buffer.update_priority(torch.tensor([[0, 3]]), torch.ones(1))


def test_first_priorities_are_those_of_their_steps():
    buffer, data = make_deep_buffer(), make_trajectories()
    data["td_error"] = data["observation"].squeeze(-1)
    buffer.extend(data)
    found = buffer.sampler.priorities()[: ENVS * STEPS].reshape(STEPS, ENVS)
    torch.testing.assert_close(found.T.float(), data["td_error"] + 0.05)


def test_adding_a_step_of_every_environment_equals_extending_by_it():
    one, many = make_deep_buffer(), make_deep_buffer()
    data = make_trajectories()
    many.extend(data)
    places = [one.add(data[:, step]) for step in range(STEPS)]
    assert torch.cat(places).equal(many.extend(data) - torch.tensor([STEPS, 0]))
    assert one.storage.shape == (STEPS, ENVS)
    assert one.storage[:]["observation"].equal(many.storage[:STEPS]["observation"])


def test_adding_a_step_of_no_environment_is_rejected():
    buffer = make_deep_buffer()
    with pytest.raises(ValueError, match=r"one step of each environment, .* got \[\]"):
        buffer.add(make_trajectories()[0, 0])
    assert len(buffer) == 0


def test_another_number_of_environments_is_rejected_and_nothing_changes():
    buffer = make_deep_buffer()
    with pytest.raises(ValueError, match=r"max_size must be a multiple of the 5 transitions .* 24"):
        buffer.extend(TensorDict({"next": {"reward": torch.ones(5, 2, 1)}}, [5, 2]))
    assert len(buffer) == 0
    buffer.extend(make_trajectories())
    with rejected(buffer, ValueError, r"transitions must come \[3\] at a time, .* got \[2\]"):
        buffer.extend(make_trajectories()[:2])


@pytest.mark.parametrize("shape", [(ENVS, STEPS), (1, ENVS, STEPS)])
def test_in_one_dimension_every_step_of_every_environment_is_a_row(shape):
    buffer = make_deep_buffer(ndim=1)
    index = buffer.extend(make_trajectories().reshape(shape))
    assert index.tolist() == list(range(ENVS * STEPS))
    assert buffer[:]["observation"].flatten().equal(make_trajectories()["observation"].flatten())
    buffer.update_tensordict_priority(write_signals(buffer.sample()))


@pytest.mark.parametrize("ndim", [1, 2])
def test_a_collector_of_several_environments_fills_the_buffer(ndim):
    buffer = make_buffer(60, 8, storage=SignalTensorStorage(60, ndim=ndim))
    env = SerialEnv(ENVS, lambda: CountingEnv(max_steps=5))
    collector = Collector(
        env, env.rand_action, frames_per_batch=30, total_frames=120, replay_buffer=buffer
    )
    for _ in collector:
        batch = write_signals(buffer.sample())
        assert batch.batch_size == (8,)
        assert batch["next", "observation"].shape == (8, 1)
        buffer.update_tensordict_priority(batch)
    collector.shutdown()
    assert len(buffer) == 60
    assert buffer.sampler.weights


# TorchRL's own sampler numbers slots of two dimensions in a way that NumPy is about to drop.
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@pytest.mark.parametrize("way", ["state", "folder"])
def test_torchrls_slices_of_a_loaded_ring_do_not_cross_its_newest_step(way, tmp_path):
    first, second = (
        make_buffer(
            8,
            200,
            storage=SignalTensorStorage(8),
            sampler=SliceSampler(slice_len=2, end_key=("next", "done"), strict_length=False),
        )
        for _ in range(2)
    )
    for number in range(11):  # Three steps of the second round, so that the newest has slot 2.
        row = make_transitions(1, first=number)
        row["next", "done"] = torch.zeros(1, 1, dtype=torch.bool)
        first.extend(row)
    restore(second, first, tmp_path if way == "folder" else None)
    for buffer in (first, second):
        steps = buffer.sample()["observation"].reshape(-1, 2)
        assert steps[:, 1].equal(steps[:, 0] + 1)
        assert steps[:, 0].unique().tolist() == [*range(3, 10)]
