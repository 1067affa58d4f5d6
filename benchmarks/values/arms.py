"""Table G: what is compared on the frozen buffers, and what was planned to be compared."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl_mpfa.methods import ALIASES, METHODS, Method

LEFT_OUT = {
    "rud": "the policy is held anyway: it is uniform replay",
    "ddpg_radam": "it learns from other rewards, whose values are others",
}
"""Methods of the catalogue that cannot be compared here, and why."""
AGAINST = "per"
"""What every arm is compared with."""

PARTS: dict[str, dict[str, Any]] = {
    "reward": {"signals": ["reward"]},
    "td_error": {"signals": ["td_error"]},
    "gradient": {"signals": ["action_gradient"]},
    "reward+td_error": {"signals": ["reward", "td_error"]},
    "reward+gradient": {"signals": ["reward", "action_gradient"]},
    "td_error+gradient": {"signals": ["td_error", "action_gradient"]},
    "equal_weights": {"fusion": "fixed"},
    "equal_shares": {"fusion": "scaled"},
    "no_boost": {"boost": False},
    "no_decay": {"decay": False},
    "phi2": {"boost_factor": 2.0},
    "phi4": {"boost_factor": 4.0},
    "alpha0.4": {"alpha": 0.4},
    "alpha0.8": {"alpha": 0.8},
    "beta1": {"beta": 1.0},
    # Readings: the population of Eqs. 16-17, what is positive in Eqs. 17 and 22-24, the 1 of
    # Eq. 22, and j of Eq. 23.
    "eq16_batch": {"population": "batch"},
    "eq17_mean": {"positive_above": "mean"},
    "eq22_cap": {"boost_bound": "cap"},
    "eq22_none": {"boost_bound": "none"},
    "eq23_rank": {"decay_position": "rank"},
    "eq23_count": {"decay_position": "count"},
}
"""MPFA-PER with one thing changed."""
STRONGER: dict[str, dict[str, Any]] = {
    "eps0.005": {"eps": 0.005},
    "eps0.005,alpha1": {"eps": 0.005, "alpha": 1.0},
}
"""PER that prioritizes more: its epsilon of 0.05 is not small beside TD errors of 0.1."""


def _varied(base: str, changes: dict[str, dict[str, Any]]) -> dict[str, Method]:
    names = {f"{base}/{name}": settings for name, settings in changes.items()}
    return {name: replace(METHODS[base], name=name, **each) for name, each in names.items()}


ARMS: dict[str, Method] = {
    **{
        name: method
        for name, method in METHODS.items()
        if name not in LEFT_OUT and name not in ALIASES.values()
    },
    "mixture": replace(
        METHODS["mpfa_plus"],
        name="mixture",
        signals=["reward", "td_error"],
        combination="mixture",
    ),
    **_varied("per", STRONGER),
    **_varied("mpfa_per", PARTS),
}
"""All arms by name: the methods of the catalogue, a mixture of the trees of reward and TD error,
and what is changed of PER and of MPFA-PER."""
PLANNED = ("uniform", "mpfa_per", "mpfa_plus", "mpf_per", "mpfa_per/reward", "mpfa_per/td_error")
"""Arms whose difference to :data:`AGAINST` was to be tested before the first run; all others are
exploratory."""
