"""Storages on a GPU, or on what stands for one: priorities, batches and signals stay there."""

import pytest
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer

from tests.mpfa.samplers.test_trees import MADE
from tests.mpfa.second_device import DEVICE
from tests.mpfa.transitions import make_buffer, make_rows, make_transitions, same, seeded
from torchrl_mpfa import MPFASampler, SignalTensorStorage, make_actor
from torchrl_mpfa.methods import METHODS, make_replay
from torchrl_mpfa.samplers import TreeSampler

pytestmark = pytest.mark.usefixtures("second_device", "reconstructed")
CPU = torch.device("cpu")
CAPACITY, BATCH = 24, 8
# One of each selection, and of each part that reads the whole buffer.
METHODS_THERE = (
    *("mpfa_per", "mpfa_adaptive", "mpfa_plus", "per", "hvper", "lap", "rank_per", "la3p", "mw"),
    *("reaper", "uniform", "cer", "geometric", "ref_er", "klper"),
)


def make_there(kind="mpfa", device=DEVICE, count=CAPACITY):
    """A buffer with its storage there, and some transitions, which come from the CPU."""
    storage = SignalTensorStorage(CAPACITY, device=device)
    buffer = make_buffer(CAPACITY, BATCH, storage=storage, sampler=MADE[kind](CAPACITY))
    buffer.extend(make_transitions(count))
    return buffer


def give_signals(buffer, slots, *, seed=0):
    """One update of these slots."""
    device, generator = buffer.storage.device, seeded(seed)
    signals = {
        name: torch.rand(len(slots), generator=generator).to(device)
        for name in ("td_error", "action_gradient")
    }
    buffer.sampler.update_signals(slots.to(device), signals, storage=buffer.storage)


@pytest.mark.parametrize("name", METHODS_THERE)
def test_each_method_samples_and_learns_there(name):
    assert name in METHODS
    replay = make_replay(
        name,
        capacity=CAPACITY,
        batch_size=BATCH,
        device=DEVICE,
        policy=make_actor(24, 2),
        sigma=0.1,
    )
    for seed in range(3):
        replay.buffer.extend(make_rows(20, seed=seed, observed=24, length=5))
        for sampled in replay.select(replay.buffer):
            batch = sampled.batch
            assert {value.device for value in batch.values(True, True)} == {DEVICE}
            for key in ("td_error", "action_gradient", "value"):
                batch["signals", key] = 5 * torch.rand(len(batch)).to(DEVICE)
            if sampled.gives_signals:
                replay.buffer.update_tensordict_priority(batch)
    if replay.signals:
        sampler, table = replay.buffer.sampler, replay.buffer.storage.signal_table
        assert sampler.priorities().device == sampler.device == table.rows.device == DEVICE
        assert len(sampler.priorities().unique()) > 1
        assert replay.buffer.stats()


@pytest.mark.parametrize("kind", MADE)
def test_priorities_and_signals_are_those_of_a_buffer_on_the_cpu(kind):
    there, here = make_there(kind), make_there(kind, CPU)
    for seed in range(12):
        slots = torch.randint(CAPACITY, (BATCH,), generator=seeded(seed))
        for buffer in (there, here):
            buffer.storage.signal_table.count_replay(slots.to(buffer.storage.device))
            # Of a slot that comes twice, the last entry counts.
            give_signals(buffer, slots, seed=seed)
            if seed % 3 == 0:
                buffer.extend(make_transitions(4, first=seed, seed=seed))
    for part in ("_sampler", "_storage"):
        found, expected = (each.state_dict()[part] for each in (there, here))
        torch.testing.assert_close(
            torch.cat([v.flatten().double() for v in tensors(found)]),
            torch.cat([v.flatten().double() for v in tensors(expected)]),
            rtol=1e-12,
            atol=0.0,
            equal_nan=True,
        )


def tensors(state):
    """All tensors of a state, by their names."""
    if isinstance(state, torch.Tensor):
        return [state.cpu()]
    if hasattr(state, "keys"):
        return [found for key in sorted(state.keys(), key=str) for found in tensors(state[key])]
    return []


def test_to_sample_neither_waits_for_the_device_nor_moves_anything(second_device):
    buffer = make_there()
    buffer.sample()  # Once it waits: are all priorities positive?
    give_signals(buffer, torch.arange(CAPACITY))
    if second_device is None:
        torch.cuda.set_sync_debug_mode("error")
        try:
            buffer.sample()
        finally:
            torch.cuda.set_sync_debug_mode("default")
        return
    second_device.waits.clear()
    second_device.moves.clear()
    buffer.sample()
    assert not second_device.waits
    assert not second_device.moves


def test_an_update_waits_four_times_and_a_write_not_at_all(second_device):
    if second_device is None:
        pytest.skip("a GPU does not count")
    buffer = make_there()
    give_signals(buffer, torch.arange(CAPACITY))
    batch = buffer.sample()
    for name in ("td_error", "action_gradient"):
        batch["signals", name] = torch.full((BATCH,), 0.01).to(DEVICE)
    second_device.waits.clear()
    second_device.moves.clear()
    buffer.update_tensordict_priority(batch)
    # Slots, times of writing, signals, priorities: what is wrong is rejected before it is written.
    assert second_device.waits.total() <= 4
    assert not second_device.moves
    second_device.waits.clear()
    buffer.extend(make_transitions(2))
    assert not second_device.waits


def test_a_sampler_follows_a_storage_to_the_device_of_its_first_transitions():
    assert make_there(device="auto").sampler.device == CPU
    storage = SignalTensorStorage(CAPACITY, device="auto")
    buffer = make_buffer(CAPACITY, BATCH, storage=storage)
    buffer.extend(make_transitions(CAPACITY).to(DEVICE))
    assert buffer.sampler.device == buffer.storage.signal_table.rows.device == DEVICE
    assert buffer.sample()["index"].device == DEVICE


def test_a_device_other_than_that_of_the_storage_is_rejected():
    sampler = MPFASampler(CAPACITY, device="cpu")
    with pytest.raises(ValueError, match="device must be that of the storage, cuda:0, or None"):
        make_buffer(storage=SignalTensorStorage(CAPACITY, device=DEVICE), sampler=sampler)


@pytest.mark.parametrize("kind", MADE)
@pytest.mark.parametrize("first", [DEVICE, CPU])
def test_a_state_of_one_device_loads_on_the_other(kind, first):
    second = CPU if first == DEVICE else DEVICE
    saved, loaded = make_there(kind, first), make_there(kind, second, count=2)
    for seed in range(3):
        give_signals(saved, torch.randint(CAPACITY, (BATCH,), generator=seeded(seed)), seed=seed)
    saved.sample()
    loaded.load_state_dict(saved.state_dict())
    assert loaded.sampler.device == loaded.sample()["observation"].device == second
    loaded.load_state_dict(saved.state_dict())
    for buffer in (saved, loaded):
        give_signals(buffer, torch.arange(6), seed=5)
    assert same(loaded.sampler.priorities().cpu(), saved.sampler.priorities().cpu())
    assert same(loaded.storage.signal_table.rows.cpu(), saved.storage.signal_table.rows.cpu())


def test_priorities_of_zero_are_not_sampled_from_there():
    sampler = TreeSampler(4, 1.0, 0.4, 0.0)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(4, device=DEVICE), sampler=sampler, batch_size=2
    )
    buffer.extend(torch.arange(4))
    buffer.sample()
    buffer.update_priority(torch.arange(2), torch.zeros(2))
    with pytest.raises(RuntimeError, match="every priority must be positive"):
        buffer.sample()
