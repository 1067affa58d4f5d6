"""The methods, each a choice at five places: signals, fusion, adjustment, selection, learner.

``docs/methods/`` has a page for each. A method of your own is a :class:`Method` with other
settings, or one more entry in :data:`METHODS`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from torchrl_mpfa.checks import (
    BELOW_ONE,
    COUNT,
    COUNT_OR_ZERO,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Rule,
    check,
)

SWITCH: Rule = (lambda value: isinstance(value, bool), "true or false")


def _within(rule: Rule, default: Any) -> Any:
    """A setting with its range and its default."""
    return field(default=default, metadata={"rule": rule})


@dataclass
class Method:
    """MPFA-PER, and what every method can choose.

    Examples:
        >>> Method("mine", ["td_error", "novelty"], fusion="scaled", boost=False).alpha
        0.6
    """

    name: str = "mpfa_per"
    """Name of the method."""
    signals: list[str] = field(default_factory=lambda: ["reward", "td_error", "action_gradient"])
    """Signals of the priority."""
    fusion: str = "entropy"
    """``entropy`` (Eqs. 15-20), ``fixed`` (equal weights), ``scaled`` (equal shares: each signal
    is divided by its mean) or ``value_schedule`` (HVPER)."""
    weight_floor: float = _within(BELOW_ONE, 0.0)
    """Least weight of a signal by ``entropy``: without one the reward alone counts until the first
    goal; 0: none, as in the paper."""
    combination: str = "sum"
    """Combination of the weighted signals: their ``sum`` (Eq. 21) or ``product``, or a
    ``mixture``: each signal has its own tree, and its share of a batch. The latter two need no
    scale: ``scaled`` is the same as ``fixed``."""
    boost: bool = _within(SWITCH, True)
    """Raise positive transitions, Eq. 22."""
    decay: bool = _within(SWITCH, True)
    """Decay positive transitions above the batch mean, Eqs. 23-24."""
    priority_floor: float = _within(NOT_NEGATIVE, 0.0)
    """Least priority, in units of the reward (LAP's 1); 0: none."""
    floor_quantile: float = _within(SHARE, 0.0)
    """Share of the priorities in the buffer below which the floor, and with it the bend of the
    loss, moves; 0: the floor is a constant."""
    replay_penalty: float = _within(NOT_NEGATIVE, 0.0)
    """Penalty on replays (HVPER); 0: none."""
    reliability: float = _within(NOT_NEGATIVE, 0.0)
    """omega of ReaPER: power of how reliable a TD error is; 0: none. It needs ``prioritized`` and
    no ``mixture``, and transitions must have ``"episode"``."""
    selection: str = "prioritized"
    """``prioritized`` (Eq. 8), ``uniform``, ``newest`` (uniform, and the newest transition),
    ``geometric`` (the older, the less often), ``rank``, ``capped`` (MW), ``split`` (LA3P),
    ``apart`` and ``together`` (the same, but the actor's part is uniform, or by priority),
    ``halves`` (two updates on uniform halves) or ``near_policy`` (ReF-ER)."""
    far_share: float = _within(SHARE, 0.1)
    """Share of transitions that may be far from the policy before ``near_policy`` holds it."""
    far_cutoff: float = _within(POSITIVE, 4.0)
    """C of ``near_policy``: a ratio of densities of 1 + C or its inverse is far."""
    recency: float = _within(NOT_NEGATIVE, 3.0)
    """c of ``geometric``: the newest transition is sampled e^c times as often as the oldest."""
    candidates: int = _within(COUNT, 1)
    """Batches of which the most on-policy one is trained on (KLPER)."""
    replay_cap: int = _within(COUNT, 1024)
    """Replays after which ``capped`` excludes a transition."""
    capacity: int = _within(COUNT, 100_000)
    """Transitions that the buffer holds (the paper's Table 1)."""
    batch_size: int = _within(COUNT, 256)
    """Transitions in a batch (the paper's Table 1)."""
    alpha: float = _within(NOT_NEGATIVE, 0.6)
    """Priority exponent, Eq. 8, and the exponent of PAL."""
    beta: float = _within(SHARE, 0.4)
    """Importance exponent at the start, Eq. 10."""
    beta_end: float = _within(SHARE, 1.0)
    """Importance exponent at the end; between the two it rises with the episodes."""
    eps: float = _within(NOT_NEGATIVE, 0.05)
    """Added to every priority, Eq. 21."""
    boost_factor: float = _within(POSITIVE, 3.0)
    """phi of Eq. 22; its upper bound where ``boost_target`` is above 0."""
    boost_target: float = _within(BELOW_ONE, 0.0)
    """Share of the total priority that positive transitions are to have, by a phi that follows how
    rare they are in the buffer; 0: phi is fixed."""
    boost_bound: str = "floor"
    """The 1 of Eq. 22: ``floor``, ``cap`` or ``none``."""
    decay_sharpness: float = _within(POSITIVE, 0.01)
    """sigma of Eq. 23."""
    decay_position: str = "batch"
    """j of Eq. 23: ``batch``, ``rank`` or ``count``."""
    positive_above: Any = 0.0
    """A transition is positive, in Eqs. 17 and 22-24, when its reward is above this: a number, or
    ``mean``, the mean reward of the buffer, for rewards of one sign."""
    population: str = "buffer"
    """Transitions that Eqs. 16-17 count: ``buffer`` or ``batch``."""
    max_priority_within_buffer: bool = _within(SWITCH, True)
    """Whether a fresh transition gets the highest priority in the buffer, or the highest ever."""
    stratified: bool = _within(SWITCH, False)
    """Whether a batch takes one transition from each of equal parts of the total priority."""
    importance: str = "critic"
    """Importance weights: ``critic`` (Eq. 11), ``torchrl`` (both losses) or ``none``."""
    loss_function: str = "l2"
    """Distance of the critic's loss: ``l2`` (Eq. 4), ``smooth_l1`` (Huber) or ``pal``; of LA3P's
    parts, ``l2``, or else PAL for the uniform part and Huber for the other."""
    target_average: int = _within(COUNT, 1)
    """Critics of which the target is the mean, one more kept at each end of an episode."""
    optimizer: str = "adam"
    """``adam`` or ``radam``."""
    update_block: int = _within(COUNT, 1)
    """Actions between two blocks of updates, of which there are as many as otherwise (RUD)."""
    curiosity: bool = _within(SWITCH, False)
    """Whether rewards get a bonus for what the robot could not foresee (ICM)."""
    curiosity_scale: float = _within(POSITIVE, 0.01)
    """eta of that bonus."""
    hindsight: int = _within(COUNT_OR_ZERO, 0)
    """Goals for which each episode is learned from once more (HER); 0: none."""


RANGES: dict[str, Rule] = {
    each.name: each.metadata["rule"] for each in fields(Method) if "rule" in each.metadata
}
"""The rule of each setting that is a number or a switch."""


def check_ranges(method: Method) -> None:
    """Reject a number or a switch of a method that is out of its range, by name and value."""
    for name, rule in RANGES.items():
        check(rule, **{name: getattr(method, name)})


_PLAIN: dict[str, Any] = {"fusion": "fixed", "boost": False, "decay": False}
_PER: dict[str, Any] = {**_PLAIN, "signals": ["td_error"]}
_UNIFORM: dict[str, Any] = {**_PLAIN, "signals": [], "selection": "uniform"}
_LAP: dict[str, Any] = {
    **_PER,
    "eps": 0.0,
    "alpha": 0.4,
    "priority_floor": 1.0,
    "max_priority_within_buffer": False,
    "importance": "none",
    "loss_function": "smooth_l1",
}

METHODS: dict[str, Method] = {
    # The paper's method, and its ablations.
    "mpfa_per": Method(),
    "mpfa_adaptive": Method("mpfa_adaptive", boost_target=0.5, boost_factor=10.0),
    "mpfa_plus": Method(
        "mpfa_plus",
        fusion="scaled",
        # What one gets with boost=True: signals are in units of their means, of which a floor of 1
        # is not one.
        boost=False,
        boost_bound="none",
        # More than a step can bring, and less than a goal.
        positive_above=1.0,
        decay=False,
    ),
    "mpf_per": Method("mpf_per", boost=False, decay=False),
    "td_reward": Method("td_reward", ["reward", "td_error"], boost=False, decay=False),
    "td_loss": Method("td_loss", ["td_error", "action_gradient"], boost=False, decay=False),
    "per": Method("per", **_PER),
    "raise": Method("raise", **{**_PER, "boost": True}),
    "decay": Method("decay", **{**_PER, "decay": True}),
    # What the paper compares with.
    "ddpg": Method("ddpg", **_UNIFORM),
    "klper": Method("klper", **_UNIFORM, candidates=3),
    "averaged_ddpg": Method("averaged_ddpg", **_UNIFORM, target_average=5),
    "hvper": Method(
        "hvper",
        ["relative_value", "relative_td_error"],
        fusion="value_schedule",
        boost=False,
        decay=False,
        replay_penalty=0.25,
        eps=0.01,
    ),
    "ref_er": Method("ref_er", **{**_UNIFORM, "selection": "near_policy", "importance": "critic"}),
    "rud": Method("rud", **_UNIFORM, update_block=1000),
    "ddpg_radam": Method("ddpg_radam", **_PER, optimizer="radam", curiosity=True),
    "mw": Method(
        "mw",
        ["reward", "td_error"],
        fusion="scaled",
        boost=False,
        decay=False,
        selection="capped",
    ),
    # What else there is today.
    "rank_per": Method("rank_per", **_PER, selection="rank", alpha=0.7, beta=0.5),
    "reaper": Method(
        "reaper", **_PER, reliability=0.3, alpha=0.3, max_priority_within_buffer=False
    ),
    "uper": Method("uper", **{**_PER, "signals": ["information_gain"], "eps": 0.01}),
    "lap": Method("lap", **_LAP),
    "pal": Method("pal", **_UNIFORM, loss_function="pal", alpha=0.4),
    "la3p": Method("la3p", **_LAP, selection="split"),
    "uniform_halves": Method("uniform_halves", **{**_UNIFORM, "selection": "halves"}),
    "cer": Method("cer", **{**_UNIFORM, "selection": "newest"}),
    "geometric": Method("geometric", **{**_UNIFORM, "selection": "geometric"}),
    "her": Method("her", **_UNIFORM, hindsight=4),
    # Another word for uniform replay, for learners that are not DDPG.
    "uniform": Method("uniform", **_UNIFORM),
}
"""Every method by name."""

ALIASES = {"uniform": "ddpg"}
"""Second names, which pages and figures leave out."""
