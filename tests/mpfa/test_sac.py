"""SignalSACLoss: equal to TorchRL's SAC, and the signals by hand."""

from copy import deepcopy

import pytest
import torch
from torchrl.objectives import SACLoss, ValueEstimators

from tests.mpfa.losses import GAMMA, make_batch, parameter_gradients
from tests.mpfa.sac_networks import critics_of, evaluate, make_loss, make_networks, without_shortcut
from torchrl_mpfa import make_actor, make_critic, make_sac_loss

# TorchRL warns at every loss whose target networks nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("importance", ["none", "torchrl"])
@pytest.mark.parametrize("estimator", [ValueEstimators.TD0, ValueEstimators.TDLambda])
@pytest.mark.parametrize("loss_function", ["l2", "smooth_l1"])
def test_losses_and_gradients_equal_torchrls(direct, importance, estimator, loss_function):
    networks = make_networks() if direct else without_shortcut(*make_networks())
    kind = {"loss_function": loss_function, "alpha_init": 0.3}
    plain = {"use_prioritized_weights": False} if importance == "none" else {}
    theirs = SACLoss(*deepcopy(networks), **kind, **plain)
    ours = make_sac_loss(*networks, importance=importance, **kind)
    for loss in (theirs, ours):
        loss.make_value_estimator(estimator, gamma=GAMMA)
    with torch.no_grad():
        for tensor in ours.target_qvalue_network_params.flatten_keys().values():
            tensor.mul_(0.7)
    theirs.load_state_dict(ours.state_dict())
    found = []
    for loss in (ours, theirs):
        batch = make_batch(weighted=True)
        if estimator is ValueEstimators.TDLambda:
            batch = batch.reshape(1, 6)
        losses = evaluate(loss, batch)
        sum(losses[key] for key in ("loss_actor", "loss_qvalue", "loss_alpha")).backward()
        found.append((losses, batch["td_error"], parameter_gradients(loss)))
    (mine, error, gradients), (expected, expected_error, expected_gradients) = found
    assert set(mine.keys()) == set(expected.keys())
    for key in expected.keys():  # noqa: SIM118
        torch.testing.assert_close(mine[key], expected[key], msg=key)
    torch.testing.assert_close(error, expected_error)
    assert gradients.keys() == expected_gradients.keys()
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected_gradients[name], msg=name)


@torch.no_grad()
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_the_error_and_the_value_are_those_of_a_soft_target_row_by_row(scale):
    loss = make_loss(reward_scale=scale, alpha_init=0.3, signals=["td_error", "value"])
    batch = make_batch()
    torch.manual_seed(1)
    log = loss.value_loss(batch)[1]
    torch.manual_seed(1)
    noise = torch.randn(6, 2)
    current = critics_of(loss, loss.qvalue_network_params)
    later = critics_of(loss, loss.target_qvalue_network_params)
    for row in range(6):
        after = batch["next", "observation"][row]
        loc, deviation = loss.actor_network.module[0].module(after)
        normal = torch.distributions.Normal(loc, deviation)
        before = loc + deviation * noise[row]
        action = before.tanh()
        log_density = sum(normal.log_prob(before) - (1 - action.square()).log())
        value = min(float(q(after, action)) for q in later) - 0.3 * float(log_density)
        target = scale * float(batch["next", "reward"][row])
        if row != 1:  # The second transition is an end, the third a time limit.
            target += GAMMA * value
        assert float(log["target_value"][row]) == pytest.approx(target, rel=1e-4)
        values = [float(q(batch["observation"][row], batch["action"][row])) for q in current]
        error = max(abs(target - value) for value in values) / scale
        assert float(batch["signals", "td_error"][row]) == pytest.approx(error, rel=1e-4)
        assert float(batch["signals", "value"][row]) == pytest.approx(values[0] / scale, rel=1e-4)


