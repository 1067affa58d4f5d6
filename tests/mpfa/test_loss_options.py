"""The gradient signal of Eq. (14) and the options of SignalDDPGLoss."""

import inspect
import math
import pickle
from copy import deepcopy

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import ValueEstimators

from tests.mpfa.losses import GAMMA, make_batch, make_loss, make_networks, parameter_gradients
from torchrl_mpfa import (
    SignalDDPGLoss,
    SignalSACLoss,
    SignalTD3Loss,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_sac_loss,
    make_stochastic_actor,
    make_td3_loss,
)
from torchrl_mpfa.losses import SignalLoss
from torchrl_mpfa.losses.functional import pal_distance

# TorchRL warns at every loss whose target networks nothing moves; these tests do not train.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def q_of(critic, batch, action):
    """Q of a critic that is still a plain module."""
    return critic.module(batch["observation"], action)


@pytest.mark.parametrize("order", [2.0, 1.0, math.inf])
def test_the_gradient_signal_equals_the_gradient_row_by_row(order):
    actor, critic = make_networks()
    plain = deepcopy(critic)
    loss = make_ddpg_loss(actor, critic, gamma=GAMMA, gradient_order=order)
    batch = make_batch()
    loss(batch)
    for row in range(6):
        action = batch["action"][row : row + 1].clone().requires_grad_(True)
        value = q_of(plain, batch[row : row + 1], action)
        (gradient,) = torch.autograd.grad(value.squeeze(), action)
        expected = torch.linalg.vector_norm(gradient, ord=order)
        torch.testing.assert_close(batch["signals", "action_gradient"][row], expected)


def test_the_gradient_signal_equals_finite_differences():
    actor, critic = make_networks()
    plain = deepcopy(critic).double()
    loss = make_ddpg_loss(actor, critic, gamma=GAMMA)
    batch = make_batch()
    loss(batch)
    double, step = batch.select("observation", "action").double(), 1e-6
    slopes = []
    for axis in range(2):
        shift = torch.zeros(2, dtype=torch.double)
        shift[axis] = step
        up = q_of(plain, double, double["action"] + shift)
        down = q_of(plain, double, double["action"] - shift)
        slopes.append((up - down).squeeze(1) / (2 * step))
    expected = torch.stack(slopes, 1).norm(dim=1)
    torch.testing.assert_close(
        batch["signals", "action_gradient"].double(), expected, rtol=1e-4, atol=1e-5
    )


def test_an_actor_may_observe_what_the_critic_does_not():
    actor = TensorDictModule(nn.Linear(5, 2), ["image"], ["action"])
    _, critic = make_networks()
    loss = make_ddpg_loss(actor, critic, gamma=GAMMA)
    batch = make_batch()
    batch["image"] = torch.randn(6, 5)
    batch["next", "image"] = torch.randn(6, 5)
    losses = loss(batch)
    assert losses["loss_value"].isfinite()
    assert batch["signals", "action_gradient"].shape == (6,)


def test_the_gradient_signal_does_not_change_the_gradients_of_the_parameters():
    with_signal, without = make_loss(), make_loss(signals=["td_error"])
    for loss in (with_signal, without):
        losses = loss(make_batch())
        (losses["loss_value"] + losses["loss_actor"]).backward()
    expected = parameter_gradients(without)
    for name, gradient in parameter_gradients(with_signal).items():
        torch.testing.assert_close(gradient, expected[name])


@pytest.mark.parametrize(
    "signals", [["td_error"], ["action_gradient"], ["td_error", "action_gradient"]]
)
def test_only_the_signals_asked_for_are_written(signals):
    batch = make_batch()
    make_loss(signals=signals)(batch)
    assert sorted(batch["signals"].keys()) == sorted(signals)


def test_signals_stay_in_units_of_the_reward_when_the_loss_scales_it():
    # A critic of constant zero: then delta is the reward, and the scale must not show in it.
    def zero_critic():
        _, critic = make_networks()
        for parameter in critic.parameters():
            nn.init.zeros_(parameter)
        return critic

    batches, losses = [], []
    for scale in (1.0, 10.0):
        actor, _ = make_networks()
        loss = make_ddpg_loss(
            actor, zero_critic(), gamma=GAMMA, reward_scale=scale, loss_function="l2"
        )
        batch = make_batch()
        losses.append(loss(batch))
        batches.append(batch)
    torch.testing.assert_close(
        batches[1]["signals", "td_error"], batches[0]["next", "reward"].squeeze(1).abs()
    )
    torch.testing.assert_close(losses[1]["target_value"], 10 * losses[0]["target_value"])
    torch.testing.assert_close(losses[1]["loss_value"], 100 * losses[0]["loss_value"])
    assert batches[1]["next", "reward"].equal(make_batch()["next", "reward"])


