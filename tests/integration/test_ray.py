"""The replay of a method in a process of its own: what is sampled, comes back, and is saved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from tests.methods.replays import make_transitions
from tests.mpfa.transitions import same
from torchrl_mpfa.integrations.ray import (
    MethodReplayBuffer,
    RaySignalReplayBuffer,
    make_ray_replay,
)
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods import make_replay as make_local_replay
from training.run.updates import ReplayHistory

CAPACITY = 64


def method(name: str) -> Any:
    return replace(METHODS[name], capacity=CAPACITY, batch_size=16)


def signals(count: int, *, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    names = ("td_error", "action_gradient")
    values = {name: 3.0 * torch.rand(count, generator=generator) for name in names}
    return TensorDict(values, [count])


def test_buffer_made_of_settings_equals_that_of_the_method() -> None:
    generator = torch.Generator().manual_seed(3)
    local = make_local_replay(method("mpfa_per"), generator=generator).buffer
    made = MethodReplayBuffer(method("mpfa_per"), seed=3)
    for _ in range(2):
        batches = []
        for buffer in (local, made):
            buffer.extend(make_transitions(40))
            buffer.anneal(0.7, 0.5)
            batch = buffer.sample()
            batch["signals"] = signals(16)
            buffer.update_tensordict_priority(batch)
            batches.append(batch)
        assert (batches[0] == batches[1]).all()
    assert local.stats() == made.stats()
    assert made.sampler.beta == 0.7
    assert made.rewards().shape == (CAPACITY,)


def test_seed_of_a_buffer_leaves_the_global_generator_unchanged() -> None:
    before = torch.get_rng_state()
    MethodReplayBuffer(method("mpfa_per"), seed=3)
    assert torch.get_rng_state().equal(before)


def test_histograms_of_a_remote_buffer_are_read_from_it() -> None:
    here = MethodReplayBuffer(method("mpfa_per"), seed=3)
    here.extend(make_transitions(40))
    # Stands in for the process: nothing else of the buffer is in this one.
    elsewhere = object.__new__(RaySignalReplayBuffer)
    elsewhere._client = here
    histories = ReplayHistory(), ReplayHistory()
    for history, buffer in zip(histories, (here, elsewhere), strict=True):
        history.add(0, buffer)
    known, found = (history.state_dict() for history in histories)
    assert sorted(found) == ["priority", "reward", "weight"]
    assert same(found, known)


def test_method_that_reads_its_buffer_cannot_be_remote() -> None:
    assert {name for name in METHODS if not METHODS[name].remote} == {
        "her",
        "la3p",
        "reaper",
        "ref_er",
    }
    with pytest.raises(ValueError, match="'la3p' needs its buffer in the process that learns"):
        make_ray_replay(METHODS["la3p"])


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    ray = pytest.importorskip("ray", reason="an extra: pip install 'torchrl-mpfa[ray]'")
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    yield ray
    ray.shutdown()


@pytest.mark.slow
@pytest.mark.usefixtures("cluster")
def test_remote_buffer_samples_by_eq_8_and_leaves_late_signals_out() -> None:
    per = method("per")
    buffer = make_ray_replay(per, seed=1).buffer
    try:
        one, other = buffer.clients(2)
        slots = torch.cat([one.extend(make_transitions(24)), other.extend(make_transitions(40))])
        assert slots.tolist() == list(range(CAPACITY))
        batch = buffer.sample()
        known = signals(CAPACITY)
        given = TensorDict({"index": slots, "signals": known}, [CAPACITY])
        buffer.update_tensordict_priority(given)

        # Eq. (8), of priorities that are the absolute TD error and eps.
        priority = (known["td_error"].double() + per.eps) ** per.alpha
        drawn = torch.cat([buffer.sample(2_000)["index"] for _ in range(10)])
        counts = torch.bincount(drawn, minlength=CAPACITY)
        expected = len(drawn) * priority / priority.sum()
        assert chisquare(counts.numpy(), expected.numpy()).pvalue > 1e-3
        assert chisquare(counts.numpy()).pvalue < 1e-9

        # What was overwritten since it was sampled, by whomever, keeps what it has.
        batch = buffer.sample()
        one.extend(make_transitions(CAPACITY, seed=5))
        batch["signals"] = signals(16, seed=6)
        before = buffer.state_dict()["_storage"]
        buffer.update_tensordict_priority(batch, batches=1)
        assert buffer.stats()["stale_updates"] == len(batch)
        assert same(buffer.state_dict()["_storage"], before)

        # Saved there, it goes on here.
        local = make_local_replay(per).buffer
        local.load_state_dict(buffer.state_dict())
        assert (local.sample() == buffer.sample()).all()
        assert torch.equal(local.rewards(), buffer.rewards())
        assert same(buffer.distributions(), local.distributions())
    finally:
        buffer.shutdown()
