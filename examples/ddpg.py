"""DDPG with MPFA-PER on sixteen robots, all of it on one page: parts, loop, evaluation, policy.

    python examples/ddpg.py                                      about a minute
    python examples/ddpg.py --seed 1 --out runs/ddpg-1
    python examples/evaluate.py runs/ddpg --worlds mazes:test    drives the policy that it wrote

``train.py`` is this with settings, checkpoints, records, and other methods and learners.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from tqdm import tqdm

import torchrl_mpfa as mpfa
from mpfa_envs import (
    ROOMS_TASK,
    Policy,
    TaskConfig,
    evaluate,
    make_navigation_env,
    save_policy,
)
from mpfa_envs.driver import Filtered

SENSES: dict[str, Any] = {
    **{name: ROOMS_TASK[name] for name in ("robot", "physics", "memory")},
    # Of the radius: a robot that can stop must know how near it is.
    "closeness_distance": 0.18,
}
"""What a policy must find again wherever it drives: how the robot moves and senses."""
TASK = {**ROOMS_TASK, **SENSES}
ROBOTS = 16
STEPS = 8
"""Actions of each robot between two rounds of updates."""
ACTIONS_PER_UPDATE = 4
"""Actions of all robots together."""
CAPACITY = 100_000
BATCH_SIZE = 256
LEARNING_RATE = 3e-4
LIMIT = 1.5
"""Output before the tanh at which the wheels are at full speed."""
EVALUATE_EVERY = 5_000
"""Actions of all robots between two evaluations."""
EPISODES = 100
"""Episodes of an evaluation."""


def main(arguments: Sequence[str] | None = None) -> Path:
    """Train; return the file of the policy that did best in the validation worlds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--actions", type=int, default=40_000, help="of all robots together")
    parser.add_argument("--out", type=Path, default=Path("runs/ddpg"), help="folder of the policy")
    options = parser.parse_args(arguments)
    if options.actions < 1:
        parser.error(f"--actions must be at least 1, got {options.actions}")
    options.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)  # With networks this small a second one gains nothing.
    torch.set_flush_denormal(True)  # Tiny numbers would slow a CPU down.

    # Sixteen robots, each in a new room in every episode. What brings them closer to the goal along
    # the shortest path is rewarded.
    env = make_navigation_env(**TASK, num_envs=ROBOTS, info_keys=["success"], seed=options.seed)
    size = env.observation_spec["observation"].shape[-1]

    # MPFA-PER: three signals of a transition (reward, TD error, action gradient), one priority.
    buffer = mpfa.SignalReplayBuffer(
        storage=mpfa.SignalTensorStorage(CAPACITY),
        sampler=mpfa.MPFASampler(CAPACITY),
        batch_size=BATCH_SIZE,
    )
    # Left and right are alike, front and rear too: samples are shown in these mirrors by chance.
    task = TaskConfig(**SENSES)
    buffer.append_transform(task.make_mirror())

    # DDPG. The penalty keeps actions out of the flat ends of the tanh, where nothing is learned;
    # where it begins the wheels are at full speed. Delay and noise are those of TD3.
    actor = mpfa.make_actor(size, 2, width=64, saturation_limit=LIMIT)
    learner = mpfa.ActorCritic(
        actor,
        mpfa.make_critic(size, 2, width=64),
        critics=1,
        gamma=0.95,
        reward_scale=0.1,
        saturation_penalty=1.0,
        saturation_limit=LIMIT,
        policy_noise=0.4,
        noise_clip=0.8,
        bounds=(-1.0, 1.0),
        policy_delay=2,
        actor_lr=LEARNING_RATE,
        critic_lr=LEARNING_RATE,
        tau=0.005,
    )

    falling = max(int(0.4 * options.actions), 1)
    noise = mpfa.GaussianNoise(
        env.action_spec, sigma_init=1.0, sigma_end=0.2, annealing_num_steps=falling
    )
    frames = ROBOTS * STEPS
    collector = Collector(
        env,
        TensorDictSequential(actor, noise, filter_of(task)),
        frames_per_batch=frames,
        total_frames=-(-options.actions // frames) * frames,  # Whole batches.
        auto_register_policy_transforms=True,
    )

    collected, best, most = 0, policy_of(actor), 0.0
    outcomes: deque[bool] = deque(maxlen=100)
    with tqdm(desc="train", total=options.actions, unit="action", smoothing=0.05) as bar:
        for steps in collector:  # [ROBOTS, STEPS]
            buffer.extend(steps.reshape(-1))
            if len(buffer) >= BATCH_SIZE:
                # Sample, learn, fuse the signals of what was sampled, boost, decay.
                mpfa.run_updates(buffer, learner, updates=steps.numel() // ACTIONS_PER_UPDATE)
            collected += steps.numel()
            done = min(collected / options.actions, 1.0)
            noise.step(steps.numel())
            buffer.anneal(beta=0.4 + 0.6 * done, fraction=done)  # As in PER, beta rises to 1.
            learner.anneal(1.0 - done)

            if collected % EVALUATE_EVERY < steps.numel() or done == 1.0:
                policy = policy_of(actor, seed=options.seed, steps=collected)
                success = success_of(policy, "mixed:validation")
                if success >= most:
                    best, most = policy, success
            outcomes.extend(steps["next", "info", "success"][steps["next", "done"]].tolist())
            lately = sum(outcomes) / max(len(outcomes), 1)
            bar.set_postfix_str(f"success {lately:.0%}, without noise {most:.0%} at best")
            bar.update(min(collected, options.actions) - bar.n)
    collector.shutdown()

    print(f"success in validation worlds, by which the policy was chosen: {most:.0%}")
    print(f"success in test worlds: {success_of(best, 'mixed:test'):.0%}")
    file = save_policy(best, options.out)
    print(f"written: {file}")
    return file


def policy_of(actor: TensorDictModule, **card: object) -> Policy:
    """A copy of the actor without noise, which needs no PyTorch."""
    return Policy.from_layers(
        actor.module.layers(),
        card={"learner": "ddpg", "method": "mpfa_per", "filter": True, **card},
        env_arguments=SENSES,
    )


def filter_of(task: TaskConfig) -> TensorDictModule:
    """The filter that keeps robots off what they see, as the last part of a policy."""
    keep_off = task.make_filter()

    def carried_out(observation: Tensor, action: Tensor) -> Tensor:
        return torch.from_numpy(keep_off(observation.numpy(), action.numpy()))

    return TensorDictModule(carried_out, in_keys=["observation", "action"], out_keys=["action"])


def success_of(policy: Policy, worlds: str) -> float:
    """Share of the episodes in these worlds that reach the goal, behind the filter."""
    driver = Filtered(policy, TaskConfig(**SENSES).make_filter())
    results = evaluate(driver, worlds, episodes=EPISODES, **SENSES)
    return sum(each.success for each in results) / len(results)


if __name__ == "__main__":
    main()
