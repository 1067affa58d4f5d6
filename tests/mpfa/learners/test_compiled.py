"""An update as one program: the same numbers as the losses give, whatever their options."""

import copy

import pytest
import torch
from torch._dynamo.exc import BackendCompilerFailed

from tests.mpfa.compiled import UNTRACED, assert_alike, fail_with, make_pair, update_both
from tests.mpfa.learning import (
    BOUNDS,
    KINDS,
    differentiate,
    gradients_of,
    make_apart,
    make_batch,
    make_learner,
    make_networks,
)
from tests.mpfa.transitions import seeded
from torchrl_mpfa import ActorCritic
from torchrl_mpfa.saving import load_safely, save_atomically

# Gradients of a program are looked at where its steps are taken by another optimizer.
pytestmark = pytest.mark.filterwarnings("ignore:steps of the RAdam are not compiled")

NOISE = {"critics": 1, "policy_noise": 0.3, "bounds": BOUNDS}
OPTIONS = [
    ("td3", {"critics": 1}),
    ("td3", {"critics": 3, "target_average": 3}),
    ("ddpg", {"target_average": 3, **NOISE}),
    ("td3", {"bounds": (-2.0, 10.0), "policy_noise": 3.0, "noise_clip": 9.0}),
    ("ddpg", {"reward_scale": 0.1, "saturation_penalty": 2.0, "saturation_limit": 0.1}),
    ("sac", {"reward_scale": 0.1, "saturation_penalty": 2.0, "loss_function": "smooth_l1"}),
    ("ddpg", {"importance": "none", "signals": ["td_error"]}),
    ("ddpg", {"importance": "torchrl", "signals": []}),
    ("td3", {"signals": ["value"], "loss_function": "pal", "pal_alpha": 0.7}),
    ("ddpg", {"gradient_order": 1.0, "signals": ["information_gain"]}),
    ("sac", {"alpha_lr": 0.0}),
]

TRUST = {
    "policy_weight": torch.full((6,), 0.5),
    "behavior_weight": torch.full((6,), 0.5),
    "behavior_mean": torch.zeros(6, 2),
    "behavior_sigma": torch.ones(6, 1),
}
WEIGHTED = {"priority_weight": torch.rand(6, generator=seeded()) + 0.1}


@pytest.mark.parametrize(
    ("name", "options", "entries", "trains", "loss_function"),
    [
        *((name, {}, WEIGHTED, "both", None) for name in KINDS),
        *((name, options, WEIGHTED, "both", None) for name, options in OPTIONS),
        ("td3", {}, {}, "both", "smooth_l1"),
        ("ddpg", {}, {"steps_to_next_obs": torch.full((6, 1), 3)}, "both", "smooth_l1"),
        ("td3", {}, TRUST, "both", "smooth_l1"),
        ("ddpg", {}, {}, "critic", None),
        ("ddpg", {}, {}, "actor", None),
        ("sac", {}, {}, "actor", None),
    ],
)
def test_gradients_signals_and_log_are_those_of_the_losses_to_the_last_bit(
    name, options, entries, trains, loss_function
):
    expected, found = (make_batch().update(entries) for _ in range(2))
    eager, compiled = (
        make_apart(name, optimizer="radam", compile=each, **options) for each in (False, UNTRACED)
    )
    # TD3 and SAC have noise in their targets.
    log = differentiate(eager, expected, seed=5, trains=trains, loss_function=loss_function)
    torch.manual_seed(5)
    values, _ = compiled._program(found, trains, loss_function)
    gradients, again = gradients_of(eager), gradients_of(compiled)
    assert again.keys() == gradients.keys()
    assert all(again[key].equal(gradients[key]) for key in gradients)
    assert values.keys() == log.keys()
    assert all(value.equal(values[key]) for key, value in log.items())
    torch.testing.assert_close(found.to_dict(), expected.to_dict(), rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("ddpg", {"optimizer": "radam", "tau": 0.2}),
        ("ddpg", {"policy_delay": 2, **NOISE}),
        ("td3", {"critic_weight_decay": 0.1, "target_average": 2}),
        ("sac", {"policy_delay": 3}),
    ],
    ids=str,
)
def test_program_takes_the_same_forty_steps(name, options):
    learners = make_pair(name, **options)
    assert_alike(*learners)
    if "optimizer" in options:
        with pytest.warns(UserWarning, match="steps of the RAdam are not compiled"):
            update_both(learners, 50)
    for seed in range(40):
        for learner in learners:
            learner.anneal(1.0 - seed / 80)
        logs, batches = update_both(learners, seed)
        assert logs[0].keys() >= logs[1].keys() >= {"loss_value"}
        torch.testing.assert_close(logs[1]["loss_value"], logs[0]["loss_value"])
        torch.testing.assert_close(
            batches[1]["signals"].to_dict(), batches[0]["signals"].to_dict(), rtol=1e-3, atol=1e-5
        )
        if seed % 15 == 14:
            for learner in learners:
                learner.end_episode()
    assert_alike(*learners)


