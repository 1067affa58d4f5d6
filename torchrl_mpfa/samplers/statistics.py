"""What a prioritized batch is made of, for logs and for judging a method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchrl_mpfa.fusion import Fusion
from torchrl_mpfa.positive import Level, is_positive
from torchrl_mpfa.storages.table import SignalTable


def effective_sample_size(weight: Tensor) -> float:
    r"""Effective number of transitions, :math:`(\sum_i w_i)^2 / \sum_i w_i^2`.

    Args:
        weight: Importance weights of a batch, shape ``[B]``.

    Returns:
        A number between 1 and ``B``; ``B`` if all weights are alike.

    Examples:
        >>> effective_sample_size(torch.ones(4))
        4.0
    """
    return float(weight.sum().square() / weight.square().sum())


def signal_shares(signals: Tensor, weights: Tensor) -> Tensor:
    """Share of each signal in the mean fused priority.

    Weights say what a method intends; shares say what results, as signals differ in scale.

    Args:
        signals: Non-negative signals, shape ``[B, K]``.
        weights: Weights of the fusion, shape ``[K]``.

    Returns:
        Shares that sum to one, shape ``[K]``; equal ones if every signal is zero.

    Examples:
        >>> signal_shares(torch.tensor([[3.0, 1.0]]), torch.tensor([0.5, 0.5])).tolist()
        [0.75, 0.25]
    """
    parts = signals.mean(0) * weights
    total = parts.sum()
    return parts / total if total > 0 else torch.full_like(parts, 1.0 / parts.numel())


def batch_statistics(
    names: Sequence[str],
    weights: Mapping[str, float],
    fusion: Fusion,
    table: SignalTable,
    last_batch: tuple[Tensor, Tensor] | None,
    positive_above: Level,
) -> dict[str, float]:
    """Statistics of the buffer and of the last batch by name; see ``docs/metrics.md``."""
    found: dict[str, float] = {f"weight/{name}": value for name, value in weights.items()}
    if table.size == 0:
        return found
    mean = float(table.rewards.mean())

    def positive_fraction(rewards: Tensor) -> float:
        return float(is_positive(rewards, positive_above, mean=mean).double().mean())

    found["positive_fraction_buffer"] = positive_fraction(table.rewards)
    if last_batch is None:
        return found
    index, importance = last_batch
    entropies = getattr(fusion, "entropies", None)
    if entropies is not None:
        for name, value in zip(names, entropies(names, table, index).tolist(), strict=True):
            found[f"entropy/{name}"] = value
    rows = table.rows[index]
    signals = rows[:, [table.column[name] for name in names]]
    known = signals[~signals.isnan().any(1)]
    if weights and len(known):
        shares = signal_shares(known, known.new_tensor([weights[name] for name in names]))
        found.update({f"share/{n}": s for n, s in zip(names, shares.tolist(), strict=True)})
    age = table.writes - 1 - rows[:, table.time_column]
    found["positive_fraction_batch"] = positive_fraction(rows[:, table.reward_column])
    found["effective_sample_size"] = effective_sample_size(importance)
    found["sampled_age_mean"] = float(age.mean())
    found["sampled_age_max"] = float(age.max())
    found["replay_count_mean"] = float(rows[:, table.count_column].mean())
    return found
