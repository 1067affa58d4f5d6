"""TD3 with a GRU on sixteen robots that have no map, from prioritized slices of their drives.

    python examples/recurrent_td3.py               about two minutes
    python examples/recurrent_td3.py --forgetful   the same networks, whose memory is always empty

A robot that sees only what is in front of it cannot know that it has been in a pocket before.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from copy import deepcopy

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from tqdm import tqdm

import torchrl_mpfa as mpfa
from mpfa_envs import ROOMS_TASK, Mirror, evaluate, make_navigation_env
from mpfa_envs.driver import Errand, Senses

# The paper's robot sees only the half before it, and cannot stop.
_PAPERS = {"robot": "turtlebot2", "clearance": 0.05, "reward": None}
TASK = {**ROOMS_TASK, **_PAPERS, "world": "bars", "memory": "none"}
ROBOTS = 16
STEPS = 8
"""Actions of each robot between two rounds of updates."""
ACTIONS_PER_UPDATE = 16
"""Actions of all robots together."""
CAPACITY = 96_000
SLICES = 32
"""Slices in a batch."""
LENGTH = 20
"""Steps of a slice."""
WARM_UP = 8
"""Its first steps, by which the memory fills and from which nothing is learned; of a slice that
begins an episode, whose memory was empty in truth, everything is."""
WIDTH = 64
LEARNING_RATE = 5e-4
GAMMA = 0.99
EPISODES = 200
"""Episodes of the evaluation."""


class Memory(nn.Module):
    """Join the observation with a GRU's memory of those before."""

    def __init__(self, size: int, *, forgetful: bool) -> None:
        super().__init__()
        self.gru = nn.GRU(size, WIDTH, batch_first=True)
        self.forgetful = forgetful

    def forward(self, seen: Tensor) -> Tensor:
        """From slices ``[S, L, O]``, each with an empty memory at first, to ``[S, L, O + H]``."""
        rows = seen.flatten(0, 1).unsqueeze(1) if self.forgetful else seen
        return torch.cat((seen, self.gru(rows)[0].reshape(*seen.shape[:2], WIDTH)), -1)

    def step(self, seen: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """One step of several robots: ``[N, O]`` and ``[N, H]`` to ``[N, O + H]``, ``[N, H]``."""
        found = self.gru(seen.unsqueeze(1), state.unsqueeze(0) * (not self.forgetful))[1][0]
        return torch.cat((seen, found), -1), found


class Actor(nn.Module):
    """From what is seen and remembered to the two wheels."""

    def __init__(self, size: int, *, forgetful: bool) -> None:
        super().__init__()
        self.memory = Memory(size, forgetful=forgetful)
        self.head = mpfa.make_actor(size + WIDTH, 2, width=WIDTH).module

    @torch.no_grad()
    def act(self, seen: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Actions of several robots, ``[N, 2]``, and what they remember from now on."""
        known, state = self.memory.step(seen, state)
        return self.head(known)[1], state


class Critics(nn.Module):
    """The two critics of TD3, with one memory."""

    def __init__(self, size: int, *, forgetful: bool) -> None:
        super().__init__()
        self.memory = Memory(size, forgetful=forgetful)
        heads = (mpfa.make_critic(size + WIDTH, 2, width=WIDTH).module for _ in range(2))
        self.heads = nn.ModuleList(heads)

    def values(self, known: Tensor, action: Tensor) -> Tensor:
        """From ``[B, O + H]`` and ``[B, 2]`` to ``[2, B]``."""
        return torch.stack([head(known, action).squeeze(-1) for head in self.heads])


class RecurrentTD3:
    """Fujimoto et al. (2018), with the warm-up of R2D2 (Kapturowski et al., 2019)."""

    def __init__(self, size: int, *, forgetful: bool) -> None:
        self.actor = Actor(size, forgetful=forgetful)
        self.critics = Critics(size, forgetful=forgetful)
        self.targets = deepcopy((self.actor, self.critics))
        self.optimizers = [
            torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)
            for net in (self.actor, self.critics)
        ]
        self.mirror = Mirror()
        self.updates = 0

    def update(self, batch: TensorDictBase) -> Tensor:
        """Learn from slices, write |TD error| to each step; return the numbers of learned steps."""
        # Where each step is: in which slice, and which step of it.
        last = batch["next", "truncated"].squeeze(-1)
        begins = torch.cat((last.new_ones(1), last[:-1])).nonzero().squeeze(1)
        row = last.cumsum(0) - last.long()
        step = torch.arange(len(batch)) - begins[row]
        whole = batch["is_init"].squeeze(-1)[begins]
        learned = ((step >= WARM_UP) | whole[row]).nonzero().squeeze(1)
        batch["signals", "td_error"] = torch.zeros(len(batch))
        if len(learned) == 0:
            return learned

        # One observation more than there are steps; left and right are alike, slice by slice.
        seen = torch.zeros(len(begins), LENGTH + 1, batch["observation"].shape[-1])
        seen[row, step + 1] = batch["next", "observation"]
        seen[row, step] = batch["observation"]
        turned = torch.rand(len(begins)) < 0.5
        seen = torch.where(turned[:, None, None], self.mirror.observation(seen), seen)
        action = torch.where(
            turned[row, None], self.mirror.action(batch["action"]), batch["action"]
        )

        row, step, action = row[learned], step[learned], action[learned]
        after = batch["next"][learned]
        with torch.no_grad():
            actor, critics = self.targets
            next_action = actor.head(actor.memory(seen)[row, step + 1])[1]
            noise = (0.2 * torch.randn_like(next_action)).clamp(-0.5, 0.5)
            next_known = critics.memory(seen)[row, step + 1]
            value = critics.values(next_known, (next_action + noise).clamp(-1, 1)).amin(0)
            reward, end = 0.1 * after["reward"].squeeze(-1), after["terminated"].squeeze(-1)
            target = reward + GAMMA * value * ~end
        known = self.critics.memory(seen)[row, step]
        td_error = target - self.critics.values(known, action)
        self._descend(1, (batch["priority_weight"][learned] * td_error.square().sum(0)).mean())
        batch["signals", "td_error"][learned] = td_error.detach().abs().amax(0)

        self.updates += 1
        if self.updates % 2 == 0:
            raw, chosen = self.actor.head(self.actor.memory(seen)[row, step])
            flat = (raw.abs() - 1.5).clamp(min=0).square().mean()  # Ends of the tanh.
            self._descend(0, flat - self.critics.values(known.detach(), chosen)[0].mean())
            with torch.no_grad():
                for slow, net in zip(self.targets, (self.actor, self.critics), strict=True):
                    for old, new in zip(slow.parameters(), net.parameters(), strict=True):
                        old.lerp_(new, 0.01)
        return learned

    def _descend(self, number: int, loss: Tensor) -> None:
        optimizer = self.optimizers[number]
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 10.0)
        optimizer.step()


class Driving:
    """The robots of an evaluation, each of which remembers its own episode."""

    def __init__(self, actor: Actor) -> None:
        self.actor = actor
        self.states = torch.zeros(64, WIDTH)

    def begin(self, robot: int, errand: Errand) -> None:
        """Forget the episode before."""
        self.states[robot] = 0.0

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """One action for each robot."""
        seen, states = torch.from_numpy(senses.observations), self.states[senses.robots]
        action, self.states[senses.robots] = self.actor.act(seen, states)
        found: NDArray[np.float32] = action.numpy()
        return found


def success_of(actor: Actor, worlds: str) -> float:
    """Share of the episodes in these worlds that reach the goal."""
    arguments = {name: TASK[name] for name in ("physics", "memory", "clearance")}
    results = evaluate(Driving(actor), worlds, episodes=EPISODES, **arguments)
    return sum(each.success for each in results) / len(results)


def main(arguments: Sequence[str] | None = None) -> Actor:
    """Train, and evaluate in worlds that no training saw; return the policy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--actions", type=int, default=40_000, help="of all robots together")
    parser.add_argument("--forgetful", action="store_true", help="the memory is always empty")
    options = parser.parse_args(arguments)
    if options.actions < 1:
        parser.error(f"--actions must be at least 1, got {options.actions}")
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)  # With networks this small a second one gains nothing.
    torch.set_flush_denormal(True)  # Tiny numbers would slow a CPU down.

    env = TransformedEnv(
        make_navigation_env(**TASK, num_envs=ROBOTS, info_keys=["success"], seed=options.seed),
        InitTracker(),
    )
    size = env.observation_spec["observation"].shape[-1]
    buffer = mpfa.SignalReplayBuffer(
        storage=mpfa.SignalTensorStorage(CAPACITY, ndim=2),
        sampler=mpfa.SignalSliceSampler(
            CAPACITY,
            alpha=0.6,
            beta=0.4,
            eps=0.05,
            signals=["td_error"],
            slice_len=LENGTH,
            strict_length=False,  # Short episodes are those that went wrong.
        ),
        batch_size=SLICES * LENGTH,
        dim_extend=1,
    )
    learner = RecurrentTD3(size, forgetful=options.forgetful)

    robots, states, collected = env.reset(), torch.zeros(ROBOTS, WIDTH), 0
    outcomes: deque[bool] = deque(maxlen=200)
    with tqdm(desc="train", total=options.actions, unit="action", smoothing=0.05) as bar:
        while collected < options.actions:
            done = collected / options.actions
            steps, robots, states = drive(
                env, learner.actor, robots, states, noise=max(1.0 - 2.0 * done, 0.2)
            )
            buffer.extend(steps)  # [ROBOTS, STEPS]
            collected += steps.numel()
            if len(buffer) >= 5 * SLICES * LENGTH:
                buffer.anneal(beta=0.4 + 0.6 * done, fraction=done)  # As in PER, beta rises to 1.
                for _ in range(steps.numel() // ACTIONS_PER_UPDATE):
                    batch = buffer.sample()
                    learned = learner.update(batch)
                    # Of the warm-up the priorities stay as they are.
                    buffer.update_tensordict_priority(batch[learned])
            outcomes.extend(steps["next", "info", "success"][steps["next", "done"]].tolist())
            bar.set_postfix_str(f"success {sum(outcomes) / max(len(outcomes), 1):.0%}")
            bar.update(min(collected, options.actions) - bar.n)
    for worlds in ("bars:validation", "mixed:validation"):
        print(f"success in {worlds}: {success_of(learner.actor, worlds):.0%}")
    return learner.actor


def drive(
    env: EnvBase, actor: Actor, robots: TensorDictBase, states: Tensor, *, noise: float
) -> tuple[TensorDictBase, TensorDictBase, Tensor]:
    """Let all robots act; their steps, where they are then, and what they remember."""
    steps = []
    for _ in range(STEPS):
        action, states = actor.act(robots["observation"], states)
        robots["action"] = (action + noise * torch.randn_like(action)).clamp(-1.0, 1.0)
        step, robots = env.step_and_maybe_reset(robots)
        steps.append(step)
        states = states * ~step["next", "done"]
    return torch.stack(steps, 1), robots, states


if __name__ == "__main__":
    main()
