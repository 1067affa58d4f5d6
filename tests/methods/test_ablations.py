"""The paper's ablations, as the settings have them: which weights, which adjustments."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests import oracles
from tests.methods.replays import make_buffer
from tests.mpfa.transitions import set_signals
from torchrl_mpfa.methods import METHODS

REWARDS = [3.0, -1.0, 0.5, 0.5, -2.0, 0.1, 9.0, -0.2]
ERRORS = [0.2, 1.5, 0.1, 2.0, 0.7, 0.05, 3.0, 1.0]
SLOPES = [1.0, 0.5, 2.0, 0.1, 0.3, 1.2, 0.4, 0.9]


def priorities_of(name):
    """Priorities of the eight transitions, eps included, after one update of all of them."""
    method = replace(METHODS[name], capacity=8, batch_size=4)
    sampler = method.sampler()
    buffer = make_buffer(sampler, 8, 4, filled=0)
    buffer.extend(TensorDict({"next": {"reward": torch.tensor(REWARDS).unsqueeze(1)}}, [8]))
    set_signals(buffer, td_error=torch.tensor(ERRORS), action_gradient=torch.tensor(SLOPES))
    return sampler.priorities(torch.arange(8)).tolist()


def share_of_the_reward(others):
    """Weight of the reward beside signals that have the entropy of positive training."""
    of_reward, of_positive = (
        oracles.entropy_of_reward(REWARDS),
        oracles.entropy_of_positive(REWARDS),
    )
    return of_reward / (of_reward + others * of_positive)


def fused(of_reward, of_error, of_slope):
    rows = zip(REWARDS, ERRORS, SLOPES, strict=True)
    return [of_reward * abs(r) + of_error * d + of_slope * g + 0.05 for r, d, g in rows]


def boosted(priorities):
    pairs = zip(REWARDS, priorities, strict=True)
    return [max(3.0 * p, 1.0) if reward > 0 else p for reward, p in pairs]


def decayed(priorities):
    mean = sum(priorities) / len(priorities)
    return [
        p / (1 + math.exp(-0.01 * j)) if r > 0 and p > mean else p
        for j, (r, p) in enumerate(zip(REWARDS, priorities, strict=True), 1)
    ]


ONE, TWO = share_of_the_reward(1), share_of_the_reward(2)
ALL = fused(TWO, (1 - TWO) / 2, (1 - TWO) / 2)
ABLATIONS = {
    "per": fused(0, 1, 0),
    "td_reward": fused(ONE, 1 - ONE, 0),
    "td_loss": fused(0, 0.5, 0.5),
    "mpf_per": ALL,
    "raise": boosted(fused(0, 1, 0)),
    "decay": decayed(fused(0, 1, 0)),
    "mpfa_per": decayed(boosted(ALL)),
}


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablation_has_its_signals_and_adjustments_and_no_others(name):
    assert priorities_of(name) == pytest.approx(ABLATIONS[name], rel=1e-5)
