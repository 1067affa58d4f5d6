"""Numbers of NumPy and tensors of one number: what keeps them keeps Python's own."""

import io

import numpy as np
import pytest
import torch

from benchmarks.paper.methods.hvper import HVPERPenalty, ScheduledFusion
from benchmarks.paper.methods.klper import KLPERSelection
from benchmarks.paper.methods.mw import MWSampler
from tests.mpfa.learning import make_discrete, make_learner, make_networks
from tests.mpfa.transitions import make_filled
from torchrl_mpfa import (
    EntropyFusion,
    FixedFusion,
    MPFASampler,
    PositiveBoost,
    PositiveDecay,
    SignalReplayBuffer,
    SignalTensorStorage,
)
from torchrl_mpfa.checks import COUNT, SHARE, check
from torchrl_mpfa.methods import METHODS
from torchrl_mpfa.methods.geometric import GeometricSampler
from torchrl_mpfa.methods.lap import LAPFloor
from torchrl_mpfa.methods.reaper import ReaPERSampler
from torchrl_mpfa.methods.ref_er import ReFERSelection

HALF, THREE = np.float32(0.5), np.int64(3)


def numbers_of_numpy(value, place=""):
    """Places of NumPy's numbers in the attributes and entries of a value."""
    if isinstance(value, np.generic):
        return [place]
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list | tuple):
        entries = enumerate(value)
    else:
        entries = vars(value).items() if type(value).__module__.startswith("torchrl_mpfa") else ()
    return [found for key, each in entries for found in numbers_of_numpy(each, f"{place}/{key}")]


def annealed(kept, *arguments):
    kept.anneal(*arguments)
    return kept


def with_alpha_and_beta():
    buffer = make_filled()
    buffer.sampler.alpha = HALF
    buffer.anneal(HALF, HALF)
    return buffer.sampler.state_dict()


KEPT = {
    "rates": lambda: make_learner("sac", actor_lr=HALF, alpha_lr=HALF, tau=HALF).optimizer,
    "decay and delay": lambda: make_learner("td3", critic_weight_decay=HALF, policy_delay=THREE),
    "options": lambda: make_learner(
        "td3", gamma=HALF, policy_noise=HALF, noise_clip=HALF, reward_scale=HALF, pal_alpha=HALF
    ),
    "penalty and order": lambda: make_learner(
        "sac", saturation_penalty=HALF, saturation_limit=HALF, gradient_order=HALF, alpha=HALF
    ),
    "lowered rates": lambda: annealed(make_learner("ddpg"), HALF).state_dict(),
    "rate of Q": lambda: make_discrete(lr=HALF, weight_decay=HALF).state_dict(),
    "capacity and batch": lambda: SignalReplayBuffer(
        storage=SignalTensorStorage(np.int64(8)),
        sampler=MPFASampler(np.int64(8), HALF, HALF, HALF, positive_above=HALF),
        batch_size=THREE,
    ).state_dict(),
    "alpha and beta": with_alpha_and_beta,
    "boost": lambda: PositiveBoost(HALF),
    "decay": lambda: PositiveDecay(HALF),
    "floor": lambda: EntropyFusion(floor=HALF),
    "weights": lambda: FixedFusion({"td_error": HALF}),
    "scheduled weights": lambda: annealed(ScheduledFusion({"a": HALF}, {"a": 1.0}), HALF),
    "recency": lambda: GeometricSampler(recency=HALF),
    "penalty": lambda: HVPERPenalty(HALF, HALF),
    "KLPER": lambda: KLPERSelection(make_networks()[0], batches=THREE, sigma=HALF),
    "LAP": lambda: LAPFloor(HALF),
    "cap": lambda: MWSampler(8, 0.6, 0.4, signals=["td_error"], replay_cap=THREE),
    "reliability": lambda: ReaPERSampler(8, 0.6, 0.4, signals=["td_error"], exponent=HALF),
    "ReF-ER": lambda: ReFERSelection(make_networks()[0], far_share=HALF, cutoff=HALF),
    "method": lambda: type(METHODS["mpfa_per"])(capacity=THREE, alpha=HALF, beta=HALF, eps=HALF),
}


@pytest.mark.parametrize("name", KEPT)
def test_number_of_numpy_is_kept_as_one_of_python(name):
    kept = KEPT[name]()
    assert numbers_of_numpy(kept) == []
    if isinstance(kept, dict):
        file = io.BytesIO()
        torch.save(kept, file)
        file.seek(0)
        torch.load(file, weights_only=True)


def test_checked_values_are_returned_as_plain_numbers_in_their_order():
    assert check(SHARE, a=torch.tensor(0.25), b=np.float32(0.5)) == (0.25, 0.5)
    assert type(check(COUNT, count=np.uint8(3))) is int
