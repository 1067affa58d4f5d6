"""Constructors of learners, networks and methods: bad arguments are named with values."""

import math
from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from benchmarks.paper.methods.ddpg_radam import Curiosity
from benchmarks.paper.methods.hvper import HVPERPenalty, value_schedule
from benchmarks.paper.methods.klper import KLPERSelection, gaussian_divergence
from benchmarks.paper.methods.mw import MWSampler
from tests.mpfa.learning import BOUNDS, KINDS, make_discrete, make_learner, make_networks
from torchrl_mpfa import (
    DQN,
    ActorCritic,
    make_actor,
    make_critic,
    make_stochastic_actor,
    make_value_network,
)
from torchrl_mpfa.losses import distance
from torchrl_mpfa.methods.geometric import GeometricSampler
from torchrl_mpfa.methods.her import HindsightGoals
from torchrl_mpfa.methods.la3p import LA3PSampler
from torchrl_mpfa.methods.lap import LAPFloor
from torchrl_mpfa.methods.rank_per import RankPERSampler
from torchrl_mpfa.methods.reaper import ReaPERSampler
from torchrl_mpfa.methods.ref_er import ReFERSelection

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
    return make(**{**NETWORKS[make], **given})


def of_ten(kind):
    """Make samplers of ten slots."""
    return partial(kind, 10, 0.6, 0.4)


def of_a_policy(kind):
    """Make selections that ask a policy."""
    return lambda **given: kind(make_actor(6, 2, width=8), **given)


def rows(make, argument, values, rule):
    """Reject each of several values of an argument by the same rule."""
    return [(make, {argument: value}, f"{argument} {rule} {value}") for value in values]


def rows_of_all_learners(kind):
    make = partial(make_learner, kind)
    return [
        (make, {"signals": ["novelty"]}, "signals must be among .*: write a signal of your own"),
        (make, {"gradient_order": 0.0}, "gradient_order must be positive, got 0.0"),
        (make, {"importance": "actor"}, "importance must be 'critic', .* or 'none', got 'actor'"),
        *rows(make, "reward_scale", (-1.0, 0.0, NAN), NOT_POSITIVE),
        *rows(make, "saturation_penalty", (-0.1, NAN), NEGATIVE),
        *rows(make, "saturation_limit", (-1.0,), NEGATIVE),
        *rows(make, "pal_alpha", (-0.1,), NEGATIVE),
        *rows(make, "target_average", (0,), NO_COUNT),
        *rows(make, "critics", (0, 1.5), NO_COUNT),
        (make, {"loss_function": "l3"}, "loss_function must be one of .* got 'l3'"),
        *rows(make, "gamma", (-0.1, 1.1, NAN), NO_SHARE),
        *rows(make, "actor_lr", (0.0, NAN, INF), NOT_POSITIVE),
        *rows(make, "critic_lr", (-1.0,), NOT_POSITIVE),
        *rows(make, "critic_weight_decay", (-0.1, NAN, INF), NEGATIVE),
        *rows(make, "tau", (0.0, 1.5, NAN, INF), r"must be in \(0, 1\], got"),
        *rows(make, "policy_delay", (0,), NO_COUNT),
        (make, {"optimizer": "sgd"}, "optimizer must be 'radam' or 'adam', got 'sgd'"),
    ]


