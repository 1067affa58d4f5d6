"""Fusions whose weights move: with the training, or with the scale of the signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from torchrl_mpfa.checks import SHARE, check
from torchrl_mpfa.fusion import FixedFusion, Fusion

if TYPE_CHECKING:
    from torchrl_mpfa.storages.table import SignalTable


@runtime_checkable
class Annealed(Protocol):
    """A part with a schedule over the training."""

    def anneal(self, fraction: float) -> None:
        """Say how much of the training is done, from 0 to 1."""
        ...


@dataclass
class ScheduledFusion:
    """Weights that are interpolated linearly from one set to another over the training.

    Args:
        start: Weight of each signal at the start, by name; a signal without one is not counted.
        end: Weight of each signal at the end.

    Raises:
        ValueError: As :class:`FixedFusion`.

    Examples:
        >>> fusion = ScheduledFusion({"td_error": 1.0}, {"td_error": 0.5, "value": 0.5})
        >>> fusion.anneal(0.5)
        >>> fusion.weights(["td_error", "value"], None, None).tolist()
        [0.75, 0.25]
    """

    start: dict[str, float]
    end: dict[str, float]
    every_batch: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        self._ends = FixedFusion(self.start), FixedFusion(self.end)
        self._fraction = 0.0

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Signals that must be fused."""
        return tuple(dict.fromkeys((*self.start, *self.end)))

    def anneal(self, fraction: float) -> None:
        """Say how much of the training is done, from 0 to 1.

        Raises:
            ValueError: If ``fraction`` is outside.
        """
        check(SHARE, fraction=fraction)
        self._fraction = fraction

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """The present weights in the order of ``names``, shape ``[K]``."""
        start, end = (each.weights(names, table, index) for each in self._ends)
        return start.lerp(end, self._fraction)


@dataclass(frozen=True)
class ScaledFusion:
    """Weights of another fusion for signals that are first divided by their mean in the buffer.

    Signals of different units then have the shares in a priority that their weights say.

    Args:
        fusion: Where the weights come from.

    Examples:
        >>> ScaledFusion(FixedFusion({"reward": 0.5, "td_error": 0.5})).every_batch
        False
    """

    fusion: Fusion

    def __post_init__(self) -> None:
        if not isinstance(self.fusion, Fusion):
            raise TypeError(f"fusion must have a method 'weights', got {self.fusion!r}")

    @property
    def signal_names(self) -> tuple[str, ...]:
        """As the other fusion."""
        return tuple(getattr(self.fusion, "signal_names", ()))

    @property
    def every_batch(self) -> bool:
        """As the other fusion."""
        return bool(getattr(self.fusion, "every_batch", False))

    def anneal(self, fraction: float) -> None:
        """Tell the other fusion how much of the training is done, if it wants to know."""
        if isinstance(self.fusion, Annealed):
            self.fusion.anneal(fraction)

    def weights(self, names: Sequence[str], table: SignalTable, index: Tensor) -> Tensor:
        """Weights divided by the means of the signals, shape ``[K]``."""
        weights = self.fusion.weights(names, table, index)
        places = torch.tensor([table.column[name] for name in names])
        signals = table.rows[: table.size, places]
        mean = signals.nanmean(0).to(weights.dtype)
        # A signal that is zero everywhere, or known of no transition yet, has no scale.
        return weights.to(mean.device) / torch.where(mean > 0, mean, 1.0)
