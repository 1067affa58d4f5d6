"""A frozen buffer whose values are known: a walk along a line, with the goal at its end."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from benchmarks.values import FrozenBuffer
from torchrl_mpfa import make_actor
from training.settings.learners import TD3Settings

GAMMA = 0.9
STEPS = 8
ROBOTS = 4


@pytest.fixture(scope="session")
def walk() -> FrozenBuffer:
    """Robots that walk from a random cell to the last one, where a goal of 10 is."""
    generator = torch.Generator().manual_seed(0)
    count = 400 * ROBOTS
    cells = torch.empty(count, dtype=torch.long)
    cells[:ROBOTS] = torch.arange(ROBOTS)
    starts = torch.randint(STEPS, (count,), generator=generator)
    for row in range(ROBOTS, count):
        before = int(cells[row - ROBOTS])
        cells[row] = before + 1 if before + 1 < STEPS else starts[row]
    ended = cells == STEPS - 1
    observation = torch.eye(STEPS + 1)
    flags = ended.unsqueeze(-1)
    rows = {
        "observation": observation[cells],
        "action": torch.rand(count, 2, generator=generator) * 2 - 1,
        "behavior_mean": torch.zeros(count, 2),
        "behavior_sigma": torch.full((count, 1), 0.5),
        "episode": torch.arange(count).unsqueeze(-1) // 64,
        "next": {
            "observation": observation[cells + 1],
            "reward": 10.0 * flags,
            "done": flags,
            "terminated": flags,
        },
    }
    torch.manual_seed(0)
    settings = TD3Settings(compile=False, gamma=GAMMA, tau=0.1, critic_lr=3e-3)
    actor = make_actor(STEPS + 1, 2, width=settings.width)
    weights = {name: each.detach() for name, each in actor.named_parameters()}
    value = 10.0 * GAMMA ** (STEPS - 1 - cells).double()
    chosen = slice(0, 200)
    kept = {"observation": observation[cells][chosen], "action": rows["action"][chosen]}
    known = value[chosen].float()
    return FrozenBuffer(
        name="walk",
        learner=settings,
        robots=ROBOTS,
        rows=TensorDict(rows, [count]),
        policy=weights,
        returns=TensorDict({**kept, "value": known, "long": known}, [200]),
        value=value.float(),
        spread=0.0,
    )