@pytest.mark.parametrize("defer", [False, True])
def test_the_gradient_is_that_of_the_first_critic_row_by_row(defer):
    loss, batch = make_loss(reward_scale=0.1), make_batch()
    first = critics_of(loss, loss.qvalue_network_params)[0]
    loss.value_loss(batch, defer_gradient=defer)[0].backward()
    loss.write_action_gradient(batch)
    for row, observation in enumerate(batch["observation"]):
        action = batch["action"][row]
        action = action.detach().clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(first(observation, action).sum(), action)
        torch.testing.assert_close(
            batch["signals", "action_gradient"][row], slope.norm() / 0.1, rtol=1e-4, atol=1e-5
        )


def test_importance_weighs_the_critics_alone():
    weighted, plain = make_batch(weighted=True), make_batch()
    losses = [evaluate(make_loss(), batch) for batch in (weighted, plain)]
    loss = make_loss()
    torch.manual_seed(1)
    log = loss.value_loss(make_batch())[1]
    squares = (log["target_value"] - log["pred_value"]).square().sum(0)
    expected = (squares * weighted["priority_weight"]).mean()
    torch.testing.assert_close(losses[0]["loss_qvalue"], expected.detach())
    for key in ("loss_actor", "loss_alpha"):
        assert losses[0][key].equal(losses[1][key])
    unread = evaluate(make_loss(importance="none"), make_batch(weighted=True))
    assert unread["loss_qvalue"].equal(losses[1]["loss_qvalue"])


def test_the_penalty_on_saturation_is_that_of_the_mean_before_its_tanh():
    means = make_networks()[0].module[0].module(make_batch()["observation"])[0].detach()
    expected = 2.0 * (means.abs() - 0.1).clamp_min(0).square().mean()
    for direct in (True, False):
        found = []
        for penalty in (0.0, 2.0):
            networks = make_networks() if direct else without_shortcut(*make_networks())
            loss = make_sac_loss(*networks, saturation_penalty=penalty, saturation_limit=0.1)
            found.append(evaluate(loss, make_batch())["loss_actor"].detach())
        torch.testing.assert_close(found[1] - found[0], expected, rtol=1e-4, atol=1e-6)


def test_each_loss_moves_its_own_parameters_alone():
    own = {"loss_actor": "actor", "loss_qvalue": "qvalue", "loss_alpha": "log_alpha"}
    for key, prefix in own.items():
        loss = make_loss()
        evaluate(loss, make_batch())[key].backward()
        names = parameter_gradients(loss)
        assert names
        assert all(name.startswith(prefix) for name in names)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("signals", ["novelty"]),
        ("importance", "all"),
        ("reward_scale", 0.0),
        ("target_average", 0),
        ("value_network", make_critic(5, 2)),
        ("skip_done_states", True),
    ],
)
def test_a_bad_option_of_the_loss_is_named(name, value):
    with pytest.raises(ValueError, match=name):
        make_loss(**{name: value})


def test_rewards_are_scaled_for_longer_targets_too():
    loss, batch = make_loss(reward_scale=3.0), make_batch().reshape(1, 6)
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.5, lmbda=0.5)
    for key in ("terminated", "done"):
        batch["next", key] = torch.ones(1, 6, 1, dtype=torch.bool)
    target = loss.value_loss(batch)[1]["target_value"]
    torch.testing.assert_close(target, batch["next", "reward"].squeeze(-1) * 3.0)


def test_a_copied_or_converted_loss_uses_its_own_parameters():
    loss = make_loss()
    expected = evaluate(loss, make_batch())
    copied = deepcopy(loss)
    assert evaluate(copied, make_batch())["loss_actor"].equal(expected["loss_actor"])
    with torch.no_grad():
        copied.qvalue_network_params.apply_(lambda tensor: tensor.mul_(2))
    assert not evaluate(copied, make_batch())["loss_actor"].equal(expected["loss_actor"])
    batch = make_batch()
    batch.update(batch.select("observation", "action", ("next", "observation")).double())
    assert evaluate(loss.double(), batch)["loss_actor"].dtype == torch.double


def test_a_deterministic_actor_is_refused():
    with pytest.raises(TypeError, match=r"actor_network must be .*, got DirectModule"):
        make_sac_loss(make_actor(5, 2), make_critic(5, 2))
