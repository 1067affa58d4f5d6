"""The signals that losses write (Eqs. 13-14), their units, and the penalty on saturation."""

import copy
import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from tests.mpfa.losses import (
    CRITICS_LOSS,
    GAMMA,
    KINDS,
    critics_of,
    evaluate,
    make_batch,
    make_loss,
    make_networks,
    make_of,
    parameter_gradients,
    without_shortcut,
)
from torchrl_mpfa import ActorCriticLearner, make_ddpg_loss

# TorchRL warns at every loss whose target networks nothing moves; these tests do not train.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

SIGNAL = ("signals", "action_gradient")


def value_loss(kind, batch, seed=1, **options):
    """A loss, and its critics' loss of a batch."""
    loss = make_of(kind, **options.pop("of_loss", {}))
    torch.manual_seed(seed)
    compute = loss.loss_value if kind == "ddpg" else loss.value_loss
    return loss, compute(batch, **options)[0]


@pytest.mark.parametrize("order", [2.0, 1.0, math.inf])
def test_gradient_signal_equals_the_gradient_row_by_row(order):
    actor, critic = make_networks()
    plain = copy.deepcopy(critic).module
    loss = make_ddpg_loss(actor, critic, gamma=GAMMA, gradient_order=order)
    batch = make_batch()
    loss(batch)
    for row in range(6):
        action = batch["action"][row].clone().requires_grad_(True)
        value = plain(batch["observation"][row], action)
        (gradient,) = torch.autograd.grad(value.squeeze(), action)
        expected = torch.linalg.vector_norm(gradient, ord=order)
        torch.testing.assert_close(batch[SIGNAL][row], expected)


@pytest.mark.parametrize("defer", [False, True])
@pytest.mark.parametrize("kind", ["td3", "sac"])
def test_of_several_critics_the_larger_error_and_the_first_slope_count(kind, defer):
    batch = make_batch()
    loss, total = value_loss(
        kind, batch, defer_gradient=defer, of_loss={"reward_scale": 0.1, "signals": SIGNALS}
    )
    total.backward()
    loss.write_action_gradient(batch)
    torch.manual_seed(1)
    log = loss.value_loss(batch.clone())[1]
    errors = (log["target_value"] - log["pred_value"]).abs() / 0.1
    torch.testing.assert_close(batch["signals", "td_error"], errors.amax(0))
    assert not errors[0].equal(errors[1])
    torch.testing.assert_close(batch["signals", "value"], log["pred_value"][0] / 0.1)
    first = critics_of(loss, loss.qvalue_network_params)[0]
    for row, observation in enumerate(batch["observation"]):
        action = batch["action"][row].detach().clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(first(observation, action).sum(), action)
        torch.testing.assert_close(batch[SIGNAL][row], slope.norm() / 0.1, rtol=1e-4, atol=1e-5)


SIGNALS = ["td_error", "action_gradient", "value"]


@pytest.mark.parametrize("options", [{}, {"signals": ["td_error"]}], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_neither_signals_nor_deferring_change_the_gradients_of_parameters(kind, options):
    loss, total = value_loss(kind, make_batch(), of_loss=options)
    total.backward()
    other, total = value_loss(kind, make_batch(), defer_gradient=True)
    total.backward()
    found, expected = parameter_gradients(loss), parameter_gradients(other)
    assert found.keys() == expected.keys()
    for name, gradient in found.items():
        torch.testing.assert_close(gradient, expected[name])


@pytest.mark.parametrize("signals", [SIGNALS[:1], SIGNALS[1:2], SIGNALS], ids=str)
def test_only_the_signals_asked_for_are_written(signals):
    batch = make_batch()
    make_loss(signals=signals)(batch)
    assert sorted(batch["signals"].keys()) == sorted(signals)


@pytest.mark.parametrize("kind", ["ddpg", "td3"])
def test_errors_stay_in_units_of_the_reward_when_the_loss_scales_it(kind):
    losses = {}
    for scale in (1.0, 10.0):
        # Critics that say nothing: the error is the scaled reward and what bootstraps is zero.
        loss, batch = make_of(kind, reward_scale=scale), make_batch()
        with torch.no_grad():
            for name, value in [*loss.named_parameters(), *loss.named_buffers()]:
                if "value_network" in name:
                    value.zero_()
        losses[scale] = evaluate(loss, batch)
        expected = make_batch()["next", "reward"]
        torch.testing.assert_close(batch["signals", "td_error"], expected.squeeze(1).abs())
        assert batch["next", "reward"].equal(expected)
    name = CRITICS_LOSS[kind]
    torch.testing.assert_close(losses[10.0]["target_value"], 10 * losses[1.0]["target_value"])
    torch.testing.assert_close(losses[10.0][name], 100 * losses[1.0][name])


# What is deferred to the backward pass of the loss.


@pytest.mark.parametrize("kind", ["ddpg", "td3"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"reward_scale": 0.1},
        {"gradient_order": 1.0},
        {"loss_function": "smooth_l1"},
        {"importance": "torchrl"},
    ],
    ids=str,
)
def test_deferred_gradient_equals_that_of_a_backward_pass_of_its_own(kind, options):
    direct, deferred = make_batch(), make_batch()
    value_loss(kind, direct, of_loss=options)
    loss, total = value_loss(kind, deferred, defer_gradient=True, of_loss=options)
    assert SIGNAL not in deferred.keys(include_nested=True)
    total.backward()
    loss.write_action_gradient(deferred)
    torch.testing.assert_close(deferred[SIGNAL], direct[SIGNAL], rtol=1e-5, atol=1e-7)
    deferred[SIGNAL] = direct[SIGNAL] + 1.0
    loss.write_action_gradient(deferred)  # Nothing is deferred any more.
    assert deferred[SIGNAL].equal(direct[SIGNAL] + 1.0)


