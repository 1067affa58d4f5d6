"""Weights of the signals, and when they are counted over the buffer again."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchrl_mpfa.adjustment import Adjustment
from torchrl_mpfa.checks import Level, check_not_negative
from torchrl_mpfa.fusion import Fusion, checked_weights
from torchrl_mpfa.samplers.table import SignalTable
from torchrl_mpfa.saving import check_saved

# With a sixteenth a row that is learned from costs as much as sixteen that are read, at any
# capacity.
_COUNT_REFRESH = 1 / 16
_ENOUGH = 100
"""With fewer rewards there is no warning that all are on one side."""
_NO_WEIGHTS = torch.empty(0, device="cpu")


class Fusing(Protocol):
    """What is read of a sampler that fuses signals."""

    @property
    def table(self) -> SignalTable:
        """Signals, reward, replay count and time of writing of every slot."""

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each signal at the last count."""

    @property
    def fusion(self) -> Fusion:
        """How signals become one priority."""

    @property
    def adjustments(self) -> Sequence[Adjustment]:
        """Changes of fused priorities, in order."""

    @property
    def positive_above(self) -> Level:
        """Reward above which a transition is positive."""

    @property
    def recounts(self) -> bool:
        """True if fusion or adjustments count at each update, or may have to."""

    @property
    def entropy_refresh(self) -> float:
        """Share of the buffer that may be rewritten before weights are counted again."""

    def combined(self, rows: Tensor, weighing: Weighing) -> Tensor:
        """Return priorities by Eq. (21), eps included, shape ``[B]``."""

    def warn_once(self, subject: str, text: str) -> None:
        """Warn of a subject that this sampler has not yet warned of."""


@dataclass(frozen=True)
class Weighing:
    """Results of the last passes over the buffer, and the state of the buffer at each of them."""

    weights: Tensor = _NO_WEIGHTS  # One per fused signal, in the order of their columns, [K].
    mean_reward: float = 0.0
    writes: int = 0  # Transitions that had been written when the weights were computed.
    counted: tuple[Tensor | None, ...] = ()  # One result per adjustment, None if it has none.
    counted_writes: int = 0  # Transitions that had been written when the adjustments counted.
    learned_since: int = 0  # Transitions that were learned from since then.

    def state_dict(self, names: Sequence[str], *, counts: bool) -> dict[str, Any]:
        """Return what is saved of it, with what the adjustments counted if any counts."""
        state: dict[str, Any] = {
            "_weights": dict(zip(names, self.weights.tolist(), strict=False)),
            "_weighed_at": self.writes,
            "_mean_reward": self.mean_reward,
        }
        if counts:
            state["_counted"] = [None if v is None else v.clone().cpu() for v in self.counted]
            state["_counted_writes"] = self.counted_writes
            state["_learned_since"] = self.learned_since
        return state


def restored_weighing(
    state: dict[str, Any], names: Sequence[str], counting: Sequence[bool], device: torch.device
) -> Weighing | None:
    """Return what was saved; None where nothing had been weighed.

    Raises:
        KeyError: If an entry is missing.
        ValueError: If the weights are of other signals, or a number is not finite.
    """
    check_saved("sampler", state, ("_weights", "_weighed_at", "_mean_reward"))
    counted = []
    if any(counting):
        check_saved("sampler", state, ("_counted", "_counted_writes", "_learned_since"))
        counted = state["_counted"]
        fit = [isinstance(v, Tensor) and bool(v.isfinite().all()) for v in counted or ()]
        if counted is None or (counted and fit != counting):
            raise ValueError(
                f"'_counted' of the saved sampler must be empty, or finite numbers for "
                f"{sum(counting)} adjustments, got {counted}"
            )
    if not state["_weights"]:
        return None
    if sorted(state["_weights"]) != sorted(names):
        raise ValueError(
            f"'_weights' of the saved sampler must be of the signals {sorted(names)}, got "
            f"{sorted(state['_weights'])}"
        )
    values = [state["_weights"][name] for name in names]
    weights = torch.tensor(values, dtype=torch.double, device="cpu")
    check_not_negative("'_weights' of the saved sampler", weights)
    check_not_negative(
        "mean reward of the saved sampler", torch.tensor(state["_mean_reward"], device="cpu").abs()
    )
    return Weighing(
        weights.to(device),
        state["_mean_reward"],
        state["_weighed_at"],
        tuple(v if v is None else v.to(device) for v in counted),
        *(state.get(name, 0) for name in ("_counted_writes", "_learned_since")),
    )


