"""Constructors of losses, learners, networks and methods: bad arguments are named with values."""

import math
import pickle
from copy import copy, deepcopy
from functools import partial
from io import BytesIO
from itertools import product

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import GAE

from tests.mpfa.losses import (
    BOUNDS,
    KINDS,
    make_discrete,
    make_learner,
    make_networks,
    make_of,
    without_shortcut,
)
from torchrl_mpfa import (
    ActorCriticLearner,
    DQNLearner,
    SignalDQNLoss,
    TabularQLearner,
    make_actor,
    make_critic,
    make_stochastic_actor,
    make_value_network,
)
from torchrl_mpfa.learners.base import make_optimizer
from torchrl_mpfa.losses.functional import distance
from torchrl_mpfa.methods.curiosity import Curiosity
from torchrl_mpfa.methods.geometric import GeometricSampler
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.methods.hvper import HVPERPenalty, value_schedule
from torchrl_mpfa.methods.klper import KLPERSelection, gaussian_divergence
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.lap import LAPFloor
from torchrl_mpfa.methods.mw import MWSampler
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.methods.reaper import ReaPERSampler
from torchrl_mpfa.methods.ref_er import ReFERSelection
from torchrl_mpfa.networks import make_value_table

# TorchRL warns at every loss whose target networks nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

NAN, INF = math.nan, math.inf
NO_COUNT = "must be an integer from 1 to 2147483647, got"
NOT_POSITIVE = "must be positive and finite, got"
NEGATIVE = "must be finite and not negative, got"
NO_SHARE = r"must be in \[0, 1\], got"
SIZES = {"observation_size": 3, "action_size": 2, "width": 8, "layers": 2}
NETWORKS = {
    make_actor: SIZES,
    make_critic: SIZES,
    make_stochastic_actor: SIZES,
    make_value_network: {"observation_size": 3, "actions": 2, "width": 8, "layers": 2},
    make_value_table: {"cells": 3, "actions": 2},
}
SPEC = Bounded(low=-1.0, high=1.0, shape=(2,))
TWO_SPECS = Bounded(
    low=torch.tensor([[-2.0, 0.0], [0.0, 0.0]]), high=torch.tensor([[2.0, 10.0], [2.0, 10.0]])
)
SPECS = [
    (Unbounded((2,)), "action_spec must be Bounded, got Unbounded"),
    (Categorical(3), "action_spec must be Bounded, got Categorical"),
    (Bounded(low=0, high=3, shape=(2,), dtype=torch.int64), "real numbers, got torch.int64"),
    (Bounded(low=-1.0, high=1.0, shape=(3,)), "must have action_size = 2 entries"),
    (Bounded(low=-1.0, high=math.inf, shape=(2,)), "finite bounds, low < high"),
    (Bounded(low=1.0, high=1.0, shape=(2,)), "finite bounds, low < high"),
    (Composite(a=SPEC, b=SPEC), "action_spec must have one entry, got 2"),
    (TWO_SPECS, "the same bounds for all environments"),
]


def network_with(make, **given):
    """Make a network by valid arguments with some replaced."""
    given = {**NETWORKS[make], **given}
    return make(len, **given) if make is make_value_table else make(**given)


def discrete_loss(**given):
    return SignalDQNLoss(make_value_network(4, 5, width=8), **given)


def of_ten(kind):
    """Make samplers of ten slots."""
    return partial(kind, 10, 0.6, 0.4)


def of_a_policy(kind):
    """Make selections that ask a policy."""
    return lambda **given: kind(make_actor(6, 2, width=8), **given)


def rows(make, argument, values, rule):
    """Reject each of several values of an argument by the same rule."""
    return [(make, {argument: value}, f"{argument} {rule} {value}") for value in values]