@pytest.mark.parametrize("kind", KINDS)
def test_transition_without_error_has_its_gradient_too(kind):
    direct, deferred = make_batch(), make_batch()
    value_loss(kind, direct)
    # A weight of zero takes the transition out of the loss, as an error of zero would.
    deferred["priority_weight"] = torch.tensor([0.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    loss, total = value_loss(kind, deferred, defer_gradient=True)
    total.backward()
    loss.write_action_gradient(deferred)
    assert deferred[SIGNAL].isfinite().all()
    torch.testing.assert_close(deferred[SIGNAL], direct[SIGNAL], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_deferred_gradient_waits_for_the_backward_pass_and_for_no_copy(kind):
    batch = make_batch()
    loss, _ = value_loss(kind, batch, defer_gradient=True)
    copy.deepcopy(loss).write_action_gradient(batch)
    assert SIGNAL not in batch.keys(include_nested=True)
    with pytest.raises(RuntimeError, match="call backward"):
        loss.write_action_gradient(batch)


@pytest.mark.parametrize("kind", KINDS)
def test_under_no_grad_the_gradient_is_written_at_once(kind):
    batch = make_batch()
    with torch.no_grad():
        value_loss(kind, batch, defer_gradient=True)
    assert SIGNAL in batch.keys(include_nested=True)


@pytest.mark.parametrize("kind", ["ddpg", "td3"])
def test_learner_writes_the_gradient_of_the_critic_before_its_step(kind):
    expected, batch = make_batch(), make_batch()
    value_loss(kind, expected)
    ActorCriticLearner(make_of(kind), critic_lr=0.1).update(batch)
    torch.testing.assert_close(batch[SIGNAL], expected[SIGNAL], rtol=1e-5, atol=1e-7)


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
        losses = evaluate(make_of(kind, networks=networks, **options), make_batch())
        assert losses[CRITICS_LOSS[kind]].isfinite()
        found.append(losses["loss_actor"].item())
    means = module(make_batch()["observation"])[0].detach()
    excess = [max(0.0, abs(each) - 0.1) ** 2 for each in means.flatten().tolist()]
    assert found[1] - found[0] == pytest.approx(2.0 * sum(excess) / 12, rel=1e-4, abs=1e-6)


def test_saturation_penalty_pulls_preactivations_back_and_leaves_small_ones_alone():
    def bias_gradient(limit):
        loss = make_loss(saturation_penalty=1.0, saturation_limit=limit)
        plain = make_loss()
        for each in (loss, plain):
            each(make_batch())["loss_actor"].backward()
        name = next(n for n in parameter_gradients(loss) if n.endswith(("head_bias", "head.bias")))
        return parameter_gradients(loss)[name] - parameter_gradients(plain)[name]

    actor, _ = make_networks()
    before = actor.module(make_batch()["observation"])[0].detach()
    excess = (before.abs() - 0.01).clamp_min(0)
    # d/du mean(max(0, |u| - l)^2) = 2 max(0, |u| - l) sign(u) / (B A); the bias sums over rows.
    expected = (2 * excess * before.sign() / before.numel()).sum(0)
    torch.testing.assert_close(bias_gradient(0.01), expected, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(bias_gradient(100.0), torch.zeros(2))


def test_penalty_on_an_actor_without_preactivation_is_an_error():
    actor = TensorDictModule(nn.Linear(5, 2), ["observation"], ["action"])
    loss = make_ddpg_loss(actor, make_networks()[1], gamma=GAMMA, saturation_penalty=0.1)
    with pytest.raises(KeyError, match=r"saturation_penalty is 0.1, but the actor writes no"):
        loss(make_batch())
    loss = make_ddpg_loss(copy.deepcopy(actor), make_networks()[1], gamma=GAMMA)
    assert loss(make_batch())["loss_actor"].isfinite()
