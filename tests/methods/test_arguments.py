"""Arguments of the methods' parts that cannot be: each error names the argument and its value."""

import math

import pytest
import torch

from torchrl_mpfa import SignalTensorStorage, make_actor
from torchrl_mpfa.learners.base import make_optimizer
from torchrl_mpfa.methods.curiosity import Curiosity
from torchrl_mpfa.methods.geometric import GeometricSampler
from torchrl_mpfa.methods.hvper import HVPERPenalty, value_schedule
from torchrl_mpfa.methods.klper import KLPERSelection, gaussian_divergence
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.lap import LAPFloor
from torchrl_mpfa.methods.mw import MWSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.methods.reaper import ReaPERSampler
from torchrl_mpfa.methods.ref_er import ReFERSelection

NO_COUNT = "must be an integer from 1 to 2147483647, got"
NOT_POSITIVE = "must be positive and finite, got"
NEGATIVE = "must be finite and not negative, got"


def of_ten(kind):
    """A sampler of ten slots."""

    def make(**given):
        return kind(10, 0.6, 0.4, **given)

    return make


def of_a_policy(kind):
    """A selection that asks a policy."""

    def make(**given):
        return kind(make_actor(6, 2, width=8), **given)

    return make


def curiosity(**given):
    return Curiosity(6, 2, **given)


def anneal(fraction):
    value_schedule().anneal(fraction)


def bind(**given):
    ReaPERSampler(10, 0.3, 0.4).bind(SignalTensorStorage(10, **given))


ROWS = [
    *[(of_ten(MWSampler), {"replay_cap": n}, f"replay_cap {NO_COUNT}") for n in (0, -1, 1.5, True)],
    (of_ten(RankPERSampler), {"rank_refresh": -1}, f"rank_refresh {NEGATIVE} -1"),
    (of_ten(ReaPERSampler), {"exponent": 0.0}, f"exponent {NOT_POSITIVE} 0"),
    (bind, {"signals": ["td_error"]}, r"must keep the signals \['episode', 'ended'\], got"),
    (
        of_ten(LA3PSampler),
        {"uniform_fraction": 1.0},
        r"uniform_fraction must be in \(0, 1\), got 1.0",
    ),
    *[
        (GeometricSampler, {"recency": value}, f"recency {NEGATIVE} {value}")
        for value in (-0.1, math.inf, math.nan)
    ],
    *[(LAPFloor, {"floor": v}, f"floor {NOT_POSITIVE} {v}") for v in (0.0, -1.0, math.inf)],
    (HVPERPenalty, {"penalty": -1}, f"penalty {NEGATIVE} -1"),
    (HVPERPenalty, {"floor": 0}, f"floor {NOT_POSITIVE} 0"),
    (value_schedule, {"final_share": 2}, r"final_share must be in \[0, 1\], got 2"),
    (anneal, {"fraction": 1.5}, r"fraction must be in \[0, 1\], got 1.5"),
    (of_a_policy(KLPERSelection), {"batches": 0, "sigma": 0.2}, f"batches {NO_COUNT} 0"),
    (of_a_policy(KLPERSelection), {"sigma": -1.0}, f"sigma {NEGATIVE} -1.0"),
    (
        gaussian_divergence,
        {"deviation": torch.zeros(4, 2), "variance": 0.0},
        f"variance {NOT_POSITIVE} 0.0",
    ),
    (of_a_policy(ReFERSelection), {"far_share": 2}, r"far_share must be in \[0, 1\], got 2"),
    (of_a_policy(ReFERSelection), {"cutoff": 0}, f"cutoff {NOT_POSITIVE} 0"),
    (curiosity, {"features": 0}, f"features {NO_COUNT} 0"),
    (curiosity, {"width": 0}, f"width {NO_COUNT} 0"),
    (curiosity, {"scale": -1.0}, f"scale {NOT_POSITIVE} -1.0"),
    (curiosity, {"lr": 0.0}, f"lr {NOT_POSITIVE} 0.0"),
    (curiosity, {"forward_share": 2.0}, r"forward_share must be in \[0, 1\], got 2.0"),
    (
        make_optimizer,
        {"name": "sgd", "groups": []},
        "optimizer must be 'adam' or 'radam', got 'sgd'",
    ),
]


@pytest.mark.parametrize(("make", "given", "message"), ROWS)
def test_an_argument_that_cannot_be_is_named_with_its_value(make, given, message):
    with pytest.raises(ValueError, match=message):
        make(**given)
