"""What the settings of a method may be: one table, which the scripts have their rules from."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Integral
from typing import Any

from torchrl_mpfa.methods.catalogue import Method

Rule = tuple[Callable[[Any], bool], str]
"""Whether a value can be, and in words what it must be."""

POSITIVE: Rule = (lambda value: 0.0 < value < math.inf, "positive and finite")
NOT_NEGATIVE: Rule = (lambda value: 0.0 <= value < math.inf, "finite and not negative")
SHARE: Rule = (lambda value: 0.0 <= value <= 1.0, "in [0, 1]")
BELOW_ONE: Rule = (lambda value: 0.0 <= value < 1.0, "in [0, 1)")
COUNT: Rule = (
    lambda value: isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1,
    "a positive integer",
)
SWITCH: Rule = (lambda value: isinstance(value, bool), "true or false")

RANGES: dict[str, Rule] = {
    "boost": SWITCH,
    "decay": SWITCH,
    "priority_floor": NOT_NEGATIVE,
    "floor_quantile": SHARE,
    "replay_penalty": NOT_NEGATIVE,
    "reliability": NOT_NEGATIVE,
    "far_share": SHARE,
    "far_cutoff": POSITIVE,
    "recency": BELOW_ONE,
    "candidates": COUNT,
    "replay_cap": COUNT,
    "capacity": COUNT,
    "batch_size": COUNT,
    "alpha": NOT_NEGATIVE,
    "beta": SHARE,
    "beta_end": SHARE,
    "eps": NOT_NEGATIVE,
    "boost_factor": POSITIVE,
    "boost_target": BELOW_ONE,
    "decay_sharpness": POSITIVE,
    "max_priority_within_buffer": SWITCH,
    "stratified": SWITCH,
    "target_average": COUNT,
    "update_block": COUNT,
    "curiosity": SWITCH,
    "curiosity_scale": POSITIVE,
}
"""By the name of the setting: numbers and switches."""


def check_ranges(method: Method) -> None:
    """Refuse a number or a switch that cannot be.

    Args:
        method: The settings.

    Raises:
        TypeError: If a number is none, with the setting's name and its value.
        ValueError: If it is out of its range, likewise.

    Examples:
        >>> check_ranges(Method(priority_floor=-1.0))
        Traceback (most recent call last):
        ...
        ValueError: priority_floor must be finite and not negative, got -1.0
    """
    for name, (allowed, wanted) in RANGES.items():
        value = getattr(method, name)
        try:
            inside = allowed(value)
        except TypeError:
            raise TypeError(f"{name} must be a number, got {value!r}") from None
        if not inside:
            raise ValueError(f"{name} must be {wanted}, got {value!r}")