@pytest.mark.parametrize(
    ("name", "through_file", "to_compiled", "updates"),
    [  # Each value of one with each of another.
        ("ddpg", True, True, 4),
        ("td3", False, True, 4),
        *(
            pytest.param(*values, marks=pytest.mark.slow)
            for values in (
                ("ddpg", False, False, 0),
                ("td3", True, False, 4),
                ("td3", True, True, 0),
            )
        ),
    ],
)
def test_checkpoint_of_an_eager_or_compiled_learner_loads_in_the_other(
    name, through_file, to_compiled, updates, tmp_path
):
    first, second = make_pair(name)[:: -1 if not to_compiled else 1]
    third = make_pair(name)[1 if not to_compiled else 0]
    second.update(make_batch(seed=9))
    first.anneal(0.3)
    for seed in range(updates):
        update_both([first], seed)
    state = first.state_dict()
    if through_file:
        save_atomically(state, tmp_path / "state.pt")
        state = load_safely(tmp_path / "state.pt")
    second.load_state_dict(state)
    third.load_state_dict(state)
    assert_alike(first, second, rtol=0, atol=0)
    for seed in range(20, 26):
        if seed == 23:
            third.anneal(0.1), second.anneal(0.1)
        update_both([third, second], seed)
    assert_alike(third, second)


@pytest.mark.parametrize("name", ["ddpg", "td3"])
def test_parameters_in_other_memory_still_learn(name):
    plain, traced = make_pair(name)
    for learner in (plain, traced):
        learner.networks.load_state_dict(copy.deepcopy(learner.networks.state_dict()))
    update_both([plain, traced], 0)
    for value in traced.networks.parameters():
        value.data = value.data.clone()
    for seed in range(1, 5):
        update_both([plain, traced], seed)
    assert_alike(plain, traced)


def test_parameters_that_are_fixed_stay_as_they_are():
    learners = make_pair("ddpg")
    for learner in learners:
        weights = [*learner.networks["critics"].parameters()]
        weights[0].requires_grad_(False)
    before = weights[0].clone()
    with pytest.warns(UserWarning, match="steps of the FlatAdam are not compiled"):
        update_both(learners, 0)
    for seed in range(1, 5):
        update_both(learners, seed)
    assert_alike(*learners)
    assert weights[0].equal(before)


def test_learner_that_depends_on_the_numbers_in_a_batch_stays_eager_and_says_so():
    class Choosing(ActorCritic):
        def _learn_actor(self, batch):
            self.saturation_penalty = float(batch["observation"].sum() > 0)
            return super()._learn_actor(batch)

    networks = make_networks()
    learners = [
        Choosing(*copy.deepcopy(networks), compile=compile) for compile in (False, UNTRACED)
    ]
    with pytest.warns(UserWarning, match="updates are not compiled: operations of the Choosing"):
        update_both(learners, 0)
    for seed in range(1, 3):
        update_both(learners, seed)
    assert_alike(*learners, rtol=0, atol=0)


def test_error_of_the_compiler_is_not_reported_as_one_of_the_batch():
    fail = fail_with(OSError("no compiler"))
    learner = make_learner(compile={"backend": fail})
    with pytest.raises(BackendCompilerFailed, match="no compiler"):
        learner.update(make_batch())


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_compiled_learner_takes_the_same_steps(name):
    learners = make_pair(name, True)
    for seed in range(4):
        update_both(learners, seed, loss_function="pal")
        update_both(learners, seed + 50, trains="critic", loss_function="smooth_l1", new_step=False)
        update_both(learners, seed + 90, trains="actor", new_step=False)
    assert_alike(*learners, rtol=1e-3, atol=1e-4)
