"""Value learning: critics from scratch on a frozen buffer, and how near they come to the values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from scipy.stats import spearmanr
from tensordict import TensorDictBase
from torch import Tensor

from benchmarks.values.frozen import FrozenBuffer
from mpfa_envs import RandomMirror
from torchrl_mpfa import run_updates
from torchrl_mpfa.checks import unknown
from torchrl_mpfa.learners import ActorCritic
from torchrl_mpfa.methods import METHODS, Method, Prioritized, Replay, make_replay
from torchrl_mpfa.selection import SampledBatch
from torchrl_mpfa.signals import SIGNALS_KEY
from training.run.assembly import make_learner

BATCH = 256
MARKS = (160, 400, 800, 1_600)
"""Updates after which critics are looked at: a tenth, a quarter, half and all."""
_TOGETHER = 2
"""Updates whose batches are sampled together, as in the study."""
_EPISODE = 4
"""Updates for each episode of a run that ends, for what changes with episodes."""
GOAL = 5.0
"""A reward above this is that of a goal."""

SignalFunction = Callable[[ActorCritic, TensorDictBase], Tensor]
"""From a learner and a batch to a signal, shape ``[B]``."""
ReplayFunction = Callable[[FrozenBuffer, torch.Generator], Replay]
"""Makes an empty replay of one's own for the transitions of a buffer."""


@dataclass(frozen=True)
class Measure:
    """Critics after so many updates."""

    buffer: str
    method: str
    seed: int
    updates: int
    rmse: float
    """Root of the mean square difference to the values of long training, in units of reward."""
    bias: float
    """Its mean."""
    rank: float
    """Rank correlation with them."""
    returns_rmse: float
    """RMSE, bias and rank correlation against the Monte Carlo returns of the policy."""
    returns_bias: float
    returns_rank: float
    effective: float
    """Effective sample size so far, as a share of the buffer."""
    goals: float
    """Share of the sampled transitions that reached a goal."""


class SampleCounts:
    """Counts of the transitions that were sampled from a buffer, of which some reached a goal."""

    def __init__(self, goal: Tensor) -> None:
        self._goal = goal
        self._counts = torch.zeros(len(goal), dtype=torch.double)

    def __call__(self, sampled: SampledBatch) -> SampledBatch:
        """Count a batch that the critics learn from."""
        if sampled.gives_signals:
            index = sampled.batch["index"]
            self._counts.index_add_(0, index, torch.ones(len(index), dtype=torch.double))
        return sampled

    @property
    def effective(self) -> float:
        """Effective sample size, 1 / sum of P(i) squared, as a share of the buffer.

        The sum is the chance that two samples are of the same transition, estimated without bias.
        """
        count, total = self._counts, self._counts.sum()
        same = (count * (count - 1)).sum() / (total * (total - 1))
        return float(1 / (same * len(count)))

    @property
    def goals(self) -> float:
        """Share of the samples that reached a goal."""
        return float(self._counts[self._goal].sum() / self._counts.sum())


