"""Registered signals outside of the scripts: a method names them, and ``run_updates`` has them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_mpfa import ActorCritic, make_actor, make_critic, make_replay, run_updates
from torchrl_mpfa.methods import (
    METHODS,
    OwnSignals,
    Scaled,
    loss_options,
    register_signal,
)


class Counted:
    """A signal that knows the batches that it was asked for, each by itself."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def __call__(self, learner: object, batch: TensorDictBase) -> torch.Tensor:
        self.sizes.append(len(batch))
        return batch["observation"].norm(dim=-1)


@pytest.fixture
def registered() -> None:
    register_signal("size", Counted)
    METHODS["mine"] = Scaled("mine", signals=["td_error", "size"])


@pytest.mark.usefixtures("registered")
def test_registered_signal_is_written_for_each_batch_of_a_round() -> None:
    replay = make_replay("mine", capacity=64, batch_size=16)
    ended = torch.zeros(64, 1, dtype=torch.bool)
    after = {"observation": torch.rand(64, 5), "reward": torch.rand(64, 1)}
    rows = {
        "observation": torch.rand(64, 5),
        "action": torch.rand(64, 2),
        "next": {**after, "done": ended, "terminated": ended.clone()},
    }
    replay.buffer.extend(TensorDict(rows, [64]))
    assert loss_options("mine")["signals"] == ["td_error"]
    learner = ActorCritic(make_actor(5, 2), make_critic(5, 2), **loss_options("mine"))
    own = OwnSignals(replay.signals)
    run_updates(replay.buffer, learner, updates=4, prepare=own.before(learner))
    assert own._functions["size"].sizes == [16] * 4
    stored = replay.buffer.distributions()["size"]
    sampled = stored.isfinite()
    assert sampled.any()
    want = replay.buffer[:]["observation"].norm(dim=-1)
    torch.testing.assert_close(stored[sampled].float(), want[sampled])


@pytest.mark.usefixtures("registered")
def test_registered_class_makes_an_object_for_each_run() -> None:
    one, other = OwnSignals(["size"]), OwnSignals(["size"])
    assert one._functions["size"] is not other._functions["size"]
    assert len(OwnSignals(["td_error"])) == 0
    batch = TensorDict({"observation": torch.rand(2, 3, requires_grad=True)}, [2])
    one.write(None, batch)
    assert not batch["signals", "size"].requires_grad
