"""Gradients and signals of an update against TorchRL's DDPG loss, forward and backward."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from benchmarks.speed.replay import ACTION_SIZE, BATCH_SIZE, OBSERVATION_SIZE, make_transitions
from benchmarks.speed.timing import Call, Entry, compare
from torchrl_mpfa import ActorCritic, make_actor, make_critic

WIDTH = 256
GAMMA = 0.99


def make_own_step(learner: ActorCritic, batch: TensorDict) -> Call:
    """Forward and backward pass of a learner, with its signals."""

    def step() -> None:
        learner.optimizer.zero_grad()
        learner._differentiate(batch.copy(), "both", None)

    return step


def make_step(loss: DDPGLoss, batch: TensorDict) -> Call:
    """Forward and backward pass of TorchRL's loss."""
    SoftUpdate(loss, tau=0.01)  # Never called here; TorchRL warns of a loss without one.
    parameters = list(loss.parameters())

    def step() -> None:
        for parameter in parameters:
            parameter.grad = None
        # A copy of the keys alone: what the loss writes must not be there at the next call.
        losses = loss(batch.copy())
        (losses["loss_value"] + losses["loss_actor"]).backward()

    return step


def measure(*, quick: bool, name: str = "loss") -> list[Entry]:
    """Compare the losses on one batch with importance weights; ours has the ratio."""
    torch.manual_seed(0)
    batch = make_transitions(BATCH_SIZE)
    batch.set("priority_weight", torch.rand(BATCH_SIZE) * 0.9 + 0.1)
    sizes = OBSERVATION_SIZE, ACTION_SIZE
    actor, critic = make_actor(*sizes, width=WIDTH), make_critic(*sizes, width=WIDTH)
    ours = ActorCritic(actor, critic, gamma=GAMMA)
    actor, critic = make_actor(*sizes, width=WIDTH), make_critic(*sizes, width=WIDTH)
    stock = DDPGLoss(actor, critic, delay_actor=True)
    stock.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    return compare(name, make_own_step(ours, batch), make_step(stock, batch), quick=quick)
