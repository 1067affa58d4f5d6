"""What the buffer and the last batch of a sampler of signals consist of."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import PositiveBoost, is_positive, level_of

if TYPE_CHECKING:
    from torchrl_mpfa.samplers.fused import SignalSampler, Weighing


def composition(
    sampler: SignalSampler, weighing: Weighing | None, batch: tuple[Tensor, Tensor] | None
) -> dict[str, float]:
    """Return numbers of the buffer, and of slots and weights of its last batch, by name."""
    table, weights = sampler.table, sampler.weights
    names = table.names[table.fused]
    found: dict[str, float] = {f"weight/{name}": value for name, value in weights.items()}
    for place, adjust in enumerate(sampler.adjustments):
        if isinstance(adjust, PositiveBoost):
            counted = () if weighing is None else weighing.counted
            factor = adjust.factor(counted[place] if counted else None)
            found.setdefault("boost_factor", float(factor))
    if table.size == 0:
        return found
    level, mean = level_of((*sampler.adjustments, sampler.fusion)), float(table.rewards.mean())
    positive = is_positive(table.rewards, level, mean=mean)
    found["positive_fraction_buffer"] = float(positive.double().mean())
    if batch is None:
        return found
    index, importance = batch
    rows = table.rows[index]
    if (entropies := getattr(sampler.fusion, "entropies", None)) is not None:
        values = entropies(names, table, index).tolist()
        found |= {f"entropy/{n}": v for n, v in zip(names, values, strict=True)}
    known = rows[:, table.fused]
    known = known[~known.isnan().any(1)]
    if weights and len(known):
        # Shares in the mean priority of Eq. (21); equal ones if every signal is zero.
        ordered = torch.tensor([weights[name] for name in names], dtype=torch.double)
        parts = known.mean(0) * ordered.to(known.device)
        shares = parts / parts.sum() if parts.sum() > 0 else torch.full_like(parts, 1 / len(parts))
        found |= {f"share/{n}": v for n, v in zip(names, shares.tolist(), strict=True)}
    positive = is_positive(rows[:, table.reward_column], level, mean=mean)
    age = table.writes - 1 - rows[:, table.time_column]
    return {
        **found,
        "positive_fraction_batch": float(positive.double().mean()),
        "effective_sample_size": float(importance.sum().square() / importance.square().sum()),
        "sampled_age_mean": float(age.mean()),
        "sampled_age_max": float(age.max()),
        "replay_count_mean": float(rows[:, table.count_column].mean()),
    }