td3, sac = partial(make_learner, "td3"), partial(make_learner, "sac")
SLOPE = {"signals": ["action_gradient"]}
ROWS = [
    *[row for kind in KINDS for row in rows_of_all_learners(kind)],
    # Learners.
    (td3, {"bounds": None}, "bounds must be an action spec, or least and greatest action, got Non"),
    (td3, {"bounds": (1.0, -1.0)}, "bounds must be finite, low < high, got 1.0 and -1.0"),
    (td3, {"bounds": Unbounded((2,))}, "action_spec must be Bounded"),
    *rows(partial(make_learner, bounds=BOUNDS), "policy_noise", (-0.1, NAN), NEGATIVE),
    *rows(td3, "noise_clip", (-0.1,), NEGATIVE),
    *rows(sac, "alpha", (0.0,), NOT_POSITIVE),
    *rows(sac, "alpha_lr", (-1.0,), NEGATIVE),
    *rows(sac, "target_entropy", (NAN, INF), "must be finite, got"),
    (make_discrete, SLOPE, "no slope"),
    (make_discrete, {"signals": ["value"]}, r"signals must be among \['td_error'\], got 'value'"),
    (make_discrete, {"importance": "all"}, "importance must be 'critic', .* got 'all'"),
    *rows(make_discrete, "reward_scale", (0.0,), NOT_POSITIVE),
    (make_discrete, {"loss_function": "pal"}, "loss_function must be one of .* got 'pal'"),
    *rows(make_discrete, "gamma", (1.5,), NO_SHARE),
    (
        partial(distance, torch.zeros(1), torch.zeros(1)),
        {"loss_function": "l3"},
        "loss_function must be one of .* got 'l3'",
    ),
    *rows(make_discrete, "lr", (0.0,), NOT_POSITIVE),
    *rows(make_discrete, "weight_decay", (-0.1,), NEGATIVE),
    *rows(make_discrete, "tau", (0.0,), r"must be in \(0, 1\], got"),
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


def shared_by(actor, critic):
    critic.module.first = actor.module.body
    return actor, critic


def blind():
    return TensorDictModule(nn.Linear(5, 1), ["observation"], ["state_action_value"])


def reads_before():
    keys = ["observation", "action", "preactivation"]
    return TensorDictModule(nn.Bilinear(5, 2, 1), keys, ["state_action_value"])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda actor, critic: (critic, actor), ValueError, "actor and critic are in the wrong or"),
        (
            lambda actor, critic: (actor, nn.Linear(5, 1)),
            TypeError,
            "critic must be a TensorDictModule, got Linear",
        ),
        (lambda actor, critic: (len, critic), TypeError, "actor must be a TensorDictModule, got b"),
        (lambda actor, critic: (actor, blind()), ValueError, "critic must read 'action', got"),
        (
            lambda actor, critic: (actor, actor),
            ValueError,
            "critic must read 'action', got .'observation'",
        ),
        (
            lambda actor, critic: (actor, reads_before()),
            ValueError,
            r"critic must read no output of actor but 'action', got \['preactivation'\]",
        ),
    ],
)
def test_networks_of_another_kind_or_order_are_rejected(kind, change, error, words):
    networks = make_networks(stochastic=kind == "sac")
    with pytest.raises(error, match=words):
        make_learner(kind, networks=change(*networks))
    make_learner(kind, networks=networks)


def test_networks_that_share_parameters_are_rejected():
    with pytest.raises(ValueError, match="actor and critic must have parameters of their own"):
        make_learner(networks=shared_by(*make_networks()))


def test_critic_without_a_layer_of_one_output_has_no_quantiles():
    critic = TensorDictModule(
        nn.Bilinear(5, 2, 1), ["observation", "action"], ["state_action_value"]
    )
    with pytest.raises(ValueError, match="'information_gain' needs a critic whose last linear la"):
        make_learner(networks=(make_networks()[0], critic), signals=["information_gain"])


def test_network_of_another_kind_is_rejected():
    with pytest.raises(TypeError, match="network must be a DirectModule, got Linear"):
        DQN(nn.Linear(4, 5))


def test_sampler_of_reliability_rejects_signals_without_the_td_error():
    with pytest.raises(ValueError, match=r"signals must have 'td_error', got \['reward'\]"):
        ReaPERSampler(10, 0.3, 0.4, signals=["reward"])


@pytest.mark.parametrize("kind", KINDS)
def test_rates_by_default_are_those_of_table_1_and_a_light_decay(kind):
    noise = {"policy_noise": 0.2, "bounds": BOUNDS} if kind == "td3" else {}
    learner = ActorCritic(*make_networks(stochastic=kind == "sac"), **noise)
    groups = learner.optimizer.param_groups
    assert [group["lr"] for group in groups[:2]] == [1e-4, 1e-4]
    assert [group["weight_decay"] for group in groups[:2]] == [0.0, 1e-4]
    assert learner.policy_delay == (2 if kind == "td3" else 1)
