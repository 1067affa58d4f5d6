"""The replay of a method: buffer, selection, and the signals that the loss has to write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.data import RandomSampler, Storage

from torchrl_mpfa.adjustment import Adjustment, PositiveBoost, PositiveDecay
from torchrl_mpfa.checks import SHARE, check
from torchrl_mpfa.fusion import EntropyFusion, FixedFusion, Fusion
from torchrl_mpfa.losses.functional import BEHAVIOR
from torchrl_mpfa.methods.catalogue import METHODS, Method, check_ranges
from torchrl_mpfa.methods.cer import CERSampler
from torchrl_mpfa.methods.geometric import GeometricSampler
from torchrl_mpfa.methods.halves import uniform_halves
from torchrl_mpfa.methods.hvper import (
    RELATIVE_ERROR,
    RELATIVE_VALUE,
    HVPERPenalty,
    value_schedule,
)
from torchrl_mpfa.methods.klper import KLPERSelection
from torchrl_mpfa.methods.la3p import ACTOR_PARTS, LA3PSampler, la3p_batches
from torchrl_mpfa.methods.lap import LAPFloor
from torchrl_mpfa.methods.mw import MWSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.methods.reaper import ENDED, EPISODE, ReaPERSampler
from torchrl_mpfa.methods.ref_er import ReFERSampler, ReFERSelection
from torchrl_mpfa.moving_fusion import ScaledFusion
from torchrl_mpfa.positive import check_level
from torchrl_mpfa.replay import SignalReplayBuffer
from torchrl_mpfa.samplers.mixture import MixtureSampler
from torchrl_mpfa.samplers.signal_sampler import SignalSampler
from torchrl_mpfa.selection import Selection, one_batch
from torchrl_mpfa.signals import MPFA_SIGNALS, Signal
from torchrl_mpfa.spelling import unknown
from torchrl_mpfa.storages.table import signal_table_of
from torchrl_mpfa.storages.tensor import SignalTensorStorage

_SIGNALS = {signal.name: signal for signal in (*MPFA_SIGNALS, RELATIVE_VALUE, RELATIVE_ERROR)}
_FUSIONS: dict[str, Callable[[Method], Fusion]] = {
    "entropy": lambda method: EntropyFusion(
        population=method.population,  # type: ignore[arg-type]
        positive_above=method.positive_above,
        floor=method.weight_floor,
    ),
    "fixed": lambda method: _equal(method),
    "scaled": lambda method: ScaledFusion(_equal(method)),
    "value_schedule": lambda method: value_schedule(),
}
_UNIFORM: dict[str, Callable[[Method], RandomSampler]] = {
    "uniform": lambda method: RandomSampler(),
    "halves": lambda method: RandomSampler(),
    "newest": lambda method: CERSampler(),
    "near_policy": lambda method: ReFERSampler(),
    "geometric": lambda method: GeometricSampler(recency=method.recency),
}
_PRIORITIZED: dict[str, type[SignalSampler]] = {
    "prioritized": SignalSampler,
    "rank": RankPERSampler,
    "capped": MWSampler,
    **dict.fromkeys(ACTOR_PARTS, LA3PSampler),
}
_OF_PRIORITIES = ("combination", "floor_quantile", "priority_floor", "replay_penalty")
WORDS: dict[str, set[str]] = {
    "selection": {*_UNIFORM, *_PRIORITIZED},
    "fusion": set(_FUSIONS),
    "combination": {"sum", "product", "mixture"},
    "boost_bound": {"floor", "cap", "none"},
    "decay_position": {"batch", "rank", "count"},
    "population": {"buffer", "batch"},
    "importance": {"critic", "torchrl", "none"},
    "loss_function": {"l2", "smooth_l1", "pal"},
    "optimizer": {"adam", "radam"},
}
"""The words of each setting that is a word."""


@dataclass(frozen=True)
class Replay:
    """The replay of a method.

    Attributes:
        buffer: Where transitions are stored and sampled.
        select: Samples the batches of one training step from the buffer.
        signals: The signals that the loss has to write, by name.
        method: The settings that it was made from.
        entries: Names of the entries that transitions must have beside the usual: ``"episode"``, a
            number, shape ``[B, 1]``; ``"behavior_mean"``, the action without its noise, ``[B, A]``,
            and ``"behavior_sigma"``, the standard deviation of that, ``[B, 1]``.
    """

    buffer: SignalReplayBuffer
    select: Selection
    signals: tuple[str, ...]
    method: Method
    entries: tuple[str, ...] = ()

    def anneal(self, fraction: float) -> None:
        """Move beta of Eq. (10), linearly, and the weights of a fusion with a schedule.

        Args:
            fraction: How much of the training is done.

        Raises:
            ValueError: If ``fraction`` is not in [0, 1].

        Examples:
            >>> replay = make_replay("per", capacity=1_000)
            >>> replay.anneal(0.5)
            >>> replay.buffer.sampler.beta
            0.7
        """
        check(SHARE, fraction=fraction)
        start, end = self.method.beta, self.method.beta_end
        self.buffer.anneal(start + (end - start) * fraction, fraction)


def make_replay(
    method: str | Method = "mpfa_per",
    *,
    capacity: int | None = None,
    batch_size: int | None = None,
    generator: torch.Generator | None = None,
    storage: Storage | None = None,
    device: torch.device | str = "auto",
    policy: TensorDictModule | None = None,
    sigma: float | Callable[[], float] | None = None,
    **settings: Any,
) -> Replay:
    """The replay of a method: buffer, selection, and the signals that the loss has to write.

    Args:
        method: A name out of :data:`~torchrl_mpfa.methods.METHODS`, or settings of your own.
        capacity: Slots of the buffer; by default those of the storage, or of the method.
        batch_size: Transitions of a batch; by default the method's.
        generator: Source of all randomness; by default a new one that ``torch.manual_seed`` rules.
        storage: Where the transitions lie; by default a new
            :class:`~torchrl_mpfa.SignalTensorStorage`. It must keep the signals of the method.
        device: Device of a new storage; ``"auto"``: that of the first transition.
        policy: The policy in training, with whose actions KLPER and ReF-ER compare.
        sigma: Standard deviation of the exploration noise in units of the action, for KLPER; or a
            function that gives that of the present episode.
        **settings: Other values for fields of :class:`~torchrl_mpfa.methods.Method`.

    Returns:
        The replay.

    Raises:
        ValueError: If a method, a setting or its value is unknown or out of its range, or if KLPER
            gets no ``policy`` or ``sigma``.
        TypeError: If the storage keeps no signals.

    Examples:
        >>> replay = make_replay("la3p", capacity=10_000, batch_size=256)
        >>> replay.signals
        ('td_error',)
        >>> type(replay.buffer.sampler).__name__
        'LA3PSampler'
    """
    if capacity is None and storage is not None:
        capacity = storage.max_size
    given = {"capacity": capacity, "batch_size": batch_size}
    given = {name: value for name, value in given.items() if value is not None}
    made = _settled(method, {**given, **settings})
    if made.selection == "near_policy" and policy is None:
        raise ValueError(f"method {made.name!r} needs policy: it compares actions with its own")
    if made.candidates > 1 and (policy is None or sigma is None):
        missing = " and ".join(n for n, v in (("policy", policy), ("sigma", sigma)) if v is None)
        raise ValueError(f"method {made.name!r} needs {missing}: it chooses on-policy batches")
    parts = buffer_parts(made, storage=storage, device=device)
    buffer = SignalReplayBuffer(**parts, generator=generator)
    select = make_selection(made, policy, sigma)
    return Replay(buffer, select, tuple(learned_signals(made)), made, entries_of(made))


def buffer_parts(
    method: Method, *, storage: Storage | None = None, device: torch.device | str = "auto"
) -> dict[str, Any]:
    """Storage, sampler and batch size of a method, as arguments of a buffer."""
    kept = [*signals_of(method), *([EPISODE, ENDED] if method.reliability > 0 else [])]
    if storage is None:
        storage = SignalTensorStorage(method.capacity, signals=kept or MPFA_SIGNALS, device=device)
    if method.reliability > 0:
        signal_table_of(storage, kept, method.capacity)
    return {
        "storage": storage,
        "sampler": make_sampler(method),
        "batch_size": method.batch_size * method.candidates,
    }


def loss_options(method: str | Method) -> dict[str, Any]:
    """Keyword arguments of ``make_ddpg_loss`` and its like that a method needs.

    Args:
        method: A name, or settings of your own.

    Returns:
        ``signals``, ``importance``, ``loss_function``, ``target_average`` and ``pal_alpha``.

    Raises:
        ValueError: If the method is unknown.

    Examples:
        >>> loss_options("lap")["loss_function"]
        'smooth_l1'
    """
    made = _settled(method, {})
    return {
        "signals": learned_signals(made),
        "importance": made.importance,
        "loss_function": made.loss_function,
        "target_average": made.target_average,
        "pal_alpha": made.alpha,
    }


def unused_settings(method: Method) -> Iterator[tuple[str, Any, str]]:
    """Settings without effect: name, the value it must have, and the setting that is why."""
    # A method of one's own may have parameters of a boost or a decay that it does not make; one out
    # of the catalogue may have those that it has there.
    uniform, default = method.selection in _UNIFORM, Method()
    named = METHODS.get(method.name, method)
    for base, cause, wrong, names in (
        (default, "selection", uniform, _OF_PRIORITIES),
        (default, "selection", method.selection != "prioritized", ("reliability",)),
        (default, "combination", method.combination == "mixture", ("reliability",)),
        (default, "priority_floor", method.priority_floor == 0, ("floor_quantile",)),
        (default, "fusion", method.fusion != "entropy", ("weight_floor",)),
        (named, "selection", uniform, ("boost", "decay")),
        (named, "boost", not method.boost, ("boost_factor", "boost_target", "boost_bound")),
        (named, "decay", not method.decay, ("decay_sharpness", "decay_position")),
        (named, "curiosity", not method.curiosity, ("curiosity_scale",)),
        # It adds up the errors of an episode's own rows.
        (default, "hindsight", method.hindsight > 0, ("reliability",)),
    ):
        for name in names if wrong else ():
            if getattr(method, name) != getattr(base, name):
                yield name, getattr(base, name), cause


def entries_of(method: Method) -> tuple[str, ...]:
    """Entries that transitions must have beside the usual, see :class:`Replay`."""
    of_behavior = BEHAVIOR if method.selection == "near_policy" else ()
    numbered = method.reliability > 0 or method.hindsight > 0
    return ((EPISODE.name,) if numbered else ()) + of_behavior


def has_one_batch_a_step(method: Method) -> bool:
    """Whether what samples one batch for each update, and no more, trains by the method."""
    own = {*ACTOR_PARTS, "halves", "near_policy"}
    return method.selection not in own and method.candidates == 1


def signals_of(method: Method) -> list[Signal]:
    """The signals that a method names; an unknown name is one that the loss learns."""
    return [_SIGNALS.get(name, Signal(name)) for name in method.signals]


def learned_signals(method: Method) -> list[str]:
    """Entries that the loss has to write for the signals of a method."""
    keys = [signal.key for signal in signals_of(method) if signal.known_at == "update"]
    return sorted({key[-1] if isinstance(key, tuple) else key for key in keys})


def make_sampler(method: Method) -> SignalSampler | RandomSampler:
    """The sampler that the settings describe: signals, fusion, adjustments, selection."""
    if method.selection in _UNIFORM:
        return _UNIFORM[method.selection](method)
    kind, fusion = _PRIORITIZED[method.selection], _FUSIONS[method.fusion](method)
    more: dict[str, Any] = {}
    if method.selection == "capped":
        more["replay_cap"] = method.replay_cap
    if method.combination == "product":
        more["combination"] = "product"
    elif method.combination == "mixture":
        kind = MixtureSampler
    if method.reliability > 0:
        kind, more["exponent"] = ReaPERSampler, method.reliability
    if method.combination != "sum" and isinstance(fusion, ScaledFusion):
        fusion = _equal(method)
    return kind(
        method.capacity,
        method.alpha,
        method.beta,
        method.eps,
        max_priority_within_buffer=method.max_priority_within_buffer,
        stratified=method.stratified,
        signals=signals_of(method),
        fusion=fusion,
        adjustments=make_adjustments(method),
        **more,
    )


def make_adjustments(method: Method) -> list[Adjustment]:
    """The adjustments of fused priorities, in their order."""
    made: list[Adjustment] = []
    if method.boost:
        boost = PositiveBoost(
            boost=method.boost_factor,
            bound=method.boost_bound,  # type: ignore[arg-type]
            positive_above=method.positive_above,
            target_share=method.boost_target,
        )
        made.append(boost)
    if method.decay:
        decay = PositiveDecay(
            sharpness=method.decay_sharpness,
            position=method.decay_position,  # type: ignore[arg-type]
            positive_above=method.positive_above,
        )
        made.append(decay)
    if method.priority_floor > 0:
        made.append(LAPFloor(method.priority_floor, method.floor_quantile))
    if method.replay_penalty > 0:
        made.append(HVPERPenalty(penalty=method.replay_penalty, floor=method.eps))
    return made


def make_selection(
    method: Method, policy: TensorDictModule | None, sigma: float | Callable[[], float] | None
) -> Selection:
    """The selection of a method."""
    if method.selection == "halves":
        return uniform_halves
    if method.selection in ACTOR_PARTS:
        part = ACTOR_PARTS[method.selection]
        return partial(la3p_batches, actor=part, squared=method.loss_function == "l2")
    if method.selection == "near_policy" and policy is not None:
        return ReFERSelection(policy, far_share=method.far_share, cutoff=method.far_cutoff)
    if policy is not None and sigma is not None and method.candidates > 1:
        return KLPERSelection(policy, batches=method.candidates, sigma=sigma).select
    return one_batch


def _equal(method: Method) -> FixedFusion:
    return FixedFusion(dict.fromkeys(method.signals, 1.0))


def _settled(method: str | Method, settings: dict[str, Any]) -> Method:
    """The settings of a method with some of them changed, all of them checked."""
    if isinstance(method, str):
        if method not in METHODS:
            raise ValueError(unknown("method", method, METHODS))
        method = METHODS[method]
    elif not isinstance(method, Method):
        raise TypeError(f"method must be a name or a Method, got {method!r}")
    known = [field.name for field in fields(Method)]
    for name in settings:
        if name not in known:
            raise ValueError(unknown("setting", name, known))
    made = replace(method, **settings)
    for name, words in WORDS.items():
        if getattr(made, name) not in words:
            raise ValueError(unknown(name, getattr(made, name), words))
    if made.combination == "mixture" and made.selection in set(_PRIORITIZED) - {"prioritized"}:
        raise ValueError(
            f"combination 'mixture' needs selection='prioritized', got {made.selection!r}"
        )
    check_level(made.positive_above)
    check_ranges(made)
    for name, only, cause in unused_settings(made):
        raise ValueError(
            f"{name} must be {only!r} with {cause}={getattr(made, cause)!r}, "
            f"which cannot use it, got {getattr(made, name)!r}"
        )
    return made
