"""The parts, put together by hand: fill, sample, learn, update, look. Runs in seconds.

python examples/quickstart.py
"""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_mpfa import (
    DDPGLearner,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
    make_actor,
    make_critic,
    make_ddpg_loss,
)


def transitions(count: int) -> TensorDict:
    """Made-up transitions: the reward is high where the first action is near the first feature."""
    observation, action = torch.rand(count, 24), 2 * torch.rand(count, 2) - 1
    reward = 0.5 - (action[:, :1] - observation[:, :1]).abs()
    end = torch.rand(count, 1) < 0.05
    after = {"observation": torch.rand(count, 24), "reward": reward, "done": end, "terminated": end}
    return TensorDict({"observation": observation, "action": action, "next": after}, [count])


def main() -> None:
    """Train for 300 steps and say what the priorities are made of."""
    torch.manual_seed(0)
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(10_000), sampler=MPFASampler(10_000), batch_size=256
    )
    learner = DDPGLearner(make_ddpg_loss(make_actor(24, 2), make_critic(24, 2)), critic_lr=1e-3)
    buffer.extend(transitions(5_000))
    for step in range(300):
        batch = buffer.sample()  # with "index" and "priority_weight"
        losses = learner.update(batch)  # writes |TD error| and the gradient's norm in the batch
        buffer.update_tensordict_priority(batch)  # fuse, boost, decay: Eqs. 12-24
        if step % 100 == 99:
            print(f"step {step + 1}: critic's loss {losses['loss_value'].item():.4f}")
    for name, weight in buffer.sampler.weights.items():
        share = buffer.stats()[f"share/{name}"]
        print(f"{name:16} weight {weight:.3f}, share of the priority {share:.3f}")


if __name__ == "__main__":
    main()
