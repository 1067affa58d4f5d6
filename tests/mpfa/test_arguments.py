"""One table of wrong arguments: each error names the argument and its value."""

import math

import pytest
import torch

from benchmarks.paper.methods.hvper import ScheduledFusion
from tests.mpfa.transitions import make_buffer
from torchrl_mpfa import (
    ActorCritic,
    EntropyFusion,
    FixedFusion,
    MPFASampler,
    PositiveBoost,
    PositiveDecay,
    ScaledFusion,
    Signal,
    SignalMemmapStorage,
    SignalReplayBuffer,
    SignalSampler,
    SignalSliceSampler,
    SignalTensorStorage,
    make_actor,
    make_critic,
    make_stochastic_actor,
    run_updates,
)
from torchrl_mpfa.checks import ABOVE_ZERO, BELOW_ONE, COUNT, NOT_NEGATIVE, POSITIVE, SHARE, check
from torchrl_mpfa.fusion import entropy_weights, positive_entropy, reward_entropy
from torchrl_mpfa.priorities import action_gradient_priority
from torchrl_mpfa.samplers import TreeSampler
from torchrl_mpfa.signals import as_signals

NAN, INF = math.nan, math.inf
NO_NUMBER = "must be a number, got"
NO_COUNT = "must be an integer from 1 to 2147483647, got"
NOT_POSITIVE = "must be positive and finite, got"
NEGATIVE = "must be finite and not negative"
FEW_SIGNALS = "signals must be one or more different signals"


def tree_sampler(**given):
    return TreeSampler(**{"max_capacity": 4, "alpha": 0.6, "beta": 0.4, **given})


def sampler(**given):
    signals = {"signals": ["reward", "td_error"]}
    return SignalSampler(**{"max_capacity": 8, "alpha": 0.6, "beta": 0.4, **signals, **given})


def slice_sampler(**given):
    return SignalSliceSampler(**{"max_capacity": 8, "alpha": 0.6, "beta": 0.4, **given})


def slice_buffer(batch_size):
    make_buffer(8, batch_size, sampler=slice_sampler(slice_len=4))


def mpfa_sampler(**given):
    return MPFASampler(**{"max_capacity": 8, **given})


def buffer(**given):
    return SignalReplayBuffer(storage=SignalTensorStorage(8), **given)


def weight(value):
    return FixedFusion({"td_error": value})


def anneal(fraction):
    ScheduledFusion({"td_error": 1.0}, {"td_error": 1.0}).anneal(fraction)


def gradient(order):
    return action_gradient_priority(torch.ones(1, 2), order=order)


def actor(**given):
    return make_actor(3, 2, **given)


def sac(alpha):
    networks = make_stochastic_actor(3, 2, width=8), make_critic(3, 2, width=8)
    return ActorCritic(*networks, alpha=alpha)


def updates(count):
    run_updates(buffer(batch_size=4), None, updates=count)


def misspelt(name):
    return f"unknown signal of the fusion {name}"


