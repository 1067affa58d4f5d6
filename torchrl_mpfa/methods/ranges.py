"""What the settings of a method may be: one table, which the scripts have their rules from."""

from __future__ import annotations

from torchrl_mpfa.checks import BELOW_ONE, COUNT, NOT_NEGATIVE, POSITIVE, SHARE, Rule, check
from torchrl_mpfa.methods.catalogue import Method

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
    "recency": NOT_NEGATIVE,
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
    for name, rule in RANGES.items():
        check(rule, **{name: getattr(method, name)})
