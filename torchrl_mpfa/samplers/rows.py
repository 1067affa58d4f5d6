"""The rows of a batch in the table of signals: what was learned goes in, and is checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from torch import Tensor

from torchrl_mpfa.checks import bounds, check_finite
from torchrl_mpfa.storages.table import SignalTable

Learned = Mapping[str, Callable[[Tensor], Tensor] | None]
"""Signals that the loss learns, each with what makes a priority of it, if anything does."""


def write_signals(
    rows: Tensor,
    table: SignalTable,
    signals: Mapping[str, Tensor],
    learned: Learned,
    *,
    live: Tensor | None,  # Which are still in the buffer, [B]; None: all.
    sizes: Sequence[int],  # Of the batches, each of which is given its priorities by itself.
) -> None:
    """Write learned signals in copies ``[M, C]`` of the live rows; the table stays as it is."""
    count = len(rows) if live is None else len(live)
    for name, priority_of in learned.items():
        if name not in signals:
            raise KeyError(f"signal {name!r} is missing, got {sorted(signals)}")
        value = signals[name].detach()
        if value.numel() != count or value.is_complex():
            raise ValueError(
                f"signal {name!r} must have one real number per transition, got {value.dtype} of "
                f"shape {[*value.shape]} for {count} slots"
            )
        value = value.reshape(-1) if live is None else value.reshape(-1)[live]
        column = rows.select(1, table.column[name])
        if priority_of is None:
            column.copy_(value)
            continue
        for one, into in zip(value.split(sizes), column.split(sizes), strict=True):
            if len(one):
                into.copy_(priority_of(one))


def check_signals(chosen: Tensor, names: Sequence[str], learned: Learned) -> None:
    """Reject signals ``[B, K]`` that cannot be fused: missing, negative or not finite."""
    if len(chosen) == 0:
        return
    # A NaN makes both of these NaN, so that one pass finds whatever is wrong.
    low, high = bounds(chosen)
    if low >= 0 and high < math.inf:
        return
    for name, value in zip(names, chosen.unbind(1), strict=True):
        if name not in learned and bool(value.isnan().any()):
            raise KeyError(f"signal {name!r} is missing: the stored transitions lack it")
        check_finite(f"signal {name!r}", value)
