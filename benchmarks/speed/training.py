"""A training step of this package against a hand-written one, and against Stable-Baselines3's.

Both comparisons use networks of two layers of 256 and batches of 256, on two threads, and the time
on the clock on the wall, as threads count.
"""

from __future__ import annotations

import copy
import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from benchmarks.speed.replay import ACTION_SIZE, BATCH_SIZE, OBSERVATION_SIZE, make_transitions
from benchmarks.speed.sbx_peer import IdleEnv
from benchmarks.speed.timing import (
    MICROSECONDS,
    Call,
    Entry,
    entry,
    few_threads,
    report_progress,
    take_turns,
)
from torchrl_mpfa import (
    ActorCritic,
    GaussianNoise,
    Learner,
    MPFASampler,
    SignalReplayBuffer,
    SignalTensorStorage,
    make_actor,
    make_critic,
)
from training.run.assembly import has_compiler

WIDTH = 256
CAPACITY = 100_000
THREADS = 2
TRANSITION = ("observation", "action", "next")
_FILL = 10_000
_BLOCK = 20
_PLAIN = {"layer_norm": False, "final_init": None}


class Agent:
    """Parts of this package as in a training loop, with MPFA-PER; plain networks are as SB3's."""

    learner: Learner

    def __init__(
        self, *, plain: bool, width: int = WIDTH, compile: bool = False, algorithm: str = "ddpg"
    ) -> None:
        torch.manual_seed(0)
        sizes = OBSERVATION_SIZE, ACTION_SIZE
        options: dict[str, Any] = {"width": width, **(_PLAIN if plain else {})}
        critic = make_critic(*sizes, **options, late_action=not plain)
        actor = make_actor(*sizes, **options)
        noise: dict[str, Any] = {"policy_noise": 0.2, "bounds": (-1.0, 1.0)}
        of_algorithm = noise if algorithm == "td3" else {}
        self.learner = ActorCritic(actor, critic, compile=compile, **of_algorithm)
        spec = Bounded(low=-1.0, high=1.0, shape=(ACTION_SIZE,))
        self.noise = GaussianNoise(spec, sigma_init=0.2, sigma_end=0.2)
        self.buffer = SignalReplayBuffer(
            storage=SignalTensorStorage(CAPACITY, device="auto"),
            sampler=MPFASampler(CAPACITY),
            batch_size=BATCH_SIZE,
        )
        self.buffer.extend(make_transitions(_FILL))

    def act(self, state: TensorDictBase) -> TensorDictBase:
        """Choose an action with noise."""
        chosen = self.learner.policy.act(state["observation"])
        return state.set("action", self.noise.noisy(chosen))

    def learn(self, transition: TensorDictBase) -> None:
        """Store a transition of batch size ``[1]``, and make one update."""
        self.buffer.extend(transition)
        batch = self.buffer.sample()
        self.learner.update(batch)
        self.buffer.update_tensordict_priority(batch)


def make_step(*, compile: bool = False) -> Call:
    """One training step of this package, but for the environment's part."""
    agent, transition = Agent(plain=False, compile=compile), make_transitions(1)

    def step() -> None:
        agent.act(transition[0].select("observation"))
        agent.learn(transition)

    return step


def make_bare_step(*, gamma: float = 0.99, tau: float = 0.01) -> Call:
    """The same with uniform replay, written by hand in plain PyTorch with the same networks."""
    torch.manual_seed(0)
    sizes = OBSERVATION_SIZE, ACTION_SIZE
    actor = make_actor(*sizes, width=WIDTH).module
    critic = make_critic(*sizes, width=WIDTH).module
    target_actor, target_critic = copy.deepcopy(actor), copy.deepcopy(critic)
    of_actor = torch.optim.Adam(actor.parameters(), 1e-4)
    of_critic = torch.optim.Adam(critic.parameters(), 1e-4)
    current = [*actor.parameters(), *critic.parameters()]
    targets = [*target_actor.parameters(), *target_critic.parameters()]
    data = make_transitions(1)
    row = [
        data["observation"],
        data["action"],
        data["next", "reward"],
        data["next", "observation"],
        data["next", "terminated"].float(),
    ]
    memory = [torch.zeros(CAPACITY, value.shape[1]) for value in row]
    cursor = _FILL

    def step() -> None:
        nonlocal cursor
        with torch.no_grad():
            action = actor(row[0])[1]
            (action + 0.2 * torch.randn_like(action)).clamp_(-1.0, 1.0)
        for kept, value in zip(memory, row, strict=True):
            kept[cursor] = value[0]
        cursor = (cursor + 1) % CAPACITY
        index = torch.randint(_FILL, (BATCH_SIZE,))
        observation, taken, reward, after, end = (kept[index] for kept in memory)
        with torch.no_grad():
            following = target_critic(after, target_actor(after)[1])
            target = reward + gamma * (1.0 - end) * following
        loss = F.mse_loss(critic(observation, taken), target)
        of_critic.zero_grad()
        loss.backward()
        of_critic.step()
        loss = -critic(observation, actor(observation)[1]).mean()
        of_actor.zero_grad()
        loss.backward()
        of_actor.step()
        with torch.no_grad():
            torch._foreach_lerp_(targets, current, tau)

    return step