def test_the_gradient_signal_is_divided_by_the_reward_scale():
    plain, scaled = make_batch(), make_batch()
    make_loss()(plain)
    make_loss(reward_scale=4.0)(scaled)
    torch.testing.assert_close(
        scaled["signals", "action_gradient"] * 4.0, plain["signals", "action_gradient"]
    )


def test_the_saturation_penalty_is_the_mean_square_of_what_exceeds_the_limit():
    plain, held = make_loss(), make_loss(saturation_penalty=0.5, saturation_limit=0.01)
    batch = make_batch()
    base, with_penalty = plain(batch)["loss_actor"], held(batch)["loss_actor"]
    preactivation = held(batch)["preactivation"]
    total = 0.0
    for size in preactivation.flatten().tolist():
        total += max(0.0, size - 0.01) ** 2
    assert (with_penalty - base).item() == pytest.approx(0.5 * total / 12, rel=1e-4)


def test_the_saturation_penalty_pulls_preactivations_back_and_leaves_small_ones_alone():
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


def test_a_penalty_on_an_actor_without_preactivation_is_an_error():
    actor = TensorDictModule(nn.Linear(5, 2), ["observation"], ["action"])
    _, critic = make_networks()
    loss = make_ddpg_loss(actor, critic, gamma=GAMMA, saturation_penalty=0.1)
    with pytest.raises(KeyError, match=r"saturation_penalty is 0.1, but the actor writes no"):
        loss(make_batch())
    loss = make_ddpg_loss(deepcopy(actor), make_networks()[1], gamma=GAMMA)
    assert loss(make_batch())["loss_actor"].isfinite()


def test_every_key_may_be_nested_and_renamed():
    actor, critic = make_networks()
    agent_actor = TensorDictModule(
        actor.module, [("agent", "obs")], [("agent", "u"), ("agent", "act")]
    )
    agent_critic = TensorDictModule(
        critic.module, [("agent", "obs"), ("agent", "act")], [("agent", "q")]
    )
    loss = SignalDDPGLoss(agent_actor, agent_critic)
    loss.set_keys(
        action=("agent", "act"),
        state_action_value=("agent", "q"),
        preactivation=("agent", "u"),
        reward=("agent", "r"),
        terminated=("agent", "end"),
        done=("agent", "done"),
        priority=("agent", "squared"),
        td_error_signal=("agent", "signals", "td"),
        action_gradient_signal=("agent", "signals", "slope"),
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    plain = make_batch()
    expected = make_loss()(plain)
    batch = make_batch()
    after = batch["next"]
    nested = batch.empty()
    nested["agent", "obs"], nested["agent", "act"] = batch["observation"], batch["action"]
    nested["next", "agent", "obs"], nested["next", "agent", "r"] = (
        after["observation"],
        after["reward"],
    )
    nested["next", "agent", "end"], nested["next", "agent", "done"] = (
        after["terminated"],
        after["done"],
    )
    found = loss(nested)
    for key in ("loss_value", "loss_actor"):
        torch.testing.assert_close(found[key], expected[key])
    torch.testing.assert_close(nested["agent", "signals", "td"], plain["signals", "td_error"])
    torch.testing.assert_close(
        nested["agent", "signals", "slope"], plain["signals", "action_gradient"]
    )
    assert nested["agent", "squared"].shape == (6,)


def test_rewards_are_scaled_for_longer_targets_too():
    for scale in (1.0, 3.0):
        actor, critic = make_networks()
        loss = SignalDDPGLoss(actor, critic, reward_scale=scale)
        loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.5, lmbda=0.5)
        batch = make_batch().reshape(1, 6)
        for key in ("terminated", "done"):
            batch["next", key] = torch.ones(1, 6, 1, dtype=torch.bool)
        target = loss(batch)["target_value"]
        torch.testing.assert_close(target, batch["next", "reward"].squeeze(-1) * scale)