def rows_of_all_losses(kind):
    make = partial(make_of, kind)
    return [
        (make, {"signals": ["novelty"]}, "signals must be among"),
        (make, {"gradient_order": 0.0}, "gradient_order must be positive, got 0.0"),
        (make, {"importance": "actor"}, "importance must be 'critic', .* or 'none', got 'actor'"),
        *rows(make, "reward_scale", (-1.0, 0.0, NAN), NOT_POSITIVE),
        *rows(make, "saturation_penalty", (-0.1, NAN), NEGATIVE),
        *rows(make, "saturation_limit", (-1.0,), NEGATIVE),
        *rows(make, "pal_alpha", (-0.1,), NEGATIVE),
        *rows(make, "target_average", (0,), NO_COUNT),
        (make, {"loss_function": "l3"}, "loss_function must be one of .* got 'l3'"),
        *rows(make, "gamma", (-0.1, 1.1, NAN), NO_SHARE),
    ]


def rows_of_all_learners(kind):
    make = partial(make_learner, kind)
    return [
        *rows(make, "actor_lr", (0.0, NAN, INF), NOT_POSITIVE),
        *rows(make, "tau", (0.0, 1.5, NAN, INF), r"must be in \(0, 1\], got"),
        *rows(make, "policy_delay", (0,), NO_COUNT),
    ]


