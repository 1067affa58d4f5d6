"""Options, networks and estimators that the losses reject, by name and before anything changes."""

import math
import re

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Unbounded
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import GAE

from tests.mpfa.losses import BOUNDS, KINDS, make_networks, make_of, without_shortcut
from torchrl_mpfa import SignalDQNLoss, make_critic, make_value_network
from torchrl_mpfa.losses.functional import distance

# TorchRL warns at every loss whose target networks nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

OF_ALL = [
    ({"signals": ["novelty"]}, "signals must be among"),
    ({"gradient_order": 0.0}, "gradient_order must be positive, got 0.0"),
    ({"importance": "actor"}, "importance must be 'critic', 'torchrl' or 'none', got 'actor'"),
    ({"reward_scale": -1.0}, "reward_scale must be positive and finite, got -1.0"),
    ({"reward_scale": 0.0}, "reward_scale must be positive and finite, got 0.0"),
    ({"reward_scale": math.nan}, "reward_scale must be positive and finite, got nan"),
    ({"saturation_penalty": -0.1}, "saturation_penalty must be finite and not negative"),
    ({"saturation_penalty": math.nan}, "saturation_penalty must be finite and not negative"),
    ({"saturation_limit": -1.0}, "saturation_limit must be finite and not negative, got -1.0"),
    ({"pal_alpha": -0.1}, "pal_alpha must be finite and not negative, got -0.1"),
    ({"target_average": 0}, "target_average must be an integer from 1 to 2147483647, got 0"),
    ({"loss_function": "l3"}, "loss_function must be one of .* got 'l3'"),
    *[({"gamma": gamma}, r"gamma must be in \[0, 1\], got") for gamma in (-0.1, 1.1, math.nan)],
]
OF_ONE = [
    ("ddpg", {"policy_noise": 0.1}, "one of action_spec and bounds must be given"),
    ("ddpg", {"policy_noise": -0.1, "bounds": BOUNDS}, "policy_noise must be finite and not neg"),
    ("ddpg", {"policy_noise": 0.1, "bounds": (1.0, -1.0)}, "low < high"),
    ("td3", {"noise_clip": -0.1}, "noise_clip must be finite and not negative, got -0.1"),
    ("td3", {"bounds": None}, "one of action_spec and bounds must be given"),
    ("td3", {"action_spec": Bounded(-1.0, 1.0, (2,))}, "one of action_spec and bounds must be"),
    ("td3", {"bounds": (1.0, -1.0)}, r"bounds must be finite, low < high, got \(1.0, -1.0\)"),
    (
        "td3",
        {"bounds": None, "action_spec": Unbounded((2,))},
        "action_spec must be Bounded, got Unbounded",
    ),
    ("sac", {"value_network": make_critic(5, 2)}, "value_network is not supported"),
    ("sac", {"skip_done_states": True}, "skip_done_states is not supported, got True"),
    ("sac", {"alpha_init": 0.0}, "alpha_init must be positive and finite, got 0.0"),
]


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [*[(kind, *row) for kind in KINDS for row in OF_ALL], *OF_ONE],
)
def test_an_option_out_of_its_range_is_rejected_by_name(kind, options, words):
    with pytest.raises(ValueError, match=words):
        make_of(kind, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"signals": ["action_gradient"]}, "no slope"),
        ({"signals": ["value"]}, r"signals must be among \['td_error'\], got 'value'"),
        ({"importance": "all"}, "importance must be 'critic', 'torchrl' or 'none', got 'all'"),
        ({"reward_scale": 0.0}, "reward_scale must be positive and finite, got 0.0"),
        ({"loss_function": "pal"}, "loss_function must be one of .* got 'pal'"),
        ({"gamma": 1.5}, r"gamma must be in \[0, 1\], got 1.5"),
    ],
    ids=str,
)
def test_an_option_of_dqn_out_of_its_range_is_rejected_by_name(options, words):
    with pytest.raises(ValueError, match=words):
        SignalDQNLoss(make_value_network(4, 5, width=8), **options)


@pytest.mark.parametrize("kind", KINDS)
def test_networks_of_another_kind_or_order_are_rejected_and_left_as_they_are(kind):
    actor, critic = make_networks(stochastic=kind == "sac")
    name = "value_network" if kind == "ddpg" else "qvalue_network"
    blind = TensorDictModule(nn.Linear(5, 1), ["observation"], ["state_action_value"])
    order = f"actor_network and {name} are in the wrong order: actor_network reads 'action'"
    rows = [
        ((critic, actor), ValueError, order),
        ((actor, nn.Linear(5, 1)), TypeError, f"{name} must be a TensorDictModule, got Linear"),
        ((actor, blind), ValueError, f"{name} must read what actor_network writes"),
    ]
    if kind == "sac":
        words = "actor_network must be a ProbabilisticTensorDictSequential, got DirectModule"
        rows[0] = (critic, actor), TypeError, words
        rows.append(((make_networks()[0], critic), TypeError, words))
    else:
        averaged = without_shortcut(actor, critic)
        words = "target_average = 2 needs a DirectModule as critic, got TensorDictModule"
        with pytest.raises(ValueError, match=words):
            make_of(kind, networks=averaged, target_average=2)
    for networks, error, words in rows:
        with pytest.raises(error, match=re.escape(words)):
            make_of(kind, networks=networks)
    make_of(kind, networks=(actor, critic))


@pytest.mark.parametrize("kind", KINDS)
def test_an_estimator_that_makes_no_targets_for_a_critic_of_actions_is_rejected(kind):
    loss = make_of(kind)
    kept = loss.value_estimator
    with pytest.raises(ValueError, match=r"value_type .*GAE"):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.9)
    with pytest.raises(ValueError, match=r"value_type must make one of TD0Estimator.*, got GAE"):
        loss.make_value_estimator(GAE(gamma=0.9, lmbda=0.9, value_network=None))
    assert loss.value_estimator is kept
    assert loss.value_type is ValueEstimators.TD0


def test_an_unknown_distance_is_rejected_by_name():
    with pytest.raises(ValueError, match=r"loss_function must be one of .* got 'l3'"):
        distance(torch.zeros(1), torch.zeros(1), "l3")