@pytest.mark.parametrize("way", ["deepcopy", "pickle", "double"])
def test_a_copied_or_converted_loss_uses_its_own_parameters(way):
    loss = make_loss()
    loss(make_batch())
    if way == "double":
        copied = loss.double()
        batch = make_batch()
        ends = batch["next"].select("terminated", "truncated", "done")
        batch = batch.double()
        batch["next"].update(ends)
        assert copied(batch)["loss_value"].dtype == torch.double
        return
    copied = deepcopy(loss) if way == "deepcopy" else pickle.loads(pickle.dumps(loss))
    assert copied(make_batch())["loss_value"].equal(loss(make_batch())["loss_value"])
    with torch.no_grad():
        for parameter in copied.parameters():
            parameter.mul_(2)
    assert not copied(make_batch())["loss_value"].equal(loss(make_batch())["loss_value"])


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("signals", ["novelty"]),
        ("gradient_order", 0.0),
        ("importance", "actor"),
        ("reward_scale", -1.0),
        ("saturation_penalty", -0.1),
        ("saturation_limit", -1.0),
        ("saturation_penalty", math.nan),
        ("reward_scale", math.nan),
        ("pal_alpha", -0.1),
        ("target_average", 0),
        ("loss_function", "l3"),
    ],
)
def test_arguments_out_of_range_are_refused(argument, value):
    with pytest.raises(ValueError, match=argument):
        make_loss(**{argument: value})


@pytest.mark.parametrize("kind", ["ddpg", "td3", "sac"])
def test_networks_in_the_wrong_order_are_refused_by_name_and_stay_as_they_are(kind):
    make, maker, more = {
        "ddpg": (make_ddpg_loss, make_actor, {}),
        "td3": (make_td3_loss, make_actor, {"bounds": (-1.0, 1.0)}),
        "sac": (make_sac_loss, make_stochastic_actor, {}),
    }[kind]
    actor, critic = maker(5, 2, width=8), make_critic(5, 2, width=8)
    name = "value_network" if kind == "ddpg" else "qvalue_network"
    if kind == "sac":
        with pytest.raises(TypeError, match="actor_network must be a Probabilistic"):
            make(critic, actor)
    else:
        words = f"actor_network and {name} are in the wrong order: actor_network reads 'action'"
        with pytest.raises(ValueError, match=words):
            make(critic, actor, **more)
    with pytest.raises(TypeError, match=f"{name} must be a TensorDictModule, got Linear"):
        make(actor, nn.Linear(5, 1), **more)
    blind = TensorDictModule(nn.Linear(5, 1), ["observation"], ["state_action_value"])
    with pytest.raises(ValueError, match=f"{name} must read what actor_network writes"):
        make(actor, blind, **more)
    make(actor, critic, **more)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, math.nan])
def test_a_discount_outside_of_zero_to_one_is_refused(gamma):
    networks = make_networks()
    for make, more in ((make_ddpg_loss, {}), (make_td3_loss, {"bounds": (-1.0, 1.0)})):
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\], got"):
            make(*networks, gamma=gamma, **more)


@pytest.mark.parametrize("alpha", [0.0, 0.7])
def test_the_exponent_of_pal_reaches_the_loss(alpha):
    loss, batch = make_loss(loss_function="pal", pal_alpha=alpha), make_batch()
    batch["next", "reward"] *= 5.0
    found = loss(batch)
    error = found["target_value"] - found["pred_value"]
    assert float(error.abs().max()) > 1
    torch.testing.assert_close(found["loss_value"], pal_distance(error, alpha=alpha).mean())


@pytest.mark.parametrize("kind", [SignalDDPGLoss, SignalTD3Loss, SignalSACLoss])
def test_each_loss_says_where_its_options_are_and_takes_each_of_them(kind):
    options = set(inspect.signature(SignalLoss.__init__).parameters)
    options -= {"self", "actor_network", "critic_network", "kwargs"}
    assert len(options) == 8
    assert "Options: see :class:`~torchrl_mpfa.losses.SignalLoss`" in kind.__doc__
    for name in options:
        assert f"``{name}``" in kind.__doc__
        assert f"        {name}: " in SignalLoss.__doc__
        assert name not in inspect.signature(kind.__init__).parameters
