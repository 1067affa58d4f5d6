"""The weights of the signals, counted over the buffer from time to time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import Adjustment, PositiveBoost
from torchrl_mpfa.checks import check_finite
from torchrl_mpfa.fusion import Fusion
from torchrl_mpfa.saved import Entry, count, number
from torchrl_mpfa.storages.table import SignalTable

_COUNT_REFRESH = 1 / 16
"""Share of the buffer that may change before the adjustments count it anew."""


@dataclass(frozen=True)
class Weighing:
    """What was counted over the buffer, and when."""

    weights: Tensor
    """One for each fused signal, in the order of their columns, shape ``[K]``."""
    mean_reward: float
    writes: int
    """Transitions that had been written."""
    counted: tuple[Tensor | None, ...] = ()
    """What each adjustment counted; empty where none does."""
    counted_writes: int = 0
    """Transitions that had been written when they did."""
    learned_since: int = 0
    """Transitions that were learned from since."""


def asks(adjustment: Adjustment) -> bool:
    """Whether an adjustment wants to count the buffer."""
    return bool(getattr(adjustment, "counts", False))


def entries_of(
    weighing: Weighing | None, adjustments: Sequence[Adjustment], count: int
) -> dict[str, Tensor]:
    """What adjustments that count have to tell the loss of a batch, each of shape ``[B]``."""
    counted = () if weighing is None else weighing.counted
    found: dict[str, Tensor] = {}
    for each, value in zip_longest(adjustments, counted):
        if asks(each) and hasattr(each, "entries"):
            found.update(each.entries(value, count))
    return found


def count_anew(
    weighing: Weighing,
    last: Weighing | None,
    adjustments: Sequence[Adjustment],
    table: SignalTable,
    priority: Callable[[Weighing], Tensor],
    *,
    learned: int,
    always: bool,  # Whatever has changed.
) -> Weighing:
    """Have the adjustments count the buffer again if enough of it changed since they last did."""
    # Both what is written and what is learned from changes it. With a sixteenth between two
    # counts a row that is learned from costs as much as sixteen that are read, at any capacity.
    if not any(map(asks, adjustments)):
        return weighing
    if last is not None and last.counted:
        changed = table.writes - last.counted_writes + last.learned_since
        if 0 <= changed <= _COUNT_REFRESH * table.size and not always:
            return replace(
                weighing,
                counted=last.counted,
                counted_writes=last.counted_writes,
                learned_since=last.learned_since + learned,
            )
    fused = priority(weighing)
    counted = [each.count(table, fused) if asks(each) else None for each in adjustments]  # type: ignore[attr-defined]
    for value in counted:
        if value is not None:
            check_finite("what an adjustment counted", value)
    return replace(
        weighing, counted=tuple(counted), counted_writes=table.writes, learned_since=learned
    )


def weights_of(fusion: Fusion, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
    """The weights that a fusion gives, checked, in double precision, shape ``[K]``."""
    weights = fusion.weights(names, table, index)
    if weights.shape != (len(names),):
        raise ValueError(f"fusion must give {len(names)} weights, got shape {[*weights.shape]}")
    check_finite("weights of the fusion", weights)
    return weights.to(torch.double)


def boost_factor(weighing: Weighing | None, adjustments: Sequence[Adjustment]) -> dict[str, float]:
    """The factor of Eq. (22) as it is now, by its name in the log; nothing without a boost."""
    counted = () if weighing is None else weighing.counted
    for each, value in zip_longest(adjustments, counted):
        if isinstance(each, PositiveBoost):
            return {"boost_factor": float(each.factor(value))}
    return {}


def counted_state(weighing: Weighing | None, adjustments: Sequence[Adjustment]) -> dict[str, Any]:
    """What the adjustments counted, to be saved; nothing where none counts."""
    if not any(map(asks, adjustments)):
        return {}
    if weighing is None:
        return {"_counted": [], "_counted_writes": 0, "_learned_since": 0}
    return {
        "_counted": [None if value is None else value.clone() for value in weighing.counted],
        "_counted_writes": weighing.counted_writes,
        "_learned_since": weighing.learned_since,
    }


def counted_entries(adjustments: Sequence[Adjustment]) -> list[Entry]:
    """What the entries of :func:`counted_state` must be."""
    asking = [asks(each) for each in adjustments]
    if not any(asking):
        return []

    def holds(counted: Any) -> bool:
        finite = [isinstance(v, Tensor) and bool(v.isfinite().all()) for v in counted or ()]
        return isinstance(counted, list) and (not counted or finite == asking)

    words = f"empty, or finite numbers for {sum(asking)} adjustments"
    return [Entry("_counted", holds, words), count("_counted_writes"), count("_learned_since")]


def weighing_entries(names: Sequence[str]) -> list[Entry]:
    """What the saved weights of signals must be."""

    def holds(weights: Any) -> bool:
        if not isinstance(weights, Mapping) or (weights and sorted(weights) != sorted(names)):
            return False
        return all(number(name).holds(value) for name, value in weights.items())

    return [
        Entry("_weights", holds, f"empty, or one number for each of {sorted(names)}"),
        count("_weighed_at"),
        Entry(
            "_mean_reward",
            lambda mean: isinstance(mean, int | float) and math.isfinite(mean),
            "a finite number",
        ),
    ]
