"""Replay of this package against TorchRL's prioritized replay, with navigation's transitions."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler

from benchmarks.speed.timing import (
    Call,
    Entry,
    compare,
)
from torchrl_mpfa import (
    ACTION_GRADIENT,
    TD_ERROR,
    Learner,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
    run_updates,
)
from torchrl_mpfa.selection import SampledBatch

BATCH_SIZE = 256
OBSERVATION_SIZE = 24
ACTION_SIZE = 2
ALPHA = 0.6
BETA = 0.4
_FILL_ROWS = 100_000


def make_transitions(count: int, *, seed: int = 0) -> TensorDict:
    """Random transitions in the shape of the navigation task, batch size ``[count]``."""
    generator = torch.Generator().manual_seed(seed)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(count, size, generator=generator)

    end = torch.zeros(count, 1, dtype=torch.bool)
    after = {
        "observation": normal(OBSERVATION_SIZE),
        "reward": normal(1),
        "done": end,
        "terminated": end.clone(),
    }
    return TensorDict(
        {
            "observation": normal(OBSERVATION_SIZE),
            "action": normal(ACTION_SIZE).tanh(),
            "next": TensorDict(after, [count]),
        },
        [count],
    )


def make_mpfa_buffer(
    capacity: int, batch_size: int = BATCH_SIZE, storage: SignalTensorStorage | None = None
) -> SignalReplayBuffer:
    """A full buffer of this package with the paper's sampler; by default in memory."""
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(capacity) if storage is None else storage,
        sampler=MPFASampler(capacity, ALPHA, BETA),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(0),
    )
    return _fill(buffer, capacity)


def make_stock_buffer(capacity: int, batch_size: int = BATCH_SIZE) -> TensorDictReplayBuffer:
    """A full buffer of TorchRL with its prioritized sampler."""
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity),
        sampler=PrioritizedSampler(capacity, ALPHA, BETA),
        batch_size=batch_size,
        priority_key="td_error",
    )
    return _fill(buffer, capacity)


def _fill(buffer: TensorDictReplayBuffer, capacity: int) -> TensorDictReplayBuffer:
    for start in range(0, capacity, _FILL_ROWS):
        buffer.extend(make_transitions(min(_FILL_ROWS, capacity - start), seed=start))
    return buffer


def make_mpfa_update(buffer: SignalReplayBuffer, count: int = BATCH_SIZE) -> Call:
    """One sample and one update of priorities; signals are written as the loss writes them."""
    generator = torch.Generator().manual_seed(1)
    td_error, action_gradient = torch.rand(2, count, generator=generator).unbind()

    def update() -> None:
        batch = buffer.sample()
        batch.set(TD_ERROR.key, td_error)
        batch.set(ACTION_GRADIENT.key, action_gradient)
        buffer.update_tensordict_priority(batch)

    return update


def make_stock_update(buffer: TensorDictReplayBuffer, count: int = BATCH_SIZE) -> Call:
    """The same with TorchRL's buffer, which takes one number per transition."""
    td_error = torch.rand(count, generator=torch.Generator().manual_seed(1))

    def update() -> None:
        batch = buffer.sample()
        batch.set("td_error", td_error)
        buffer.update_tensordict_priority(batch)

    return update


def measure_sample_update(
    name: str = "sample_update_1e5", *, capacity: int = 100_000, quick: bool
) -> list[Entry]:
    """Sample a batch, write its signals, update its priorities; ours has the ratio."""
    ours = make_mpfa_update(make_mpfa_buffer(capacity))
    stock = make_stock_update(make_stock_buffer(capacity))
    return compare(name, ours, stock, quick=quick)


def measure_sample_16x256(*, quick: bool) -> list[Entry]:
    """Sample and update sixteen batches in one call, as for many robots; ours has the ratio."""
    count = 16 * BATCH_SIZE
    ours = make_mpfa_update(make_mpfa_buffer(100_000, count), count)
    stock = make_stock_update(make_stock_buffer(100_000, count), count)
    return compare("sample_16x256", ours, stock, quick=quick)


class _Signals:
    """A learner that learns nothing: its signals are the same at each update."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(1)
        self._signals = torch.rand(2, BATCH_SIZE, generator=generator).unbind()

    def update(self, sampled: SampledBatch) -> dict[str, torch.Tensor]:
        """Write signals as the loss writes them."""
        for key, value in zip((TD_ERROR.key, ACTION_GRADIENT.key), self._signals, strict=True):
            sampled.batch.set(key, value)
        return {}


def measure_iteration_4x256(
    name: str = "iteration_4x256", *, updates: int = 4, capacity: int = 100_000, quick: bool
) -> list[Entry]:
    """Update by four batches: ours in one call, TorchRL's one by one."""
    buffer, learner = make_mpfa_buffer(capacity), cast(Learner, _Signals())
    update = make_stock_update(make_stock_buffer(capacity))

    def ours() -> None:
        run_updates(buffer, learner, updates=updates)

    def stock() -> None:
        for _ in range(updates):
            update()

    return compare(name, ours, stock, quick=quick)


def measure_extend_one(
    name: str = "extend_one", *, rows: int = 1, capacity: int = 100_000, quick: bool
) -> list[Entry]:
    """Write one transition in a full buffer, with the checks of the transition."""
    ours, stock = make_mpfa_buffer(capacity), make_stock_buffer(capacity)
    # A round with other priorities than the first ones, as training has them.
    make_mpfa_update(ours)()
    make_stock_update(stock)()
    transitions = make_transitions(rows)
    return compare(
        name, lambda: ours.extend(transitions), lambda: stock.extend(transitions), quick=quick
    )


def measure_extend_16(
    name: str = "extend_16", *, capacity: int = 100_000, quick: bool
) -> list[Entry]:
    """Write sixteen transitions in one call, as from sixteen environments."""
    return measure_extend_one(name, rows=16, capacity=capacity, quick=quick)
