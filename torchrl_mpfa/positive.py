"""Positive transitions: those whose reward is above a level, 0 in the paper."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal

from torch import Tensor

Level = float | Literal["mean"]
"""A reward, or ``"mean"``: the mean reward of the buffer."""
_ENOUGH = 1000
"""With fewer rewards there is no warning that all are on one side."""


def check_level(positive_above: Level) -> None:
    """Reject a level that is neither a finite number nor ``"mean"``."""
    number = isinstance(positive_above, int | float) and not isinstance(positive_above, bool)
    if positive_above != "mean" and not (number and math.isfinite(positive_above)):
        raise ValueError(
            f"positive_above must be a finite number or 'mean', got {positive_above!r}"
        )


def is_positive(reward: Tensor, positive_above: Level, *, mean: float) -> Tensor:
    """Whether transitions are positive, :math:`r_i > 0` in the paper (Eqs. 17, 22-24), ``[B]``."""
    return reward > (mean if positive_above == "mean" else positive_above)


def level_of(parts: Iterable[object]) -> Level:
    """The level of the first of these parts that has one; 0 without any."""
    levels = (getattr(getattr(part, "fusion", part), "positive_above", None) for part in parts)
    return next((level for level in levels if level is not None), 0.0)


def one_sided(rewards: Tensor, parts: Iterable[object]) -> str | None:
    """A warning if all rewards of a buffer are on one side of a level that parts ask for, or None.

    No level tells rewards apart that are all equal, and few rewards may yet turn out on both sides.
    """
    if len(rewards) < _ENOUGH or bool((rewards == rewards[0]).all()):
        return None
    # A fusion may stand around another one.
    inner = [getattr(part, "fusion", part) for part in parts]
    found = [(getattr(part, "positive_above", "mean"), hasattr(part, "weights")) for part in inner]
    for level in {level for level, _ in found if level != "mean"}:
        above = int((rewards > float(level)).sum())
        # A boost of goals alone waits for the first of them; the weights of Eq. (17) cannot.
        waits = above == 0 and float(level) > 0 and (level, True) not in found
        if above in (0, len(rewards)) and not waits:
            return (
                f"{'all' if above else 'none'} of the {len(rewards)} rewards in the buffer are "
                f"above {level}: by Eq. (17) TD error and gradient get no weight beside the "
                "reward, and boost and decay tell no transitions apart. Set positive_above to a "
                "level between the rewards, or to 'mean', with which all weights are equal"
            )
    return None
