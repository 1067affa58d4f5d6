"""Make frozen buffers: train, stop, let the policy drive alone, and learn its values for long."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from benchmarks.values.frozen import FrozenBuffer, as_stored
from benchmarks.values.learning import BATCH, FrozenPolicyLearner, make_frozen_learner
from torchrl_mpfa.methods import METHODS
from training.run.driving import TRANSITION
from training.run.hooks import Hook
from training.run.loop import TrainingRun
from training.settings.command_line import composed
from training.settings.train import register

_COMMON = (
    "regime=rooms",
    "updates=2",
    "learner.compile=true",
    "tracking=off",
    "evaluation.every=2000",
    "evaluation.world=mixed:validation",
    "evaluation.episodes=40",
    "evaluation.choose=false",
    # The paper's robot, without what the regime has for others.
    "environment.robot=turtlebot2",
    "environment.filter=0",
    "environment.step_cost=0",
    "environment.clearance=0.05",
    "learner.gamma=0.99",
    "learner.policy_noise=0.2",
    "learner.noise_clip=0.5",
    "learner.full_range=false",
)
REWARDS = {
    "sparse": (
        *_COMMON,
        "curriculum.stages=[{world: mixed, actions: 24000}]",
        # With the regime's slower targets nothing is learned from the goal alone in so few actions.
        "learner.tau=0.01",
        "learner.gamma=0.97",
        "environment.progress=none",
        "environment.max_goal_distance=6",
        "environment.detour_chance=0",
    ),
    "dense": (*_COMMON, "curriculum.stages=[{world: mixed, actions: 40000}]"),
}
"""Settings of the runs: the goal and the collision alone are rewarded, or every step is."""
TIMES = {"early": 6_000, "late": 20_000}
"""Actions after which a run is stopped; each of them is a transition."""
SOURCES = ("uniform", "per", "mpfa_per")
_FIRST_SEED = 2_000
"""First seed of the runs; no page of results has these seeds."""
_ENTRIES = ("episode", "behavior_mean", "behavior_sigma")
"""Further entries of transitions that some methods need."""
_VALUES: dict[str, Any] = {"gamma": 0.97, "tau": 0.01, "compile": False}
"""Settings of value learning; with a farther horizon long training does not converge."""
_RETURNS = 2_000
_STEPS = 1_200
"""Actions of each robot in which returns are gathered."""
_CUT = 0.02
"""A return that continues after the last action is used if less than this share is left."""
_CRITICS = 4
_LONG_TAU = 0.05
"""Of those critics: targets that move faster come to the end sooner, and a policy that does not
change forgives it."""
_LONG_SEED = 500
_LONG = 16_000
"""Updates of each critic that the values are the mean of."""


@dataclass(frozen=True)
class Source:
    """The run that a buffer comes from."""

    reward: str
    time: str
    method: str

    @property
    def name(self) -> str:
        """Name of the buffer."""
        return f"{self.reward}-{self.time}-{self.method}"

    @property
    def seed(self) -> int:
        """Each run has its own."""
        return _FIRST_SEED + SOURCES_OF_ALL.index(self)


SOURCES_OF_ALL = tuple(
    Source(reward, time, method) for reward in REWARDS for time in TIMES for method in SOURCES
)
"""The runs of all buffers."""


class _StopAfter(Hook):
    """Stops a run after so many actions."""

    def __init__(self, actions: int) -> None:
        self._actions = actions

    def on_iteration(self, run: TrainingRun) -> None:
        if run.actions >= self._actions:
            run.stop.ask()


def capture(source: Source) -> FrozenBuffer:
    """Train a run, stop it, and find the values of its policy."""
    with tempfile.TemporaryDirectory() as folder:
        own = ("learner=td3", "evaluation.every=0", f"method={source.method}")
        settings = (*REWARDS[source.reward], *own, f"seed={source.seed}", f"run_dir={folder}")
        (asked,) = composed(settings)
        run = TrainingRun(asked, Path(folder), hooks=[_StopAfter(TIMES[source.time])])
        run.entries = _ENTRIES
        run.train()
        keys = [*TRANSITION, *_ENTRIES]
        rows = as_stored(run.buffer.storage[: len(run.buffer)].select(*keys))
        env = run.robots.environment(run.schedule.world)
        learner = replace(asked.learner, **_VALUES)
        returns = monte_carlo(env, run.learner.policy, gamma=learner.gamma, seed=source.seed)
        returns = returns.half().float()
        policy = run.learner.policy.state_dict()
        frozen = FrozenBuffer(
            name=source.name,
            learner=learner,
            robots=asked.robots,
            rows=rows,
            policy={name: weight.detach().clone() for name, weight in policy.items()},
            returns=returns,
            value=torch.zeros(len(rows)),
            spread=0.0,
        )
        run.close()
    critics = [long_training(frozen, seed) for seed in range(_CRITICS)]
    of_rows = torch.stack([each.values(frozen.rows) for each in critics])
    spread = float((of_rows - of_rows.mean(0)).square().mean().sqrt())
    returns["long"] = torch.stack([each.values(returns) for each in critics]).mean(0)
    return replace(frozen, value=of_rows.mean(0), spread=spread, returns=returns)


def monte_carlo(env: EnvBase, policy: TensorDictModule, *, gamma: float, seed: int) -> TensorDict:
    """Drive a policy without noise; return observations, actions and discounted sums of rewards.

    States are kept where the end of an episode, or nearly all of the sum, was seen.
    """
    env.set_seed(seed)
    state, steps = env.reset(), []
    for _ in range(_STEPS):
        with torch.no_grad():
            driven, state = env.step_and_maybe_reset(policy(state))
        steps.append(driven.select(*TRANSITION))
    rows = cast(TensorDict, torch.stack(steps))  # [_STEPS, robots]
    reward, done, terminated = (
        rows["next", name].squeeze(-1) for name in ("reward", "done", "terminated")
    )
    value = torch.zeros(rows.shape[1], dtype=torch.double)
    unseen = torch.ones_like(value)
    values = torch.empty_like(reward, dtype=torch.double)
    shares = torch.empty_like(values)
    for step in reversed(range(_STEPS)):
        value = reward[step] + gamma * value.where(~done[step], 0.0)
        unseen = gamma * unseen.where(~done[step], 1.0).where(~terminated[step], 0.0)
        values[step], shares[step] = value, unseen
    seen = (shares < _CUT).flatten().nonzero().squeeze(-1)
    chosen = seen[torch.randperm(len(seen), generator=torch.Generator().manual_seed(seed))]
    chosen = chosen[:_RETURNS].sort().values
    kept = rows.flatten(0, 1)[chosen]
    found = {"observation": kept["observation"], "action": kept["action"]}
    return TensorDict({**found, "value": values.flatten()[chosen].float()}, [len(chosen)])


def long_training(buffer: FrozenBuffer, seed: int) -> FrozenPolicyLearner:
    """Critics after long training with uniform replay."""
    buffer = replace(buffer, learner=replace(buffer.learner, tau=_LONG_TAU))
    learner = make_frozen_learner(buffer, METHODS["uniform"], _LONG_SEED + seed, compile=True)
    generator = torch.Generator().manual_seed(seed)
    for update in range(_LONG):
        # Rates fall in the second half, so that what is left of the noise is small.
        learner.anneal(min(1.0, 2.0 - 2.0 * update / _LONG))
        index = torch.randint(len(buffer), (BATCH,), generator=generator)
        learner.update(buffer.rows[index])
    return learner


def capture_all(folder: Path) -> None:
    """Make the buffers that are not in a folder yet."""
    register()
    for source in SOURCES_OF_ALL:
        if not (folder / f"{source.name}.npz").exists():
            path = capture(source).save(folder)
            print(f"written: {path}, {path.stat().st_size / 1e6:.2f} MB")
