"""The weights of the signals, counted over the buffer from time to time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.checks import check_finite
from torchrl_mpfa.fusion import Fusion
from torchrl_mpfa.samplers.states import check_count, check_number, entry, refuse
from torchrl_mpfa.storages.table import SignalTable


@dataclass(frozen=True)
class Weighing:
    """What was counted over the buffer, and when."""

    weights: Tensor
    """One for each fused signal, in the order of their columns, shape ``[K]``."""
    mean_reward: float
    writes: int
    """Transitions that had been written."""


def weights_of(fusion: Fusion, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
    """The weights that a fusion gives, in double precision, shape ``[K]``.

    Raises:
        ValueError: If they have another shape, or one is negative or not finite.
    """
    weights = fusion.weights(names, table, index)
    if weights.shape != (len(names),):
        raise ValueError(f"fusion must give {len(names)} weights, got shape {[*weights.shape]}")
    check_finite("weights of the fusion", weights)
    return weights.to(torch.double)


def check_weighing(state: Mapping[str, Any], names: Sequence[str]) -> None:
    """Refuse a saved state whose weights are not those of these signals.

    Raises:
        ValueError: If an entry is missing or not what it must be.
    """
    weights = entry(state, "_weights")
    if not isinstance(weights, Mapping) or (weights and sorted(weights) != sorted(names)):
        refuse("_weights", f"empty, or one number for each of {sorted(names)}", weights)
    for name in weights:
        check_number(weights, name)
    check_count(state, "_weighed_at")
    mean = entry(state, "_mean_reward")
    if not (isinstance(mean, int | float) and math.isfinite(mean)):
        refuse("_mean_reward", "a finite number", mean)