ROWS = [
    (tree_sampler, {"max_capacity": 0}, f"max_capacity {NO_COUNT} 0"),
    (tree_sampler, {"alpha": -1.0}, "alpha must be greater or equal to 0 and finite, got -1.0"),
    (tree_sampler, {"dtype": torch.long}, "dtype must be torch.float32 or .*, got torch.int64"),
    (slice_sampler, {"slice_len": 2.0}, f"slice_len {NO_COUNT} 2.0"),
    (slice_sampler, {"slice_len": 9}, "slice_len must be at most max_capacity, 8, got 9"),
    (slice_sampler, {"slice_len": 2, "slice_priority": "max"}, "unknown slice_priority 'max'"),
    (
        slice_sampler,
        {"slice_len": 2, "device": "meta"},
        "device must be that of a storage on the CPU, got meta",
    ),
    (slice_buffer, {"batch_size": 6}, "batch_size must be a multiple of slice_len, 4, got 6"),
    *[
        (mpfa_sampler, {"positive_above": level}, "positive_above must be a finite number or 'm")
        for level in ("median", None, NAN, True)
    ],
    (mpfa_sampler, {"entropy_refresh": -1.0}, f"entropy_refresh {NEGATIVE}, got -1.0"),
    (mpfa_sampler, {"signals": []}, FEW_SIGNALS),
    (mpfa_sampler, {"fusion": object()}, "fusion must be a torchrl_mpfa.Fusion, got object$"),
    (mpfa_sampler, {"fusion": EntropyFusion}, "Fusion, got the class EntropyFusion$"),
    (mpfa_sampler, {"adjustments": [len]}, "list of .*Adjustment, got builtin_function_or_method$"),
    (
        mpfa_sampler,
        {"adjustments": PositiveBoost()},
        "must be a list of .*Adjustment, got PositiveBoost",
    ),
    (sampler, {"fusion": FixedFusion({"td_eror": 1.0})}, misspelt("'td_eror': did you mean 'td_e")),
    (sampler, {"fusion": ScaledFusion(FixedFusion({"valu": 1.0}))}, misspelt("'valu'")),
    (sampler, {"fusion": EntropyFusion(reward_signals=("rewrd",))}, misspelt("'rewrd'")),
    (sampler, {"fusion": ScheduledFusion({"td_error": 1.0}, {"valu": 1.0})}, misspelt("'valu'")),
    (buffer, {"generator": "seed"}, "generator must be a torch.Generator, got 'seed'"),
    *[
        (kind, {"max_size": size}, f"max_size {NO_COUNT} {size}")
        for kind in (SignalTensorStorage, SignalMemmapStorage)
        for size in (0, -1, True, 2.5, 2**31)
    ],
    (Signal, {"name": ""}, "name must not be empty"),
    (
        Signal,
        {"name": "novelty", "known_at": "never"},
        "known_at must be 'update' or 'write', got 'never'",
    ),
    (Signal, {"name": "a", "priority": "abs"}, "priority must be a function, got 'abs'"),
    (as_signals, {"signals": "novelty"}, "must be a list of signals or their names, got 'novelty'"),
    (EntropyFusion, {"population": "world"}, "population must be .*got 'world'"),
    (EntropyFusion, {"floor": 1.0}, r"floor must be in \[0, 1\), got 1.0"),
    (EntropyFusion, {"reward_signals": "reward"}, "reward_signals must be names, got 'reward'"),
    (weight, {"value": -1.0}, f"weight of 'td_error' {NEGATIVE}, got -1.0"),
    (weight, {"value": 0.0}, "values must have a positive weight"),
    (FixedFusion, {"values": None}, "values must be a weight for each signal, got None"),
    (ScaledFusion, {"fusion": None}, "fusion must be a Fusion, got None"),
    (anneal, {"fraction": 1.1}, r"fraction must be in \[0, 1\], got 1.1"),
    (PositiveBoost, {"boost": 0.0}, f"boost {NOT_POSITIVE} 0.0"),
    (PositiveBoost, {"bound": "wall"}, "bound must be .*got 'wall'"),
    (PositiveBoost, {"target_share": 1.0}, r"target_share must be in \[0, 1\), got 1.0"),
    (
        PositiveBoost,
        {"boost": 0.5, "target_share": 0.3},
        r"boost must be at least 1 with a target_share, got 0\.5",
    ),
    (PositiveDecay, {"position": "front"}, "position must be .*got 'front'"),
    *[
        (entropy, {"reward": torch.empty(0)}, "reward must hold at least one transition")
        for entropy in (reward_entropy, positive_entropy)
    ],
    *[
        (entropy_weights, {"entropies": torch.tensor([0.5, value])}, f"entropies {NEGATIVE}")
        for value in (-0.1, NAN, INF)
    ],
    (gradient, {"order": NAN}, "order must be positive, got nan"),
    (actor, {"final_init": "0"}, f"final_init {NO_NUMBER} '0'"),
    *[(updates, {"count": count}, f"updates {NO_COUNT} {count}") for count in (0, -1, 1.5, True)],
    (sac, {"alpha": NAN}, f"alpha {NOT_POSITIVE} nan"),
]


RULES = {
    "number": (NOT_NEGATIVE, (None, "1", [0.1], torch.rand(2)), NO_NUMBER),
    "count": (COUNT, (0, -1, 1.5, True, 2**31), NO_COUNT),
    "positive": (POSITIVE, (0.0, -1.0, NAN, INF), NOT_POSITIVE),
    "not negative": (NOT_NEGATIVE, (-0.1, NAN, INF), f"{NEGATIVE}, got"),
    "share": (SHARE, (-0.1, 1.1, NAN), r"must be in \[0, 1\], got"),
    "above zero": (ABOVE_ZERO, (0.0, 1.1, NAN), r"must be in \(0, 1\], got"),
    "below one": (BELOW_ONE, (-0.1, 1.0, NAN), r"must be in \[0, 1\), got"),
}
"""Rules that arguments share, values that they reject, and their words."""


@pytest.mark.parametrize("name", RULES)
def test_rule_rejects_every_value_outside_of_its_range(name):
    rule, values, words = RULES[name]
    for value in values:
        with pytest.raises((TypeError, ValueError), match=f"size {words}"):
            check(rule, size=value)


@pytest.mark.parametrize(("make", "given", "message"), ROWS)
def test_wrong_argument_is_named_with_its_value(make, given, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make(**given)
