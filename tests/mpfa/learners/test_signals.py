"""The signals that a learner writes (Eqs. 13-14), their units, and the penalty on saturation."""

import copy
import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from tests.mpfa.learning import (
    GAMMA,
    KINDS,
    differentiate,
    gradients_of,
    make_apart,
    make_batch,
    make_learner,
    make_networks,
    without_shortcut,
)
from torchrl_mpfa import ActorCritic

SIGNAL = ("signals", "action_gradient")
SIGNALS = ["td_error", "action_gradient", "value"]


def slopes_of(learner, batch):
    """The slope of the first critic, row by row, by a pass of its own."""
    critic, rows = learner.networks["critics"][0].module, []
    for observation, action in zip(batch["observation"], batch["action"], strict=True):
        own = action.detach().clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(critic(observation, own).sum(), own)
        rows.append(slope)
    return torch.stack(rows)


@pytest.mark.parametrize("order", [2.0, 1.0, math.inf])
@pytest.mark.parametrize(
    "options",
    [{}, {"reward_scale": 0.1}, {"loss_function": "smooth_l1"}, {"importance": "torchrl"}],
    ids=str,
)
@pytest.mark.parametrize("kind", KINDS)
def test_gradient_signal_equals_the_gradient_row_by_row(kind, options, order):
    learner, batch = make_apart(kind, gradient_order=order, **options), make_batch(weighted=True)
    differentiate(learner, batch)
    expected = torch.linalg.vector_norm(slopes_of(learner, batch), ord=order, dim=-1)
    scale = options.get("reward_scale", 1.0)
    torch.testing.assert_close(batch[SIGNAL], expected / scale, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["td3", "sac"])
def test_of_several_critics_the_larger_error_and_the_first_slope_count(kind):
    learner, batch = make_apart(kind, reward_scale=0.1, signals=SIGNALS), make_batch()
    log = differentiate(learner, batch)
    errors = (log["target_value"] - log["pred_value"]).abs() / 0.1
    torch.testing.assert_close(batch["signals", "td_error"], errors.amax(0))
    assert not errors[0].equal(errors[1])
    torch.testing.assert_close(batch["signals", "value"], log["pred_value"][0] / 0.1)
    torch.testing.assert_close(log["pred_value"], learner.values_of(batch).detach())
    slope = slopes_of(learner, batch).norm(dim=-1) / 0.1
    torch.testing.assert_close(batch[SIGNAL], slope, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_signal_does_not_change_the_gradients_of_parameters(kind):
    found = []
    for signals in (SIGNALS, ["td_error"]):
        learner = make_apart(kind, signals=signals)
        differentiate(learner, make_batch(weighted=True))
        found.append(gradients_of(learner))
    assert found[0].keys() == found[1].keys()
    for name, gradient in found[0].items():
        assert gradient.equal(found[1][name]), name


@pytest.mark.parametrize("signals", [SIGNALS[:1], SIGNALS[1:2], SIGNALS], ids=str)
def test_only_the_signals_asked_for_are_written(signals):
    batch = make_batch()
    differentiate(make_learner(signals=signals), batch)
    assert sorted(batch["signals"].keys()) == sorted(signals)


@pytest.mark.parametrize("kind", ["ddpg", "td3"])
def test_errors_stay_in_units_of_the_reward_when_the_loss_scales_it(kind):
    logs = {}
    for scale in (1.0, 10.0):
        # Critics that say nothing: the error is the scaled reward and what bootstraps is zero.
        learner, batch = make_apart(kind, reward_scale=scale), make_batch()
        with torch.no_grad():
            for parts in (learner.networks, learner.targets):
                for value in parts["critics"].parameters():
                    value.zero_()
        logs[scale] = differentiate(learner, batch)
        expected = make_batch()["next", "reward"]
        torch.testing.assert_close(batch["signals", "td_error"], expected.squeeze(1).abs())
        assert batch["next", "reward"].equal(expected)
    torch.testing.assert_close(logs[10.0]["target_value"], 10 * logs[1.0]["target_value"])
    torch.testing.assert_close(logs[10.0]["loss_value"], 100 * logs[1.0]["loss_value"])


@pytest.mark.parametrize("kind", KINDS)
def test_transition_without_error_has_its_gradient_too(kind):
    learner, batch = make_apart(kind), make_batch()
    # A weight of zero takes the transition out of the loss, as an error of zero would.
    batch["priority_weight"] = torch.tensor([0.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    differentiate(learner, batch)
    expected = slopes_of(learner, batch).norm(dim=-1)
    torch.testing.assert_close(batch[SIGNAL], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_learner_writes_the_gradient_of_the_critic_before_its_step(kind):
    learner, batch = make_apart(kind, critic_lr=0.1), make_batch()
    expected = slopes_of(learner, batch).norm(dim=-1)
    learner.update(batch)
    torch.testing.assert_close(batch[SIGNAL], expected, rtol=1e-5, atol=1e-7)
    assert not torch.allclose(slopes_of(learner, batch).norm(dim=-1), expected)


# The penalty on saturation.


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_saturation_penalty_is_the_mean_square_of_what_exceeds_the_limit(kind, direct):
    found = []
    for penalty in (0.0, 2.0):
        networks = make_networks(stochastic=kind == "sac")
        module = (networks[0].module[0] if kind == "sac" else networks[0]).module
        networks = networks if direct else without_shortcut(*networks)
        options = {"saturation_penalty": penalty, "saturation_limit": 0.1}
        log = differentiate(make_apart(kind, networks=networks, **options), make_batch())
        assert log["loss_value"].isfinite()
        found.append(log["loss_actor"].item())
    means = module(make_batch()["observation"])[0].detach()
    excess = [max(0.0, abs(each) - 0.1) ** 2 for each in means.flatten().tolist()]
    assert found[1] - found[0] == pytest.approx(2.0 * sum(excess) / 12, rel=1e-4, abs=1e-6)


def test_penalty_on_an_actor_without_preactivation_is_an_error():
    actor = TensorDictModule(nn.Linear(5, 2), ["observation"], ["action"])
    with pytest.raises(ValueError, match=r"saturation_penalty is 0.1, but actor writes no"):
        ActorCritic(actor, make_networks()[1], gamma=GAMMA, saturation_penalty=0.1)
    learner = ActorCritic(copy.deepcopy(actor), make_networks()[1], gamma=GAMMA)
    assert differentiate(learner, make_batch())["loss_actor"].isfinite()
