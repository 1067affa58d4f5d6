"""Transitions and buffers that the tests of the replay parts share."""

import os
from contextlib import contextmanager
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict

from torchrl_mpfa import MPFASampler, SignalReplayBuffer, SignalTensorStorage


def seeded(seed=0):
    """A generator of its own."""
    return torch.Generator().manual_seed(seed)


def make_transitions(count, *, seed=0, first=0, rewards=None):
    """Transitions whose observation is their number, so that a row can be told from another."""
    if rewards is None:
        rewards = torch.randn(count, generator=seeded(seed))
    number = torch.arange(first, first + count, dtype=torch.float32)
    return TensorDict(
        {
            "observation": number.unsqueeze(1),
            "next": {"reward": torch.as_tensor(rewards, dtype=torch.float32).reshape(-1, 1)},
        },
        [count],
    )


def make_rows(count, *, seed=0, observed=5, length=10):
    """Transitions with all that any method asks for, in episodes of this length."""
    generator, number = seeded(seed), torch.arange(count).unsqueeze(1)

    def normal(size):
        return torch.randn(count, size, generator=generator)

    after = {"observation": normal(observed), "reward": normal(1)}
    after |= {"done": number % length == length - 1, "terminated": torch.zeros_like(number).bool()}
    return TensorDict(
        {
            "observation": normal(observed),
            "action": normal(2).tanh(),
            "episode": number // length,
            "behavior_mean": normal(2).tanh(),
            "behavior_sigma": torch.full((count, 1), 0.3),
            "next": after,
        },
        [count],
    )


_OF_BUFFER = {"transform", "transform_factory", "writer", "priority_key", "allow_nonfinite"}


def make_buffer(capacity=16, batch_size=4, *, seed=0, storage=None, sampler=None, **kwargs):
    """A buffer with a generator of its own; the paper's sampler, the default, takes the rest."""
    parts = {name: kwargs.pop(name) for name in _OF_BUFFER & kwargs.keys()}
    if sampler is None:
        sampler = MPFASampler(capacity, **kwargs)
    if storage is None:
        storage = SignalTensorStorage(capacity)
    return SignalReplayBuffer(
        storage=storage, sampler=sampler, batch_size=batch_size, generator=seeded(seed), **parts
    )


def make_filled(capacity=16, batch_size=4, **kwargs):
    """The same, full of transitions."""
    buffer = make_buffer(capacity, batch_size, **kwargs)
    buffer.extend(make_transitions(capacity))
    return buffer


def write_signals(batch, *, seed=0, generator=None):
    """Write what a loss would: random absolute TD errors and gradient norms."""
    generator = seeded(seed) if generator is None else generator
    count = batch.batch_size[0]
    batch["signals"] = TensorDict(
        {
            "td_error": torch.rand(count, generator=generator) * 3,
            "action_gradient": torch.rand(count, generator=generator) * 2,
        },
        [count],
    )
    return batch


def set_signals(buffer, index=None, **signals):
    """Give slots, by default every filled one, these signals, as a training step would."""
    slots = torch.arange(len(buffer)) if index is None else torch.as_tensor(index)
    batch = TensorDict({"index": slots}, [len(slots)])
    batch["written_at"] = buffer.storage.signal_table.written_at(slots)
    for name, value in signals.items():
        batch["signals", name] = torch.as_tensor(value)
    buffer.update_tensordict_priority(batch)


def train_rounds(buffer, rounds, *, seed=0):
    """Sample and update; give everything that was sampled."""
    generator = seeded(seed)
    sampled = []
    for _ in range(rounds):
        batch = buffer.sample()
        sampled.append(
            torch.cat((batch["index"].double().flatten(), batch["priority_weight"].double()))
        )
        buffer.update_tensordict_priority(write_signals(batch, generator=generator))
    return torch.stack(sampled)


def same(first, second):
    """Whether two states are equal, bit for bit, with NaN equal to NaN."""
    if isinstance(first, torch.Tensor):
        if first.shape != second.shape or first.dtype != second.dtype:
            return False
        return bool(((first == second) | ((first != first) & (second != second))).all())
    if hasattr(first, "keys"):
        keys = set(first.keys())
        return keys == set(second.keys()) and all(same(first[k], second[k]) for k in keys)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return bool(first == second)


def snapshot(buffer):
    """A copy of the whole state of a buffer, generator included."""
    return deepcopy(buffer.state_dict())


@contextmanager
def rejected(part, error, match=None):
    """A block that raises this error and leaves the state of the part as it was."""
    before = snapshot(part)
    with pytest.raises(error, match=match):
        yield
    assert same(before, snapshot(part))


def restore(second, first, folder=None):
    """Give a buffer the state of another one, through a folder if there is one."""
    if folder is None:
        second.load_state_dict(first.state_dict())
    else:
        first.dumps(folder)
        second.loads(folder)


MISSING = object()
"""In place of a value that is deleted."""


def spoil(state, path, value):
    """Put a value in place of another, somewhere in a nested state."""
    *outer, last = path
    for key in outer:
        state = state[key]
    if value is MISSING:
        del state[last]
    else:
        state[last] = value


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)
