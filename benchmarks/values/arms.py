"""Table G: what is compared on the frozen buffers, and what was planned to be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from benchmarks.paper.methods import RECONSTRUCTIONS
from benchmarks.values.learning import SignalFunction, mirror
from torchrl_mpfa.learners import ActorCritic
from torchrl_mpfa.methods import ALIASES, METHODS, MPFA, Adjusted, Method, Prioritized, Scaled

LEFT_OUT = {
    "rud": "the policy is held anyway: it is uniform replay",
    "ddpg_radam": "it learns from other rewards, whose values are others",
    "her": "it learns for other goals, of which the buffers keep nothing",
}
"""Methods that cannot be compared here, and why."""
AGAINST = "per"
"""Method that every arm is compared with."""

PARTS: dict[str, dict[str, Any]] = {
    "reward": {"signals": ["reward"]},
    "td_error": {"signals": ["td_error"]},
    "gradient": {"signals": ["action_gradient"]},
    "reward+td_error": {"signals": ["reward", "td_error"]},
    "reward+gradient": {"signals": ["reward", "action_gradient"]},
    "td_error+gradient": {"signals": ["td_error", "action_gradient"]},
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
FUSIONS = (
    Adjusted("mpfa_per/equal_weights", signals=MPFA().signals, boost=True, decay=True),
    Scaled(
        "mpfa_per/equal_shares", boost=True, boost_bound="floor", decay=True, positive_above=0.0
    ),
)
"""MPFA-PER with other weights."""
STRENGTHS: dict[str, dict[str, dict[str, Any]]] = {
    # An epsilon of 0.05 is not small beside TD errors of 0.1.
    "per": {
        "eps0.005": {"eps": 0.005},
        "eps0.005,alpha1": {"eps": 0.005, "alpha": 1.0},
        "eps0.005,alpha1.5": {"eps": 0.005, "alpha": 1.5},
    },
    "mpfa_per": {"floor0.2": {"weight_floor": 0.2}, "alpha1": {"alpha": 1.0}},
    "mpfa_plus": {"alpha0.3": {"alpha": 0.3}, "alpha1": {"alpha": 1.0}},
}
"""Kinds of priorities at several strengths."""


@dataclass(frozen=True)
class Arm:
    """Method and signals that learn from the buffers."""

    method: Method
    mirrored: bool = False
    """True if half of each batch is mirrored, as in the trainings of the study."""
    signals: Mapping[str, SignalFunction] = field(default_factory=dict)
    """Functions that write signals of the method."""


def both_images(learner: ActorCritic, batch: TensorDictBase) -> Tensor:
    """Mean TD error of a transition and of its mirror image, ``[B]``."""
    squares = []
    with torch.no_grad():
        for rows in (batch.clone(), mirror(chance=1.0)(batch.clone())):
            error = learner.targets_of(rows) - learner.values_of(rows)
            squares.append(error.square().amax(0))
    return torch.stack(squares).sqrt().mean(0) / learner.reward_scale


def _varied(base: Method, changes: dict[str, dict[str, Any]]) -> dict[str, Arm]:
    names = {f"{base.name}/{name}": settings for name, settings in changes.items()}
    return {name: Arm(replace(base, name=name, **each)) for name, each in names.items()}


ARMS: dict[str, Arm] = {
    **{
        name: Arm(method)
        for name, method in {**METHODS, **RECONSTRUCTIONS}.items()
        if name not in LEFT_OUT and name not in ALIASES.values()
    },
    **_varied(METHODS["mpfa_per"], PARTS),
    **{each.name: Arm(each) for each in FUSIONS},
    **{
        name: arm
        for base, changes in STRENGTHS.items()
        for name, arm in _varied(METHODS[base], changes).items()
    },
    "per/mirrored": Arm(replace(METHODS["per"], name="per/mirrored"), mirrored=True),
    "per/both_images": Arm(
        Prioritized("per/both_images", signals=["both_images"]),
        mirrored=True,
        signals={"both_images": both_images},
    ),
}
"""All arms by name: the methods of package and paper, what is changed of them, mirrored batches."""
PLANNED = ("uniform", "mpfa_per", "mpfa_plus", "mpf_per", "mpfa_per/reward", "mpfa_per/td_error")
"""Arms whose difference to :data:`AGAINST` was to be tested before the first run; all others are
exploratory."""
PAIRS = (
    ("mpfa_per/alpha0.4", "per"),
    ("mpfa_plus/alpha0.3", "per"),
    ("mpfa_per/alpha0.8", "per/eps0.005,alpha1"),
    ("mpfa_plus", "per/eps0.005,alpha1"),
    ("mpfa_per/alpha1", "per/eps0.005,alpha1.5"),
    ("mpfa_plus/alpha1", "per/eps0.005,alpha1.5"),
    ("mixture/alpha1", "per/eps0.005,alpha1.5"),
    ("per/both_images", "per/mirrored"),
    ("la3p", "uniform_halves"),
    *((f"{name}/noise", "per/noise") for name in ("uniform", "mpfa_per", "mpfa_plus", "uper")),
)
"""Other arms that are compared: of about equal effective samples, or with one thing changed."""
