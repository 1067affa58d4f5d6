"""TorchRL's own SAC on many robots, in the loop of TorchRL's SAC script.

    python examples/torchrl_sac.py                          100,000 actions, some five minutes
    python examples/torchrl_sac.py --replay mpfa --world rooms --actions 50000

The policy goes to ``policy.npz`` in --output, runs/torchrl-sac by default, where
``examples/evaluate.py`` and ``examples/export.py`` read it.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from mpfa_envs import ROOMS_TASK, Policy, make_navigation_env, save_policy
from torchrl_mpfa import MPFASampler, SignalReplayBuffer, SignalSACLoss, SignalTensorStorage

HIDDEN = [128, 128]
BATCH_SIZE = 256
CAPACITY = 100_000
RANDOM_ACTIONS = 2_048
LEARNING_RATE = 3e-4
ACTIONS_PER_UPDATE = 4
"""Actions of all robots together."""
STEPS = 4
"""Actions of each robot between two rounds of updates."""
SENSES = {name: ROOMS_TASK[name] for name in ("physics", "memory", "clearance")}
"""Arguments of the environment that a policy needs wherever it drives."""


def make_networks(env: EnvBase) -> tuple[MLP, ProbabilisticActor, ValueOperator]:
    """The network of means and scales, the actor that samples from it, and the critic."""
    sizes = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    network = MLP(
        in_features=sizes[0],
        out_features=2 * sizes[1],
        num_cells=HIDDEN,
        activation_class=nn.ReLU,
    )
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network, NormalParamExtractor()),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"tanh_loc": False},
    )
    critic = ValueOperator(
        MLP(in_features=sum(sizes), out_features=1, num_cells=HIDDEN, activation_class=nn.ReLU),
        in_keys=["observation", "action"],
    )
    return network, actor, critic


def make_buffer(replay: str) -> TensorDictReplayBuffer:
    """TorchRL's uniform replay, or MPFA-PER, which needs the loss that writes its signals."""
    if replay == "uniform":
        return TensorDictReplayBuffer(storage=LazyTensorStorage(CAPACITY), batch_size=BATCH_SIZE)
    return SignalReplayBuffer(
        storage=SignalTensorStorage(CAPACITY), sampler=MPFASampler(CAPACITY), batch_size=BATCH_SIZE
    )


def train(env: EnvBase, *, replay: str, actions: int) -> MLP:
    """Train, print the success of the last hundred episodes, and return the policy's network."""
    network, actor, critic = make_networks(env)
    loss = {"uniform": SACLoss, "mpfa": SignalSACLoss}[replay](actor, critic, loss_function="l2")
    loss.make_value_estimator(gamma=0.99)
    targets = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LEARNING_RATE)
    buffer = make_buffer(replay)
    collector = Collector(
        env,
        actor,
        frames_per_batch=STEPS * env.batch_size.numel(),
        total_frames=actions,
        init_random_frames=RANDOM_ACTIONS,
        auto_register_policy_transforms=True,
    )
    outcomes: deque[bool] = deque(maxlen=100)
    collected = reported = 0
    for steps in collector:  # [robots, STEPS]
        buffer.extend(steps.reshape(-1))
        collected += steps.numel()
        after = steps["next"]
        outcomes.extend(after["info", "success"][after["done"]].tolist())
        if collected >= RANDOM_ACTIONS:
            for _ in range(steps.numel() // ACTIONS_PER_UPDATE):
                batch = buffer.sample()
                losses = loss(batch)
                (losses["loss_qvalue"] + losses["loss_actor"] + losses["loss_alpha"]).backward()
                optimizer.step()
                optimizer.zero_grad()
                targets.step()
                buffer.update_tensordict_priority(batch)  # Nothing, where replay is uniform.
            collector.update_policy_weights_()
        if collected >= reported + 5_000:
            reported = collected
            success = sum(outcomes) / max(len(outcomes), 1)
            print(f"{collected:7} actions: success {success:.2f}", flush=True)
    collector.shutdown()
    return network


def policy_of(network: MLP, *, card: dict[str, object]) -> Policy:
    """The greedy policy, the tanh of the means, which needs no PyTorch."""
    *hidden, last = network
    means = nn.Linear(last.in_features, last.out_features // 2)
    means.load_state_dict({k: v[: means.out_features] for k, v in last.state_dict().items()})
    return Policy.from_layers([*hidden, means, nn.Tanh()], card=card, env_arguments=SENSES)


def main(arguments: Sequence[str] | None = None) -> Path:
    """Train; return the file of the policy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--replay", choices=["uniform", "mpfa"], default="uniform")
    parser.add_argument("--world", default="mixed", help="a generator or a world (default: mixed)")
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--actions", type=int, default=100_000, help="of all robots together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/torchrl-sac"))
    options = parser.parse_args(arguments)
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)  # With networks this small a second one gains nothing.
    env = make_navigation_env(
        num_envs=options.robots,
        info_keys=["success"],
        seed=options.seed,
        **{**ROOMS_TASK, "world": options.world},
    )
    network = train(env, replay=options.replay, actions=options.actions)
    card = {
        "learner": "torchrl sac",
        "method": options.replay,
        "curriculum": options.world,
        "seed": options.seed,
        "steps": options.actions,
    }
    options.output.mkdir(parents=True, exist_ok=True)
    file = save_policy(policy_of(network, card=card), options.output)
    print(f"written: {file}")
    return file


if __name__ == "__main__":
    main()