class IdleTorchEnv(EnvBase):
    """An environment that does nothing, for TorchRL."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded((OBSERVATION_SIZE,)))
        self.action_spec = Bounded(low=-1.0, high=1.0, shape=(ACTION_SIZE,))
        self.reward_spec = Unbounded((1,))
        self._observation = torch.zeros(OBSERVATION_SIZE)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return TensorDict({"observation": self._observation})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        end = torch.zeros(1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": self._observation,
                "reward": torch.zeros(1),
                "done": end,
                "terminated": end.clone(),
            }
        )

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


def make_loop(*, compile: bool = False, width: int = WIDTH) -> Call:
    """One round of a whole training loop of this package."""
    agent, env = Agent(plain=True, width=width, compile=compile), IdleTorchEnv()
    state = env.reset()

    def step() -> None:
        nonlocal state
        stepped = env.step(agent.act(state))
        agent.learn(stepped.select(*TRANSITION).unsqueeze(0))
        state = step_mdp(stepped)

    return step


def make_sb3_loop() -> Call:
    """One round of Stable-Baselines3's DDPG, with uniform replay."""
    from stable_baselines3 import DDPG
    from stable_baselines3.common.noise import NormalActionNoise

    zeros = np.zeros(ACTION_SIZE)
    model = DDPG(
        "MlpPolicy",
        IdleEnv(),
        learning_rate=1e-4,
        buffer_size=CAPACITY,
        learning_starts=BATCH_SIZE,
        batch_size=BATCH_SIZE,
        tau=0.01,
        train_freq=1,
        gradient_steps=1,
        action_noise=NormalActionNoise(zeros, zeros + 0.2),
        policy_kwargs={"net_arch": [WIDTH, WIDTH]},
        device="cpu",
        seed=0,
    )
    # Its loop is made for many steps; what starts and ends it is spread over as many.
    waiting = 0
    model.learn(2 * BATCH_SIZE)

    def step() -> None:
        nonlocal waiting
        if waiting == 0:
            model.learn(_BLOCK, reset_num_timesteps=False)
            waiting = _BLOCK
        waiting -= 1

    return step


def _compare(ours: dict[str, Call], baseline: str, theirs: Call, *, quick: bool) -> list[Entry]:
    with few_threads(THREADS):
        for call in ours.values():
            call()  # Compiles, for as many threads, where that is asked for.
    timings = take_turns(
        {**ours, baseline: theirs},
        rounds=3 if quick else 21,
        seconds=0.05 if quick else 1.0,
        threads=THREADS,
        clock=time.perf_counter,
        multiple_of=_BLOCK,
    )
    other = timings[baseline]
    return [
        entry(baseline, other.median * MICROSECONDS, "us"),
        *(
            entry(
                name,
                timings[name].median * MICROSECONDS,
                "us",
                ratio=timings[name].ratio(other),
                baseline=baseline,
            )
            for name in ours
        ),
    ]


def measure_train_step(*, quick: bool) -> list[Entry]:
    """Compare a training step without environment with a plain one; compile unless quick."""
    ours = _variants("train_step", make_step, quick=quick)
    return _compare(ours, "train_step_bare", make_bare_step(), quick=quick)


def measure_sb3_step(*, quick: bool) -> list[Entry]:
    """Compare the loop on an idle environment with Stable-Baselines3's; None without that."""
    if importlib.util.find_spec("stable_baselines3") is None:
        report_progress("sb3_step: left out, stable-baselines3 is not installed")
        return []
    ours = _variants("sb3_step", make_loop, quick=quick)
    return _compare(ours, "sb3_step_sb3", make_sb3_loop(), quick=quick)


def _variants(name: str, make: Callable[..., Call], *, quick: bool) -> dict[str, Call]:
    """Time an update as ``make train`` has it, compiled if there is a C++ compiler, and eager."""
    if quick:
        return {name: make()}
    if not has_compiler():
        report_progress(f"{name}: not compiled, there is no C++ compiler")
        return {name: make()}
    return {name: make(compile=True), f"{name}_eager": make()}
