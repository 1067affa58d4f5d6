"""The replay of a training run, put together from the settings of its method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.data import RandomSampler

from methods import Method
from torchrl_mpfa import (
    MPFA_SIGNALS,
    Adjustment,
    Draw,
    EntropyFusion,
    FixedFusion,
    Fusion,
    PositiveBoost,
    PositiveDecay,
    ScaledFusion,
    Selection,
    Signal,
    SignalReplayBuffer,
    SignalSampler,
    SignalTensorStorage,
    one_batch,
)
from torchrl_mpfa.methods import (
    RELATIVE_ERROR,
    RELATIVE_VALUE,
    CappedSampler,
    CombinedSampler,
    LA3PSampler,
    LowestDivergence,
    PriorityFloor,
    RankSampler,
    ReplayPenalty,
    split_draws,
    value_schedule,
)

SIGNALS = {signal.name: signal for signal in (*MPFA_SIGNALS, RELATIVE_VALUE, RELATIVE_ERROR)}
FUSIONS: dict[str, Callable[[Method], Fusion]] = {
    "entropy": lambda method: EntropyFusion(population=method.population),  # type: ignore[arg-type]
    "fixed": lambda method: _equal(method),
    "scaled": lambda method: ScaledFusion(_equal(method)),
    "value_schedule": lambda method: value_schedule(),
}
UNIFORM: dict[str, Callable[[], RandomSampler]] = {
    "uniform": RandomSampler,
    "newest": CombinedSampler,
}
PRIORITIZED: dict[str, type[SignalSampler]] = {
    "prioritized": SignalSampler,
    "rank": RankSampler,
    "capped": CappedSampler,
    "split": LA3PSampler,
}


def signals_of(method: Method) -> list[Signal]:
    """The signals that a method names; an unknown name is one that the loss learns."""
    return [SIGNALS.get(name, Signal(name)) for name in method.signals]


def learned_signals(method: Method) -> list[str]:
    """What the loss has to write for the signals of a method."""
    keys = [signal.key for signal in signals_of(method) if signal.known_at == "update"]
    return sorted({key[-1] if isinstance(key, tuple) else key for key in keys})


def _equal(method: Method) -> FixedFusion:
    return FixedFusion(dict.fromkeys(method.signals, 1.0))


def make_adjustments(method: Method) -> list[Adjustment]:
    """What the method does to fused priorities, in this order."""
    made: list[Adjustment] = []
    if method.boost:
        boost = PositiveBoost(boost=method.boost_factor, bound=method.boost_bound)  # type: ignore[arg-type]
        made.append(boost)
    if method.decay:
        decay = PositiveDecay(
            sharpness=method.decay_sharpness,
            position=method.decay_position,  # type: ignore[arg-type]
        )
        made.append(decay)
    if method.priority_floor > 0:
        made.append(PriorityFloor(method.priority_floor))
    if method.replay_penalty > 0:
        made.append(ReplayPenalty(penalty=method.replay_penalty, floor=method.eps))
    return made


def make_sampler(method: Method) -> SignalSampler | RandomSampler:
    """The sampler that the settings describe: signals, fusion, adjustments, selection."""
    if method.selection in UNIFORM:
        return UNIFORM[method.selection]()
    for word, known in (("selection", {*UNIFORM, *PRIORITIZED}), ("fusion", set(FUSIONS))):
        if getattr(method, word) not in known:
            raise ValueError(
                f"method.{word} must be one of {sorted(known)}, got {getattr(method, word)!r}"
            )
    more: dict[str, Any] = {}
    if method.selection == "capped":
        more["replay_cap"] = method.replay_cap
    return PRIORITIZED[method.selection](
        method.capacity,
        method.alpha,
        method.beta,
        method.eps,
        max_priority_within_buffer=True,
        signals=signals_of(method),
        fusion=FUSIONS[method.fusion](method),
        adjustments=make_adjustments(method),
        **more,
    )


def make_buffer(method: Method, *, seed: int) -> SignalReplayBuffer:
    """Storage, sampler and buffer, with a generator of their own."""
    sampler = make_sampler(method)
    size = method.batch_size * method.candidates
    return SignalReplayBuffer(
        # As the environment gives it: each write would be converted to a device that is named.
        storage=SignalTensorStorage(
            method.capacity, signals=signals_of(method) or MPFA_SIGNALS, device="auto"
        ),
        sampler=sampler,
        batch_size=size,
        generator=torch.Generator().manual_seed(seed),
    )


def make_selection(
    method: Method, policy: TensorDictModule, sigma: Callable[[], float]
) -> Selection:
    """How the batches of a training step are chosen.

    Args:
        method: The method.
        policy: The present policy, which some methods ask.
        sigma: Tells the present spread of the exploration.
    """
    if method.selection == "split":
        return split_draws
    if method.candidates > 1:
        choose = LowestDivergence(policy, batches=method.candidates, sigma=sigma)
        return lambda buffer: iter([Draw(choose(buffer.sample()))])
    return one_batch