ddpg, td3, sac = (partial(make_of, kind) for kind in KINDS)
noisy = partial(ddpg, policy_noise=0.1)
ONE_OF = "one of action_spec and bounds must be"
SLOPE = {"signals": ["action_gradient"]}
ROWS = [
    *[row for kind in KINDS for row in rows_of_all_losses(kind)],
    *[row for kind in KINDS for row in rows_of_all_learners(kind)],
    # Losses.
    (noisy, {}, ONE_OF),
    (noisy, {"bounds": (1.0, -1.0)}, "low < high"),
    *rows(partial(ddpg, bounds=BOUNDS), "policy_noise", (-0.1,), NEGATIVE),
    *rows(td3, "noise_clip", (-0.1,), NEGATIVE),
    (td3, {"bounds": None}, ONE_OF),
    (td3, {"action_spec": SPEC}, ONE_OF),
    (td3, {"bounds": (1.0, -1.0)}, r"bounds must be finite, low < high, got \(1.0, -1.0\)"),
    (td3, {"bounds": None, "action_spec": Unbounded((2,))}, "action_spec must be Bounded"),
    (sac, {"value_network": make_critic(5, 2)}, "value_network is not supported"),
    (sac, {"skip_done_states": True}, "skip_done_states is not supported, got True"),
    *rows(sac, "alpha_init", (0.0,), NOT_POSITIVE),
    (discrete_loss, SLOPE, "no slope"),
    (discrete_loss, {"signals": ["value"]}, r"signals must be among \['td_error'\], got 'value'"),
    (discrete_loss, {"importance": "all"}, "importance must be 'critic', .* got 'all'"),
    *rows(discrete_loss, "reward_scale", (0.0,), NOT_POSITIVE),
    (discrete_loss, {"loss_function": "pal"}, "loss_function must be one of .* got 'pal'"),
    *rows(discrete_loss, "gamma", (1.5,), NO_SHARE),
    (
        partial(distance, torch.zeros(1), torch.zeros(1)),
        {"loss_function": "l3"},
        "loss_function must be one of .* got 'l3'",
    ),
    # Learners.
    *rows(partial(make_learner, "td3"), "critic_lr", (-1.0, NAN, INF), NOT_POSITIVE),
    *rows(make_learner, "critic_weight_decay", (-0.1, NAN, INF), NEGATIVE),
    *rows(partial(make_learner, "sac"), "alpha_lr", (0.0,), NOT_POSITIVE),
    *rows(make_discrete, "lr", (0.0,), NOT_POSITIVE),
    *rows(make_discrete, "weight_decay", (-0.1,), NEGATIVE),
    *rows(make_discrete, "tau", (0.0,), r"must be in \(0, 1\], got"),
    (partial(TabularQLearner, make_value_table(len, 3, 2)), {"lr": 0.0}, "lr must be in"),
    (
        make_learner,
        {"of_loss": {"reduction": "none"}},
        "reduction of the loss must be 'mean' or 'sum', got 'none'",
    ),
    (partial(make_optimizer, groups=[]), {"name": "sgd"}, "optimizer must be .* got 'sgd'"),
    # Networks.
    *[
        (partial(network_with, make), {name: 0}, f"{name} {NO_COUNT} 0")
        for make, sizes in NETWORKS.items()
        for name in sizes
    ],
    *[
        (partial(network_with, make), {"final_init": -1.0}, f"final_init {NEGATIVE} -1.0")
        for make in list(NETWORKS)[:4]
    ],
    *[
        (partial(network_with, make), {"action_spec": spec}, words)
        for make in (make_actor, make_stochastic_actor)
        for spec, words in SPECS
    ],
    (partial(network_with, make_critic), {"layers": 1}, "layers must be at least 2 with late_act"),
    # Methods.
    *rows(of_ten(MWSampler), "replay_cap", (0, -1, 1.5, True), NO_COUNT),
    *rows(of_ten(RankPERSampler), "rank_refresh", (-1,), NEGATIVE),
    *rows(of_ten(ReaPERSampler), "exponent", (0.0,), NOT_POSITIVE),
    *rows(of_ten(LA3PSampler), "uniform_fraction", (1.0,), r"must be in \(0, 1\), got"),
    *rows(GeometricSampler, "recency", (-0.1, INF, NAN), NEGATIVE),
    *rows(partial(HindsightGoals, None), "goals", (0,), NO_COUNT),
    *rows(LAPFloor, "floor", (0.0, -1.0, INF), NOT_POSITIVE),
    *rows(HVPERPenalty, "penalty", (-1,), NEGATIVE),
    *rows(HVPERPenalty, "floor", (0,), NOT_POSITIVE),
    *rows(value_schedule, "final_share", (2,), NO_SHARE),
    *rows(lambda fraction: value_schedule().anneal(fraction), "fraction", (1.5,), NO_SHARE),
    *rows(partial(of_a_policy(KLPERSelection), sigma=0.2), "batches", (0,), NO_COUNT),
    *rows(of_a_policy(KLPERSelection), "sigma", (-1.0,), NEGATIVE),
    *rows(partial(gaussian_divergence, torch.zeros(4, 2)), "variance", (0.0,), NOT_POSITIVE),
    *rows(of_a_policy(ReFERSelection), "far_share", (2,), NO_SHARE),
    *rows(of_a_policy(ReFERSelection), "cutoff", (0,), NOT_POSITIVE),
    *[
        row
        for name in ("features", "width")
        for row in rows(partial(Curiosity, 6, 2), name, (0,), NO_COUNT)
    ],
    *rows(partial(Curiosity, 6, 2), "scale", (-1.0,), NOT_POSITIVE),
    *rows(partial(Curiosity, 6, 2), "lr", (0.0,), NOT_POSITIVE),
    *rows(partial(Curiosity, 6, 2), "forward_share", (2.0,), NO_SHARE),
]


@pytest.mark.parametrize(("make", "given", "words"), ROWS)
def test_argument_out_of_its_range_is_named_with_its_value(make, given, words):
    with pytest.raises(ValueError, match=words):
        make(**given)


@pytest.mark.parametrize("make", NETWORKS)
def test_arguments_of_the_table_of_networks_are_valid_but_for_the_row(make):
    network_with(make)


@pytest.mark.parametrize("kind", KINDS)
def test_networks_of_another_kind_or_order_are_rejected_and_left_as_they_are(kind):
    actor, critic = make_networks(stochastic=kind == "sac")
    name = "value_network" if kind == "ddpg" else "qvalue_network"
    blind = TensorDictModule(nn.Linear(5, 1), ["observation"], ["state_action_value"])
    order = f"actor_network and {name} are in the wrong order: actor_network reads 'action'"
    kind_of_actor = "actor_network must be a ProbabilisticTensorDictSequential, got DirectModule"
    swapped = (TypeError, kind_of_actor) if kind == "sac" else (ValueError, order)
    cases = [
        ((critic, actor), *swapped),
        ((actor, nn.Linear(5, 1)), TypeError, f"{name} must be a TensorDictModule, got Linear"),
        ((actor, blind), ValueError, f"{name} must read an output of actor_network"),
    ]
    if kind == "sac":
        cases.append(((make_networks()[0], critic), TypeError, kind_of_actor))
    for networks, error, words in cases:
        with pytest.raises(error, match=words):
            make_of(kind, networks=networks)
    make_of(kind, networks=(actor, critic))


