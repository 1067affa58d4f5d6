"""The blind cliffwalk: its transitions, its values, and that only working priorities pass it."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from torchrl_mpfa import SignalSampler
from torchrl_mpfa.cliffwalk import (
    Cliffwalk,
    CliffwalkValues,
    updates_to_convergence,
)
from torchrl_mpfa.methods import make_replay
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.testing import check_prioritization


def rows_of(cliff, generator=None):
    data = cliff.transitions(generator)
    after = data["next"]
    return list(
        zip(
            data["state"].tolist(),
            data["action"].tolist(),
            after["state"].tolist(),
            after["reward"].squeeze(1).tolist(),
            after["terminated"].squeeze(1).tolist(),
            strict=True,
        )
    )


@pytest.mark.parametrize("length", [2, 3, 5])
def test_the_memory_holds_every_sequence_of_actions_to_its_end(length):
    cliff, expected = Cliffwalk(length), []
    for actions in itertools.product((0, 1), repeat=length):
        for state, action in enumerate(actions):
            right, last = action == cliff.right[state], state == length - 1
            after = min(state + 1, length - 1)
            expected.append((state, action, after, float(right and last), last or not right))
            if not right:
                break
    found = rows_of(cliff)
    assert len(found) == cliff.size == 2 ** (length + 1) - 2
    assert sorted(found) == sorted(expected)


def test_sequences_come_in_an_order_that_the_seed_rules():
    cliff = Cliffwalk(5)
    first, second, other = (
        rows_of(cliff, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)
    )
    assert first == second != other
    # A sequence stays in one piece: after a step that goes on comes the next state.
    for now, then in itertools.pairwise(first):
        assert then[0] == (0 if now[4] else now[0] + 1)


@pytest.mark.parametrize("features", ["tabular", "linear"])
def test_values_learn_as_a_plain_loop_does(features):
    cliff = Cliffwalk(4)
    values = CliffwalkValues(cliff, features=features, generator=torch.Generator().manual_seed(3))
    first = torch.randn(2, 5, generator=torch.Generator().manual_seed(3)).mul(0.1).double()
    weights, bias = first[:, :4].clone(), first[:, 4].clone() * (features == "linear")
    for state, action, after, reward, end in rows_of(cliff, torch.Generator().manual_seed(4)):
        q = weights + bias.unsqueeze(1)
        error = reward + (0.0 if end else 0.75 * float(q[:, after].max())) - float(q[action, state])
        weights[action, state] += 0.25 * error
        bias[action] += 0.25 * error * (features == "linear")
        change = values.error_after((state, action, after, reward, end))
        assert values.learn(state, action, after, reward, end) == pytest.approx(error, abs=1e-6)
        assert values.error == pytest.approx(change, abs=1e-12)
    found = torch.tensor(values.q, dtype=torch.double)
    assert torch.allclose(found, weights + bias.unsqueeze(1), atol=1e-6)
    truth = torch.tensor(
        [[v * (a == r) for v, r in zip(cliff.values, cliff.right, strict=True)] for a in (0, 1)]
    )
    assert values.error == pytest.approx(float((found - truth).square().mean()), abs=1e-12)


@pytest.mark.parametrize(
    ("method", "settings"),
    [("per", {}), ("rank_per", {}), ("mpfa_per", {"signals": ["reward", "td_error"]})],
)
def test_priorities_save_updates(method, settings):
    cliff = Cliffwalk(7)

    def updates(name, batch_size, **more):
        generator = torch.Generator().manual_seed(0)
        replay = make_replay(
            name, capacity=cliff.size, batch_size=batch_size, generator=generator, **more
        )
        return updates_to_convergence(cliff, replay.buffer)

    found = updates(method, 4, eps=1e-3, **settings)
    assert found < updates("uniform", 64) / 2


class Uniform(SignalSampler):
    """Knows the priorities and does not use them."""

    def _sample_slots(self, size: int, batch_size: int) -> tuple[Tensor, Tensor]:
        return self._uniform(size, batch_size), torch.ones(batch_size)


class Deaf(SignalSampler):
    """Never takes note of a signal."""

    def update_signals(self, index, signals, **kwargs):
        return 0


class Reversed(SignalSampler):
    """Samples what has the least priority most often."""

    def _leaf(self, priority: Tensor) -> Tensor:
        return super()._leaf(1.0 / priority)


@pytest.mark.parametrize("kind", [SignalSampler, RankPERSampler])
def test_a_sampler_that_works_passes_the_check(kind):
    check_prioritization(lambda capacity: kind(capacity, 0.6, 0.4, 1e-3), seeds=1)


@pytest.mark.parametrize("broken", [Uniform, Deaf, Reversed])
def test_a_broken_sampler_fails_the_check(broken):
    with pytest.raises(AssertionError, match="at most half"):
        check_prioritization(lambda capacity: broken(capacity, 0.6, 0.4, 1e-3), length=6, seeds=1)


def test_what_does_not_converge_is_infinite():
    cliff = Cliffwalk(4)
    replay = make_replay("uniform", capacity=cliff.size, batch_size=4)
    assert updates_to_convergence(cliff, replay.buffer, limit=20) == math.inf


def test_a_buffer_that_is_not_empty_is_rejected():
    cliff = Cliffwalk(3)
    replay = make_replay("per", capacity=cliff.size, batch_size=1)
    replay.buffer.extend(cliff.transitions())
    with pytest.raises(ValueError, match="empty"):
        updates_to_convergence(cliff, replay.buffer)
    with pytest.raises(ValueError, match="features"):
        CliffwalkValues(cliff, features="deep")
