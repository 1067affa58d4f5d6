"""MPFA-PER, its ablations and its scaled variant: fused signals, raised and decayed priorities.

Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from torchrl_mpfa.checks import BELOW_ONE, POSITIVE, Rule
from torchrl_mpfa.methods.base import SWITCH, Prioritized, one_of, within

if TYPE_CHECKING:
    from torchrl_mpfa.adjustment import Adjustment
    from torchrl_mpfa.fusion import Fusion

LEVEL: Rule = (
    lambda value: (
        value == "mean"
        or (isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value))
    ),
    "a finite number or 'mean'",
)


@dataclass
class Adjusted(Prioritized):
    """PER whose priorities of positive transitions are raised and decayed (Eqs. 22-24)."""

    boost: bool = within(SWITCH, False)
    """Raise positive transitions, Eq. 22."""
    boost_factor: float = within(POSITIVE, 3.0)
    """phi of Eq. 22; its upper bound where ``boost_target`` is above 0."""
    boost_target: float = within(BELOW_ONE, 0.0)
    """Share of the total priority that positive transitions are to have, by a phi that follows how
    rare they are in the buffer; 0: phi is fixed."""
    boost_bound: str = one_of("floor", "cap", "none")
    """The 1 of Eq. 22: ``floor``, ``cap`` or ``none``."""
    decay: bool = within(SWITCH, False)
    """Decay positive transitions above the batch mean, Eqs. 23-24."""
    decay_sharpness: float = within(POSITIVE, 0.01)
    """sigma of Eq. 23."""
    decay_position: str = one_of("batch", "rank", "count")
    """j of Eq. 23: ``batch``, ``rank`` or ``count``."""
    positive_above: Any = field(default=0.0, metadata={"rule": LEVEL})
    """A transition is positive, in Eqs. 17 and 22-24, when its reward is above this: a number, or
    ``mean``, the mean reward of the buffer, for rewards of one sign."""

    def adjustments(self) -> list[Adjustment]:
        """Make the boost and the decay that are on."""
        from torchrl_mpfa.adjustment import PositiveBoost, PositiveDecay

        parts: list[Adjustment] = []
        if self.boost:
            boost = PositiveBoost(
                boost=self.boost_factor,
                bound=self.boost_bound,  # type: ignore[arg-type]
                target_share=self.boost_target,
            )
            parts.append(boost)
        if self.decay:
            decay = PositiveDecay(
                sharpness=self.decay_sharpness,
                position=self.decay_position,  # type: ignore[arg-type]
            )
            parts.append(decay)
        return parts


@dataclass
class MPFA(Adjusted):
    """MPFA-PER: signals weighted by information entropy (Eqs. 15-21), raised and decayed."""

    name: str = "mpfa_per"
    signals: list[str] = field(default_factory=lambda: ["reward", "td_error", "action_gradient"])
    boost: bool = True
    decay: bool = True
    weight_floor: float = within(BELOW_ONE, 0.0)
    """Least weight of a signal: without one the reward alone counts until the first goal; 0: none,
    as in the paper."""
    population: str = one_of("buffer", "batch")
    """Transitions that Eqs. 16-17 count: ``buffer`` or ``batch``."""

    def fusion(self) -> Fusion:
        """Make the fusion by entropy weights."""
        from torchrl_mpfa.fusion import EntropyFusion

        return EntropyFusion(
            population=self.population,  # type: ignore[arg-type]
            floor=self.weight_floor,
        )


@dataclass
class Scaled(Adjusted):
    """Signals in equal shares: each is divided by its mean."""

    name: str = "mpfa_plus"
    signals: list[str] = field(default_factory=lambda: ["reward", "td_error", "action_gradient"])
    # Signals are in units of their means, of which a floor of 1 is not one.
    boost_bound: str = "none"
    # More than a step can bring, and less than a goal.
    positive_above: Any = 1.0

    def fusion(self) -> Fusion:
        """Make the fusion in equal shares."""
        from torchrl_mpfa.fusion import ScaledFusion

        return ScaledFusion(super().fusion())
