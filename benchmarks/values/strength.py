"""The alphas with which kinds of priorities are equally strong, found on the frozen buffers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import pandas as pd
import torch
from scipy.optimize import brentq
from torch import Tensor

from benchmarks.study.experiments import EFFECTIVE
from benchmarks.values.arms import ARMS
from benchmarks.values.frozen import FrozenBuffer
from benchmarks.values.learning import BATCH, learn
from torchrl_mpfa import SignalSampler
from torchrl_mpfa.methods import Replay, make_replay
from torchrl_mpfa.samplers.mixture import MixtureSampler

KINDS = {"per": "per", "mpfa_per": "mpfa_per", "floor": "mpfa_per/floor0.2", "mixture": "mixture"}
"""Arms of table G whose strength is made equal in table H, by what they are called there."""
_UPDATES = 800
_BETWEEN = (0.01, 20.0)
"""Where an alpha is looked for."""


def chances(sampler: SignalSampler, size: int, alpha: float) -> Tensor:
    """Probability of each transition by its priorities as they are, with some alpha, ``[size]``."""
    mixed = isinstance(sampler, MixtureSampler)
    trees = list(sampler._parts.values()) if mixed else [sampler]
    shares = sampler.shares if mixed else torch.ones(1)
    found = torch.zeros(size, dtype=torch.double)
    for tree, share in zip(trees, shares, strict=True):
        powers = tree.priorities()[:size] ** alpha
        found += share * powers / powers.sum()
    return found


def effective_share(chance: Tensor) -> float:
    """Effective sample size, 1 / sum of P(i) squared, as a share of the buffer."""
    return float(1 / (chance.square().sum() * len(chance)))


def alpha_for(sampler: SignalSampler, size: int, share: float) -> float:
    """The alpha with which the effective sample is a share of the buffer: it falls with alpha."""

    def above(alpha: float) -> float:
        return effective_share(chances(sampler, size, alpha)) - share

    return float(brentq(above, *_BETWEEN, xtol=1e-3))


def equal_alphas(buffers: Sequence[FrozenBuffer], *, updates: int = _UPDATES) -> pd.DataFrame:
    """Learn from each buffer by each kind, and find its alphas.

    Args:
        buffers: Those of one reward.
        updates: How long is learned first; priorities are then those of critics on the way.

    Returns:
        A row for each kind, a column for each of :data:`EFFECTIVE`: medians over the buffers.
    """
    found = []
    for kind, arm in KINDS.items():
        for buffer in buffers:
            made: list[Replay] = []

            def replay(
                rows: FrozenBuffer,
                generator: torch.Generator,
                arm: str = arm,
                made: list[Replay] = made,
            ) -> Replay:
                method, size = ARMS[arm].method, len(rows)
                made.append(
                    make_replay(method, capacity=size, batch_size=BATCH, generator=generator)
                )
                return made[0]

            list(learn(buffer, replay, seed=0, marks=(updates,)))
            sampler = cast(SignalSampler, made[0].buffer.sampler)
            alphas = (alpha_for(sampler, len(buffer), share) for share in EFFECTIVE.values())
            found.append({"kind": kind, **dict(zip(EFFECTIVE, alphas, strict=True))})
    return pd.DataFrame(found).groupby("kind", sort=False).median()