def weigh(sampler: Fusing, index: Tensor, last: Weighing | None) -> Weighing:
    """Return the weights of Eqs. (15)-(20), computed again if enough of the buffer changed."""
    table, refresh = sampler.table, sampler.entropy_refresh
    weighing = last or Weighing()
    changed = table.writes - weighing.writes
    due = last is None or refresh == 0 or not 0 <= changed <= refresh * table.size
    if not (due or sampler.recounts):
        return weighing
    if due or sampler.fusion.every_batch:
        names = table.names[table.fused]
        weighing = replace(weighing, weights=checked_weights(sampler.fusion, names, table, index))
    if due:
        if (text := one_sided(sampler)) is not None:
            sampler.warn_once("one side", text)
        mean = float(table.rewards.mean())
        weighing = replace(weighing, mean_reward=mean, writes=table.writes)
    if not any(adjust.counts for adjust in sampler.adjustments):
        return weighing
    return _count(sampler, len(index), weighing)


def _count(sampler: Fusing, batch_size: int, weighing: Weighing) -> Weighing:
    """Have the adjustments count the buffer again, by present weights, if enough of it changed."""
    table = sampler.table
    changed = table.writes - weighing.counted_writes + weighing.learned_since
    few = 0 <= changed <= _COUNT_REFRESH * table.size and sampler.entropy_refresh > 0
    if weighing.counted and few:
        return replace(weighing, learned_since=weighing.learned_since + batch_size)
    fused = sampler.combined(table.rows[: table.size], weighing)
    counted = [
        adjust.count(table, fused) if adjust.counts else None for adjust in sampler.adjustments
    ]
    for value in counted:
        if value is not None:
            check_not_negative("what an adjustment counted", value)
    return replace(
        weighing, counted=tuple(counted), counted_writes=table.writes, learned_since=batch_size
    )


def one_sided(sampler: Fusing) -> str | None:
    """Return a warning if all rewards of a buffer are on one side of the level of a sampler.

    There is none for few rewards, nor for rewards that are all equal, which no level separates.
    """
    level, rewards = sampler.positive_above, sampler.table.rewards
    used = sampler.fusion.uses_level or any(part.uses_level for part in sampler.adjustments)
    if level == "mean" or not used or len(rewards) < _ENOUGH or bool((rewards == rewards[0]).all()):
        return None
    above = int((rewards > level).sum())
    # A boost of goals alone waits for the first of them; the weights of Eq. (17) cannot.
    waits = above == 0 and level > 0 and not sampler.fusion.uses_level
    if waits or 0 < above < len(rewards):
        return None
    return (
        f"{'all' if above else 'none'} of the {len(rewards)} rewards in the buffer are "
        f"above {level}: by Eq. (17) TD error and gradient get no weight next to the "
        "reward, and boost and decay separate no transitions. Set positive_above to a "
        "level between the rewards, or to 'mean', with which all weights are equal"
    )


def warn_of_mean(level: Level, fusion: Fusion) -> None:
    """Warn of a level by which the entropies say nothing of the data."""
    if level == "mean" and fusion.uses_level:
        warnings.warn(
            "positive_above='mean' makes the entropies of Eqs. (16) and (17) one and the same: "
            "all signals get equal weights for any data. With a number between the "
            "rewards the weights follow the data",
            stacklevel=3,
        )
