"""TorchRL's own DDPG with our replay: sampler, buffer and three lines of the loop are ours.

python examples/torchrl_ddpg.py                               about a minute
python examples/torchrl_ddpg.py --world mixed --actions 40000
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, SoftUpdate

import torchrl_mpfa as mpfa
from mpfa_envs import make_navigation_env

ROBOTS, STEPS = 16, 8
CAPACITY, BATCH_SIZE = 100_000, 256


def main(arguments: Sequence[str] | None = None) -> mpfa.SignalReplayBuffer:
    """Train, print how it went, and return the replay."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", default="A", help="a map, a world file or a generator")
    parser.add_argument("--actions", type=int, default=20_000, help="of all robots together")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)  # With networks this small a second one gains nothing.

    env = make_navigation_env(
        options.world,
        num_envs=ROBOTS,
        physics="kinematic",
        progress="shortest_path",
        info_keys=["success"],
        seed=options.seed,
    )
    actor, critic = mpfa.make_actor(24, 2, width=64), mpfa.make_critic(24, 2, width=64)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.5, sigma_end=0.2)
    collector = Collector(
        env,
        TensorDictSequential(actor, noise),
        frames_per_batch=ROBOTS * STEPS,
        total_frames=max(options.actions // (ROBOTS * STEPS), 1) * ROBOTS * STEPS,
        auto_register_policy_transforms=True,
    )

    loss = DDPGLoss(actor, critic, delay_actor=True, loss_function="l2")
    loss.make_value_estimator(gamma=0.95)
    targets = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)

    # Ours: a sampler and a buffer. The storage may be any of TorchRL's.
    buffer = mpfa.SignalReplayBuffer(
        storage=LazyTensorStorage(CAPACITY), sampler=mpfa.MPFASampler(), batch_size=BATCH_SIZE
    )
    goals = ends = 0
    for steps in collector:  # [ROBOTS, STEPS]
        buffer.extend(steps.reshape(-1))
        noise.step(steps.numel())
        done = steps["next", "done"]
        goals += int(steps["next", "info", "success"][done].sum())
        ends += int(done.sum())
        if len(buffer) < BATCH_SIZE:
            continue
        for _ in range(steps.numel() // 4):
            batch = buffer.sample()
            values = loss(batch)
            mpfa.write_signals(batch, loss)  # |TD error| and the slope of the critic
            (values["loss_actor"] + values["loss_value"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            targets.step()
            buffer.update_tensordict_priority(batch)  # fusion, boost, decay
    collector.shutdown()

    print(f"episodes {ends}, of which reached the goal {goals / max(ends, 1):.0%}")
    for name, share in buffer.sampler.weights.items():
        print(f"weight of {name:16} {share:.3f}")
    return buffer


if __name__ == "__main__":
    main()