@pytest.mark.parametrize("kind", ["ddpg", "td3"])
def test_average_of_critics_that_take_tensordicts_is_rejected(kind):
    words = "target_average = 2 needs a DirectModule as critic, got TensorDictModule"
    with pytest.raises(ValueError, match=words):
        make_of(kind, networks=without_shortcut(*make_networks()), target_average=2)


@pytest.mark.parametrize("kind", KINDS)
def test_estimator_that_makes_no_targets_for_a_critic_of_actions_is_rejected(kind):
    loss = make_of(kind)
    kept = loss.value_estimator
    with pytest.raises(ValueError, match=r"value_type .*GAE"):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.9)
    with pytest.raises(ValueError, match=r"value_type must make one of TD0Estimator.*, got GAE"):
        loss.make_value_estimator(GAE(gamma=0.9, lmbda=0.9, value_network=None))
    assert loss.value_estimator is kept
    assert loss.value_type is ValueEstimators.TD0


COPY = "cannot be copied or pickled: make another one, and have it load"
HOW = [copy, deepcopy, pickle.dumps, partial(torch.save, f=BytesIO())]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ActorCriticLearner(discrete_loss()), "loss must be a SignalLoss, got SignalDQN"),
        (lambda: DQNLearner(make_of("ddpg")), "loss must be a SignalDQNLoss, got SignalDDPGLoss"),
        (lambda: TabularQLearner(make_value_network(4, 5)), "policy must be one of make_value_tab"),
        *[
            (partial(how, make_learner(k)), f"a ActorCriticLearner {COPY}")
            for how, k in product(HOW, KINDS)
        ],
        (partial(deepcopy, make_discrete()), f"a DQNLearner {COPY}"),
    ],
)
def test_learner_of_another_loss_or_a_copy_is_rejected(make, words):
    with pytest.raises(TypeError, match=words):
        make()


def test_sampler_of_reliability_rejects_signals_without_the_td_error():
    with pytest.raises(ValueError, match=r"signals must have 'td_error', got \['reward'\]"):
        ReaPERSampler(10, 0.3, 0.4, signals=["reward"])


@pytest.mark.parametrize("kind", KINDS)
def test_rates_by_default_are_those_of_table_1_and_a_light_decay(kind):
    groups = ActorCriticLearner(make_of(kind)).optimizer.param_groups
    assert [group["lr"] for group in groups[:2]] == [1e-4, 1e-4]
    assert [group["weight_decay"] for group in groups[:2]] == [0.0, 1e-4]
    assert ActorCriticLearner(make_of(kind)).policy_delay == (2 if kind == "td3" else 1)


@pytest.mark.parametrize("kind", KINDS)
def test_learner_of_a_copied_loss_is_rejected_and_one_of_its_state_learns(kind):
    loss = make_of(kind)
    with pytest.raises(ValueError, match="loss must be no copy: make another"):
        ActorCriticLearner(deepcopy(loss))
    other = make_of(kind, networks=make_networks(1, stochastic=kind == "sac"))
    other.load_state_dict(loss.state_dict())
    policy = ActorCriticLearner(other).policy
    expected = loss.actor_network.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in policy.state_dict().items())


def test_policy_of_a_learner_of_a_copied_loss_of_values_is_the_one_that_learns():
    learner = DQNLearner(deepcopy(discrete_loss()))
    trained = learner.loss.value_network_params.values(True, True)
    assert all(a is b for a, b in zip(learner.policy.parameters(), trained, strict=True))
