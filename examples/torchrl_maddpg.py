"""TorchRL's MADDPG with our replay: three robots on a plane learn to meet.

Each robot has a reward, a TD error and a slope of its own. The sampler makes one priority of a
transition out of them, by ``agents="max"`` or ``"mean"``.

python examples/torchrl_maddpg.py               half a minute
python examples/torchrl_maddpg.py --agents mean
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, Composite, LazyTensorStorage, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import AdditiveGaussianModule, MultiAgentMLP
from torchrl.objectives import DDPGLoss, SoftUpdate

import torchrl_mpfa as mpfa

ROBOTS, WORLDS, STEPS = 3, 16, 25
CAPACITY, BATCH_SIZE = 50_000, 128
GROUP = "agents"
OBSERVATION, ACTION, REWARD = ((GROUP, name) for name in ("observation", "action", "reward"))
PAID = ("next", *REWARD)
DONE, TERMINATED, VALUE = ((GROUP, name) for name in ("done", "terminated", "state_action_value"))


class Meeting(EnvBase):
    """Robots that see where they and the others are, and are paid for being near all others."""

    def __init__(self) -> None:
        super().__init__(batch_size=[WORLDS])
        shape, ends = [WORLDS, ROBOTS], Categorical(2, (WORLDS, ROBOTS, 1), dtype=torch.bool)
        seen = Composite(observation=Unbounded((*shape, 2 * ROBOTS)), shape=shape)
        self.observation_spec = Composite({GROUP: seen}, shape=[WORLDS])
        acts = Composite(action=Bounded(-1.0, 1.0, (*shape, 2)), shape=shape)
        self.action_spec = Composite({GROUP: acts}, shape=[WORLDS])
        paid = Composite(reward=Unbounded((*shape, 1)), shape=shape)
        self.reward_spec = Composite({GROUP: paid}, shape=[WORLDS])
        over = Composite(done=ends, terminated=ends.clone(), shape=shape)
        self.done_spec = Composite({GROUP: over}, shape=[WORLDS])

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        # All worlds begin and end together.
        self.place = 2.0 * torch.rand(WORLDS, ROBOTS, 2) - 1.0
        self.count = 0
        return self._seen()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.place = (self.place + 0.2 * tensordict[ACTION]).clamp(-1.0, 1.0)
        self.count += 1
        apart = torch.cdist(self.place, self.place).sum(-1, keepdim=True) / (ROBOTS - 1)
        return self._seen().set(REWARD, -apart)

    def _seen(self) -> TensorDict:
        """Return what robots see: their own place, and the others as seen from there."""
        offsets = self.place.unsqueeze(1) - self.place.unsqueeze(2)
        others = ~torch.eye(ROBOTS, dtype=torch.bool)
        offsets = offsets[:, others].view(WORLDS, ROBOTS, -1)
        over = torch.full((WORLDS, ROBOTS, 1), self.count >= STEPS)
        agents = {"observation": torch.cat([self.place, offsets], -1), "done": over}
        agents["terminated"] = torch.zeros_like(over)
        return TensorDict({GROUP: TensorDict(agents, [WORLDS, ROBOTS])}, [WORLDS])

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            torch.manual_seed(seed)


class JointCritic(nn.Module):
    """Q of each robot, by what all robots see and do."""

    def __init__(self) -> None:
        super().__init__()
        self.network = _network(2 * ROBOTS + 2, 1, centralized=True)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return Q, shape ``[B, ROBOTS, 1]``."""
        value: Tensor = self.network(torch.cat([observation, action], -1))
        return value


def _network(inputs: int, outputs: int, *, centralized: bool) -> MultiAgentMLP:
    return MultiAgentMLP(
        inputs, outputs, ROBOTS, centralized=centralized, share_params=True, depth=2, num_cells=64
    )


def main(arguments: Sequence[str] | None = None) -> list[float]:
    """Train, print the mean distance, and return that of each hundred steps [m]."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--actions", type=int, default=16_000, help="of all worlds together")
    parser.add_argument("--agents", choices=["max", "mean"], default="max")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)

    env = Meeting()
    layers = nn.Sequential(_network(2 * ROBOTS, 2, centralized=False), nn.Tanh())
    actor = TensorDictModule(layers, [OBSERVATION], [ACTION])
    critic = TensorDictModule(JointCritic(), [OBSERVATION, ACTION], [VALUE])
    noise = AdditiveGaussianModule(env.full_action_spec, action_key=ACTION, sigma_init=0.3)
    collector = Collector(
        env,
        TensorDictSequential(actor, noise),
        frames_per_batch=WORLDS * STEPS,
        total_frames=options.actions // (WORLDS * STEPS) * WORLDS * STEPS,
        auto_register_policy_transforms=True,
    )
    loss = DDPGLoss(actor, critic, delay_actor=True, loss_function="l2")
    loss.set_keys(state_action_value=VALUE, reward=REWARD, done=DONE, terminated=TERMINATED)
    loss.make_value_estimator(gamma=0.9)
    targets = SoftUpdate(loss, tau=0.02)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

    sampler = mpfa.MPFASampler(positive_above=-0.5, reward_key=PAID, agents=options.agents)
    buffer = mpfa.SignalReplayBuffer(
        storage=LazyTensorStorage(CAPACITY), sampler=sampler, batch_size=BATCH_SIZE
    )
    distances = []
    for steps in collector:  # [WORLDS, STEPS]
        buffer.extend(steps.reshape(-1))
        distances.append(-float(steps[PAID].mean()))
        for _ in range(STEPS):
            batch = buffer.sample()
            # TorchRL wants a weight for each robot.
            weight = batch["priority_weight"].unsqueeze(-1).expand(-1, ROBOTS)
            values = loss(batch.set("priority_weight", weight))
            mpfa.write_signals(batch, loss)
            (values["loss_actor"] + values["loss_value"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            targets.step()
            buffer.update_tensordict_priority(batch)
    collector.shutdown()
    print(f"mean distance [m]: {distances[0]:.2f} at first, {distances[-1]:.2f} in the end")
    return distances


if __name__ == "__main__":
    main()