class FrozenPolicyLearner:
    """A learner whose critics learn the values of a policy that does not change.

    Each of ``signals`` writes an entry of a batch before the critics learn from the batch.
    """

    def __init__(
        self,
        learner: ActorCritic,
        policy: Mapping[str, Tensor],
        signals: Mapping[str, SignalFunction] | None = None,
    ) -> None:
        self._learner, self._signals = learner, signals or {}
        self.policy = learner.policy
        for parts in (learner.networks, learner.targets):
            parts["actor"].load_state_dict(policy)

    def update(self, sampled: SampledBatch | TensorDictBase) -> dict[str, Tensor]:
        """One step of the critics, and of the targets when they are due."""
        if not isinstance(sampled, SampledBatch):
            sampled = SampledBatch(sampled)
        learner, log = self._learner, {}
        if sampled.trains == "actor":
            learner.updates += sampled.new_step
        else:
            for name, signal in self._signals.items():
                sampled.batch[SIGNALS_KEY, name] = signal(learner, sampled.batch)
            log = learner.update(replace(sampled, trains="critic"))
        # Of a learner they move with the actor, which is not asked to learn.
        if sampled.trains != "critic" and learner.updates % learner.policy_delay == 0:
            learner.move_targets()
        return log

    def values(self, rows: TensorDictBase) -> Tensor:
        """Mean of the critics' Q in units of the reward, shape ``[N]``."""
        return critic_values(self._learner, rows).mean(0)

    def end_episode(self) -> None:
        """Signal the end of an episode."""
        self._learner.end_episode()

    def anneal(self, factor: float) -> None:
        """Set the learning rates to a fraction of their first values."""
        self._learner.anneal(factor)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on."""
        return self._learner.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self._learner.load_state_dict(state_dict)


def make_frozen_learner(
    buffer: FrozenBuffer,
    method: Method,
    seed: int,
    signals: Mapping[str, SignalFunction] | None = None,
    *,
    compile: bool = False,
) -> FrozenPolicyLearner:
    """Critics from scratch for the policy of a buffer; they write the signals of a method."""
    torch.manual_seed(seed)
    if isinstance(method, Prioritized):
        # What functions of their own write is nothing that the learner has to write.
        known = [name for name in method.signals if name not in (signals or {})]
        method = replace(method, signals=known)
    sizes = (buffer.rows[name].shape[-1] for name in ("observation", "action"))
    learner = make_learner(buffer.learner, method, *sizes, compile=compile)
    assert isinstance(learner, ActorCritic)
    return FrozenPolicyLearner(learner, buffer.policy, signals)


def critic_values(learner: ActorCritic, rows: TensorDictBase) -> Tensor:
    """Q of each critic in units of the reward, shape ``[C, B]``: a signal may be made of it."""
    with torch.no_grad():
        return learner.values_of(rows) / learner.reward_scale


def learn(
    buffer: FrozenBuffer,
    method: str | Method | ReplayFunction,
    seed: int,
    *,
    signals: Mapping[str, SignalFunction] | None = None,
    mirrored: bool = False,
    marks: tuple[int, ...] = MARKS,
    compile: bool = False,
) -> Iterator[Measure]:
    """Learn the values of a buffer's policy with one method and seed.

    Args:
        buffer: The buffer.
        method: A name out of :data:`~torchrl_mpfa.methods.METHODS`, settings of your own, or what
            makes a replay of your own.
        seed: Seed of the critics' first weights and of the samples.
        signals: Functions of your own that write the signals of a method.
        mirrored: Mirror half of each batch, as the trainings do that the buffers come from.
        marks: Even numbers of updates after which the critics are looked at.
        compile: Make one program of an update: it takes half a minute once, then half of the time.

    Yields:
        What they had learned then.

    Raises:
        ValueError: If the marks are odd or do not rise, or the method is unknown.
    """
    rising = all(before < after for before, after in pairwise((0, *marks)))
    if not marks or not rising or any(mark % _TOGETHER for mark in marks):
        raise ValueError(f"marks must be even numbers of updates that rise, got {marks}")
    generator = torch.Generator().manual_seed(seed)
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(unknown("method", method, METHODS))
        method = METHODS[method]
    if isinstance(method, Method):
        learner = make_frozen_learner(buffer, method, seed, signals, compile=compile)
        replay = make_replay(
            method,
            capacity=len(buffer),
            batch_size=BATCH,
            generator=generator,
            policy=learner.policy,
            sigma=float(buffer.rows["behavior_sigma"].mean()),
        )
    else:
        replay = method(buffer, generator)
        learner = make_frozen_learner(buffer, replay.method, seed, signals, compile=compile)
    replay.buffer.extend(buffer.rows)
    if mirrored:
        replay.buffer.append_transform(mirror())
    counts = SampleCounts(buffer.rows["next", "reward"].squeeze(-1) > GOAL)
    for done in range(_TOGETHER, marks[-1] + 1, _TOGETHER):
        run_updates(replay.buffer, learner, replay.select, updates=_TOGETHER, prepare=counts)
        replay.anneal(done / marks[-1])
        if done % _EPISODE == 0:
            learner.end_episode()
        if done in marks:
            yield Measure(
                buffer.name,
                replay.method.name,
                seed,
                done,
                *compared(learner.values(buffer.rows), buffer.value),
                *compared(learner.values(buffer.returns), buffer.returns["value"]),
                counts.effective,
                counts.goals,
            )


def mirror(*, chance: float = 0.5) -> RandomMirror:
    """Mirrors transitions of the frozen buffers, whose robots have a map."""
    return RandomMirror(memory="map", chance=chance)


def compared(value: Tensor, reference: Tensor) -> tuple[float, float, float]:
    """Root mean square difference, mean difference and rank correlation of two, shape ``[N]``."""
    error = (value - reference).double()
    rank = spearmanr(value.numpy(), reference.numpy()).statistic
    return float(error.square().mean().sqrt()), float(error.mean()), float(rank)
