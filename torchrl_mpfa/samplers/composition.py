"""What the buffer and the last batch of a sampler of signals consist of."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import PositiveBoost
from torchrl_mpfa.samplers.prioritized import TreeSampler
from torchrl_mpfa.samplers.weighing import Fusing, Weighing


def composition(
    sampler: Fusing, weighing: Weighing | None, batch: tuple[Tensor, Tensor] | None
) -> dict[str, float]:
    """Return numbers of the buffer, and of slots and weights of its last batch, by name."""
    table, weights = sampler.table, sampler.weights
    names = table.names[table.fused]
    numbers: dict[str, float] = {f"weight/{name}": value for name, value in weights.items()}
    for place, adjust in enumerate(sampler.adjustments):
        if isinstance(adjust, PositiveBoost):
            counted = () if weighing is None else weighing.counted
            factor = adjust.factor(counted[place] if counted else None)
            numbers.setdefault("boost_factor", float(factor))
    if table.size == 0:
        return numbers
    level = table.level
    numbers["positive_fraction_buffer"] = float((table.rewards > level).double().mean())
    if batch is None:
        return numbers
    index, importance = batch
    rows = table.rows[index]
    if (entropies := sampler.fusion.entropies(names, table, index)) is not None:
        numbers |= {f"entropy/{n}": v for n, v in zip(names, entropies.tolist(), strict=True)}
    signals = rows[:, table.fused]
    signals = signals[~signals.isnan().any(1)]
    if weights and len(signals):
        # Shares in the mean priority of Eq. (21); equal ones if every signal is zero.
        ordered = torch.tensor([weights[n] for n in names], dtype=torch.double, device="cpu")
        parts = signals.mean(0) * ordered.to(signals.device)
        shares = parts / parts.sum() if parts.sum() > 0 else torch.full_like(parts, 1 / len(parts))
        numbers |= {f"share/{n}": v for n, v in zip(names, shares.tolist(), strict=True)}
    positive = rows[:, table.reward_column] > level
    age = table.writes - 1 - rows[:, table.time_column]
    return {
        **numbers,
        "positive_fraction_batch": float(positive.double().mean()),
        "effective_sample_size": float(importance.sum().square() / importance.square().sum()),
        "sampled_age_mean": float(age.mean()),
        "sampled_age_max": float(age.max()),
        "replay_count_mean": float(rows[:, table.count_column].mean()),
    }


def distributions(sampler: Any, size: int) -> dict[str, Tensor]:
    """Return signals, priorities and weights of the first slots by name, each of shape ``[N]``."""
    if not isinstance(sampler, TreeSampler) or not size:
        return {}
    columns = {"priority": sampler.priorities()[:size], "weight": sampler.batch_weights(size)}
    table = getattr(sampler, "table", None)
    if table is not None:
        columns |= {name: table.rows[:size, column] for name, column in table.column.items()}
    return columns
