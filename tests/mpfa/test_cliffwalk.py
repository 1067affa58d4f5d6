"""The blind cliffwalk of the PER paper: only priorities that work save updates there.

Schaul et al. (2016), https://arxiv.org/abs/1511.05952, appendix B.1. In each of n states one of two
actions is right and leads to the next state; the other one ends the episode. The right action in
the last state has a reward of 1. The memory holds all sequences of actions once: of 2^(n+1) - 2
transitions a single one has a reward.
"""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_mpfa import MPFASampler, SignalReplayBuffer, SignalSampler, SignalTensorStorage
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.methods.rank_per import RankPERSampler

LENGTH = 7
SIZE = 2 ** (LENGTH + 1) - 2
GAMMA = 1 - 1 / LENGTH
TRUTH = torch.zeros(LENGTH, 2)
for _state in range(LENGTH):
    TRUTH[_state, _state % 2] = GAMMA ** (LENGTH - 1 - _state)


def memory():
    """Make all transitions, sequence after sequence in random order."""
    sequence = torch.randperm(2**LENGTH, generator=torch.Generator().manual_seed(0)).unsqueeze(1)
    action = (sequence >> torch.arange(LENGTH)) & 1
    right = action == torch.arange(LENGTH) % 2
    reached = torch.cat([torch.ones(2**LENGTH, 1, dtype=torch.long), right.long()[:, :-1]], 1)
    row, state = reached.cumprod(1).nonzero(as_tuple=True)
    right = right[row, state]
    goal = right & (state == LENGTH - 1)
    after = {"state": (state + 1).clamp_max(LENGTH - 1), "reward": goal.float().unsqueeze(1)}
    after["terminated"] = (goal | ~right).unsqueeze(1)
    return TensorDict({"state": state, "action": action[row, state], "next": after}, [SIZE])


def updates_until_known(buffer, limit=50_000):
    """Count the updates of tabular Q learning until its mean squared error is below 1e-3."""
    buffer.extend(memory())
    values = torch.randn(LENGTH, 2, generator=torch.Generator().manual_seed(0)) * 0.1
    for updates in range(0, limit, buffer.batch_size):
        batch = buffer.sample()
        errors = []
        for row in batch.unbind(0):
            after = row["next"]
            ahead = 0.0 if after["terminated"] else GAMMA * values[after["state"]].max()
            error = after["reward"] + ahead - values[row["state"], row["action"]]
            values[row["state"], row["action"]] += 0.25 * error.item()
            errors.append(abs(error.item()))
        if (values - TRUTH).square().mean() < 1e-3:
            return updates
        batch["signals", "td_error"] = torch.tensor(errors)
        buffer.update_tensordict_priority(batch)
    return math.inf


@pytest.fixture(scope="module")
def of_uniform():
    replay = make_replay("uniform", capacity=SIZE, batch_size=64)
    return updates_until_known(replay.buffer)


def test_memory_holds_every_sequence_to_its_end_and_one_reward():
    rows = memory()
    assert (
        len(
            {
                tuple(each)
                for each in zip(*(rows[k].tolist() for k in ("state", "action")), strict=True)
            }
        )
        == 2 * LENGTH
    )
    assert rows["next", "reward"].sum() == 1.0
    for state in range(LENGTH):
        assert (rows["state"] == state).sum() == 2 ** (LENGTH - state)


class Uniform(SignalSampler):
    """Knows the priorities and does not use them."""

    def _sample_slots(self, size, batch_size):
        return self._uniform(size, batch_size), torch.ones(batch_size)


class Deaf(SignalSampler):
    """Ignores all signals."""

    def update_signals(self, index, signals, **kwargs):
        return 0


class Reversed(SignalSampler):
    """Samples what has the least priority most often."""

    def _leaf(self, priority):
        return super()._leaf(1.0 / priority)


@pytest.mark.parametrize(
    "kind", [SignalSampler, RankPERSampler, MPFASampler, Uniform, Deaf, Reversed]
)
def test_only_a_sampler_that_works_saves_half_of_the_updates(kind, of_uniform):
    options = {"signals": ["reward", "td_error"]} if kind is MPFASampler else {}
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(SIZE),
        sampler=kind(SIZE, 0.6, 0.4, 1e-3, **options),
        batch_size=4,
        generator=torch.Generator().manual_seed(0),
    )
    works = kind not in (Uniform, Deaf, Reversed)
    assert (updates_until_known(buffer, int(of_uniform / 2)) < math.inf) == works
