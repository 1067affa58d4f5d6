"""One training step of every method against one of uniform DDPG, as the examples make it."""

from __future__ import annotations

from dataclasses import replace

import torch

from benchmarks.paper.methods import RECONSTRUCTIONS
from benchmarks.speed.replay import ACTION_SIZE, OBSERVATION_SIZE, make_transitions
from benchmarks.speed.timing import MICROSECONDS, Call, Entry, entry, take_turns
from torchrl_mpfa.methods import ALIASES, METHODS, Method, make_replay
from training.run.assembly import make_learner
from training.settings.learners import LearnerSettings

BASELINE = "ddpg"
MEASURED = {**METHODS, **RECONSTRUCTIONS}
"""Methods of the package and of the paper's table."""
_FILL = 10_000
_EPISODE = 100
"""Transitions of an episode."""
_SIGMA = 0.2


def make_step(method: Method) -> Call:
    """Make a function that takes a step of a method: store, choose, update, priorities."""
    torch.manual_seed(0)
    sizes = OBSERVATION_SIZE, ACTION_SIZE
    learner = make_learner(LearnerSettings(), method, *sizes)
    bonus = method.bonus(*sizes)
    replay = make_replay(method, policy=learner.policy, sigma=_SIGMA)
    buffer = replay.buffer
    filling, transition = make_transitions(_FILL), make_transitions(1)
    filling["episode"] = torch.arange(_FILL).unsqueeze(1) // _EPISODE
    transition["episode"] = torch.full((1, 1), _FILL // _EPISODE)
    for rows in (filling, transition):
        rows["behavior_mean"] = rows["action"].clone()
        rows["behavior_sigma"] = torch.full((len(rows), 1), _SIGMA)
    buffer.extend(filling)

    def step() -> None:
        buffer.extend(transition)
        for sampled in replay.select(buffer):
            if bonus is not None and sampled.gives_signals:
                bonus(sampled.batch)
            learner.update(sampled)
            if sampled.gives_signals:
                buffer.update_tensordict_priority(sampled.batch)

    return step


def measure(*, quick: bool) -> list[Entry]:
    """Compare a step of each method with one of uniform DDPG; a few methods if quick."""
    chosen = (BASELINE, "mpfa_per", "la3p") if quick else tuple(MEASURED)
    calls = {name: make_step(replace(MEASURED[name])) for name in chosen if name not in ALIASES}
    timings = take_turns(
        calls, rounds=3 if quick else 11, seconds=0.05 if quick else 0.3, threads=1
    )
    other = timings[BASELINE]
    return [
        entry(
            f"step_{name}",
            timing.median * MICROSECONDS,
            "us",
            ratio=timing.ratio(other),
            baseline=f"step_{BASELINE}",
        )
        for name, timing in timings.items()
    ]
