"""The replay parts in TorchRL's own ``DDPGTrainer``, on the navigation task. Runs in seconds.

python examples/torchrl_trainer.py
python examples/torchrl_trainer.py --frames 20000 --seed 1
python examples/torchrl_trainer.py --world mixed --num-envs 20    many robots, new worlds
"""

from __future__ import annotations

import argparse
import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, SoftUpdate
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms import DDPGTrainer

from mpfa_envs import make_navigation_env
from torchrl_mpfa import (
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
    make_actor,
    make_critic,
)
from torchrl_mpfa.integrations.trainer import PriorityStepper


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of what is collected, kept and learned."""

    frames: int = 2_000
    frames_per_batch: int = 200
    steps_per_batch: int = 50
    capacity: int = 100_000
    batch_size: int = 128
    width: int = 64


def make_env(*, world: str, num_envs: int | None, seed: int) -> EnvBase:
    """The navigation task, with the sum of rewards that the trainer logs under its own name."""
    env = make_navigation_env(
        world, num_envs=num_envs, physics="kinematic", info_keys=(), seed=seed
    )
    return TransformedEnv(env, RewardSum(in_keys=["reward"], out_keys=["reward_sum"]))


def make_trainer(
    sizes: Sizes,
    *,
    world: str = "A",
    num_envs: int | None = None,
    seed: int = 0,
    progress_bar: bool = True,
) -> DDPGTrainer:
    """Make a trainer; robots come without a batch dimension if ``num_envs`` is None."""
    torch.manual_seed(seed)
    env = make_env(world=world, num_envs=num_envs, seed=seed)
    spec = env.action_spec_unbatched  # Of one robot, whatever their number.
    actor = make_actor(24, 2, action_spec=spec, width=sizes.width)
    critic = make_critic(24, 2, width=sizes.width)
    # The trainer copies the loss's actor over the collector's policy: both have the noise, which
    # the loss leaves out when it calls the actor.
    noise = AdditiveGaussianModule(spec, sigma_init=0.3, sigma_end=0.3)
    policy = TensorDictSequential(actor, noise)
    loss = DDPGLoss(policy, critic, delay_actor=True)
    loss.make_value_estimator(gamma=0.99)
    buffer = SignalReplayBuffer(
        storage=SignalTensorStorage(sizes.capacity),
        sampler=MPFASampler(sizes.capacity),
        batch_size=sizes.batch_size,
    )
    return DDPGTrainer(
        collector=Collector(
            env,
            policy,
            frames_per_batch=sizes.frames_per_batch,
            total_frames=sizes.frames,
            auto_register_policy_transforms=True,
        ),
        total_frames=sizes.frames,
        frame_skip=1,
        optim_steps_per_batch=sizes.steps_per_batch,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
        target_net_updater=SoftUpdate(loss, tau=0.01),
        replay_buffer=buffer,
        progress_bar=progress_bar,
        seed=seed,
        log_interval=sizes.frames_per_batch,
    )


def report(trainer: Trainer) -> list[str]:
    """Report frames, steps, updates of priorities, and shares in the priorities, line by line."""
    buffer, statistics = trainer.replay_buffer, trainer.replay_buffer.stats()
    return [
        f"frames collected        {trainer.collected_frames}",
        f"transitions in replay   {len(buffer)}, sampled by {type(buffer.sampler).__name__}",
        f"steps of the optimizer  {trainer._optim_count}",
        f"updates of priorities   {trainer.optimization_stepper.priority_updates}",
        *(
            f"signal {name:16} weight {weight:.3f}, share of the priority "
            f"{statistics[f'share/{name}']:.3f}"
            for name, weight in buffer.sampler.weights.items()
        ),
    ]


def silence() -> None:
    """Keep the console to the progress bar and the report."""
    # That the trainer is new, and that stages which it uses itself will go.
    warnings.filterwarnings("ignore", message=".*experimental/prototype feature")
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"torchrl\..*")
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def close_progress_bar(trainer: Trainer) -> None:
    """Finish the line of the progress bar; TorchRL leaves it open until Python ends."""
    if trainer.progress_bar:
        trainer._pbar.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and say what happened."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=Sizes.frames)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", default="A", help="a world or a generator (default: A)")
    parser.add_argument("--num-envs", type=int, help="robots (default: one, not in a batch)")
    parser.add_argument("--no-progress", action="store_true", help="show no progress bar")
    options = parser.parse_args(arguments)
    silence()
    torch.set_num_threads(1)
    trainer = make_trainer(
        Sizes(frames=options.frames),
        world=options.world,
        num_envs=options.num_envs,
        seed=options.seed,
        progress_bar=not options.no_progress,
    )
    PriorityStepper().register(trainer)  # The step, and then the priorities of its batch.
    trainer.train()
    close_progress_bar(trainer)
    print(*report(trainer), sep="\n")


if __name__ == "__main__":
    main()
