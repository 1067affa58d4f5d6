"""SignalDDPGLoss: equal to TorchRL's loss where it should be, and to Eqs. (5) and (11) by hand."""

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import DDPGLoss, ValueEstimators

from tests.mpfa.losses import GAMMA, make_batch, make_loss, make_networks, parameter_gradients
from torchrl_mpfa import SignalDDPGLoss, make_ddpg_loss

# TorchRL warns at every loss whose target networks nothing moves; these tests do not train.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


class ConstantActor(nn.Module):
    """Action 0.5, whatever is observed."""

    def __init__(self):
        super().__init__()
        self.action = nn.Parameter(torch.tensor([0.5]))

    def forward(self, observation):
        return self.action.expand(*observation.shape[:-1], 1)


class LinearCritic(nn.Module):
    """Q = 2 s + 3 a."""

    def __init__(self):
        super().__init__()
        self.of_state = nn.Parameter(torch.tensor(2.0))
        self.of_action = nn.Parameter(torch.tensor(3.0))

    def forward(self, observation, action):
        return self.of_state * observation + self.of_action * action


def test_a_network_of_two_lines_gives_the_numbers_of_a_hand_calculation():
    actor = TensorDictModule(ConstantActor(), ["observation"], ["action"])
    critic = TensorDictModule(LinearCritic(), ["observation", "action"], ["state_action_value"])
    loss = make_ddpg_loss(actor, critic, gamma=0.5, loss_function="l2")
    end = torch.tensor([[False], [True]])
    batch = TensorDict(
        {
            "observation": torch.tensor([[1.0], [2.0]]),
            "action": torch.tensor([[0.0], [1.0]]),
            "priority_weight": torch.tensor([1.0, 0.5]),
            "next": {
                "observation": torch.tensor([[3.0], [4.0]]),
                "reward": torch.tensor([[1.0], [-1.0]]),
                "terminated": end,
                "done": end,
            },
        },
        [2],
    )
    losses = loss(batch)
    # Q = 2 and 7; Q'(s', 0.5) = 7.5 and 9.5; y = 1 + 0.5 * 7.5 = 4.75 and -1, as it ended.
    assert losses["pred_value"].tolist() == [2.0, 7.0]
    assert losses["target_value"].tolist() == [4.75, -1.0]
    assert batch["signals", "td_error"].tolist() == [2.75, 8.0]
    assert batch["td_error"].tolist() == [7.5625, 64.0]
    assert batch["signals", "action_gradient"].tolist() == [3.0, 3.0]
    # (1 * 2.75^2 + 0.5 * 8^2) / 2
    assert losses["loss_value"].item() == pytest.approx(19.78125)
    # -(2 + 1.5 + 4 + 1.5) / 2
    assert losses["loss_actor"].item() == pytest.approx(-4.5)
    (losses["loss_value"] + losses["loss_actor"]).backward()
    params = loss.value_network_params
    # 1/2 * 2 w (Q - y) dQ/dtheta: (-2.75 * 1 + 0.5 * 8 * 2) and (-2.75 * 0 + 0.5 * 8 * 1).
    assert float(params["module", "of_state"].grad) == pytest.approx(5.25)
    assert float(params["module", "of_action"].grad) == pytest.approx(4.0)
    assert float(loss.actor_network_params["module", "action"].grad) == pytest.approx(-3.0)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("delay_actor", [False, True])
@pytest.mark.parametrize("loss_function", ["l2", "smooth_l1"])
def test_losses_and_gradients_equal_torchrls(weighted, delay_actor, loss_function):
    actor, critic = make_networks()
    arguments = {"loss_function": loss_function, "delay_actor": delay_actor}
    theirs = DDPGLoss(deepcopy(actor), deepcopy(critic), **arguments)
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    ours = make_ddpg_loss(actor, critic, gamma=GAMMA, importance="torchrl", **arguments)
    shift_targets(theirs), shift_targets(ours)
    batch = make_batch(weighted=weighted)
    expected_batch = batch.clone()
    found, expected = ours(batch), theirs(expected_batch)
    for key in ("loss_value", "loss_actor", "td_error", "pred_value", "target_value"):
        torch.testing.assert_close(found[key], expected[key], msg=key)
    torch.testing.assert_close(batch["td_error"], expected_batch["td_error"])
    for losses in (found, expected):
        (losses["loss_value"] + losses["loss_actor"]).backward()
    theirs_by_name = parameter_gradients(theirs)
    assert theirs_by_name
    for name, gradient in parameter_gradients(ours).items():
        torch.testing.assert_close(gradient, theirs_by_name[name], msg=name)


def shift_targets(loss):
    """Target networks of their own, so that a mix-up with the current ones shows."""
    for params in (loss.target_value_network_params, loss.target_actor_network_params):
        if params.requires_grad or params is None:
            continue
        for tensor in params.flatten_keys().values():
            with torch.no_grad():
                tensor.mul_(0.7)


def test_importance_weighs_the_critic_alone_and_divides_by_the_batch_size():
    loss, batch = make_loss(loss_function="l2"), make_batch(weighted=True)
    losses = loss(batch)
    delta = losses["target_value"] - losses["pred_value"]
    total = 0.0
    for weight, error in zip(batch["priority_weight"].tolist(), delta.tolist(), strict=True):
        total += weight * error**2
    assert losses["loss_value"].item() == pytest.approx(total / len(delta), rel=1e-5)
    plain = loss(make_batch(weighted=False))
    assert losses["loss_actor"].equal(plain["loss_actor"])
    assert not losses["loss_value"].equal(plain["loss_value"])


def test_without_importance_the_weights_are_not_read():
    loss = make_loss(importance="none")
    for key in ("loss_value", "loss_actor"):
        assert loss(make_batch(weighted=True))[key].equal(loss(make_batch(weighted=False))[key])


def test_weights_may_be_a_column():
    loss, batch = make_loss(), make_batch(weighted=True)
    expected = loss(batch)["loss_value"]
    batch["priority_weight"] = batch["priority_weight"].unsqueeze(1)
    assert loss(batch)["loss_value"].equal(expected)


def test_the_td_error_signal_is_absolute_and_not_squared():
    loss, batch = make_loss(), make_batch()
    losses = loss(batch)
    delta = (losses["target_value"] - losses["pred_value"]).abs()
    torch.testing.assert_close(batch["signals", "td_error"], delta)
    torch.testing.assert_close(batch["td_error"], delta.square())
    assert (batch["signals", "td_error"] >= 0).all()


def test_an_end_is_not_bootstrapped_and_a_time_limit_is():
    batch = make_batch()
    ended, limited, neither = batch.clone(), batch.clone(), batch.clone()
    true, false = torch.ones(6, 1, dtype=torch.bool), torch.zeros(6, 1, dtype=torch.bool)
    for each, terminated, truncated in (
        (ended, true, false),
        (limited, false, true),
        (neither, false, false),
    ):
        each["next", "terminated"], each["next", "truncated"] = terminated, truncated
        each["next", "done"] = terminated | truncated
    loss = make_loss()
    reward = batch["next", "reward"].squeeze(1)
    assert loss(ended)["target_value"].equal(reward)
    assert loss(limited)["target_value"].equal(loss(neither)["target_value"])
    assert not loss(limited)["target_value"].equal(reward)


def test_nothing_of_the_output_but_the_losses_is_attached_to_the_graph():
    losses = make_loss(saturation_penalty=0.1)(make_batch())
    attached = {key for key, value in losses.items() if value.requires_grad}
    assert attached == {"loss_value", "loss_actor"}


def test_the_critic_gets_no_gradient_from_the_actors_loss_nor_the_actor_from_the_critics():
    for key, without in (("loss_actor", "value"), ("loss_value", "actor")):
        loss = make_loss()
        loss(make_batch())[key].backward()
        gradients = parameter_gradients(loss)
        assert gradients
        assert not any(without in name for name in gradients)


def test_no_gradient_reaches_the_targets_or_the_batch():
    loss, batch = make_loss(), make_batch()
    before = batch.clone()
    losses = loss(batch)
    (losses["loss_value"] + losses["loss_actor"]).backward()
    assert not any("target" in name for name in parameter_gradients(loss))
    assert not any(entry.requires_grad for entry in batch.values(True, True))
    for key in ("observation", "action", ("next", "reward")):
        assert batch[key].equal(before[key])
    added = {"signals", "td_error"}
    assert set(batch.keys()) - set(before.keys()) == added


def test_the_loss_can_be_looked_at_without_gradients():
    loss, batch = make_loss(), make_batch()
    expected = make_batch()
    with_grad = loss(expected)
    with torch.no_grad():
        losses = loss(batch)
    assert not losses["loss_value"].requires_grad
    torch.testing.assert_close(losses["loss_value"], with_grad["loss_value"].detach())
    for key in ("td_error", "action_gradient"):
        torch.testing.assert_close(batch["signals", key], expected["signals", key])


def test_the_value_estimator_is_one_step_if_none_is_made():
    actor, critic = make_networks()
    loss = SignalDDPGLoss(actor, critic)
    losses = loss(make_batch())
    assert losses["loss_value"].isfinite()


def test_networks_that_need_tensordicts_give_the_same_as_those_that_do_not():
    direct = make_networks()
    indirect = [TensorDictModule(n.module, n.in_keys, n.out_keys) for n in direct]
    found = []
    for networks in (direct, indirect):
        batch = make_batch(weighted=True)
        losses = make_ddpg_loss(*networks, gamma=GAMMA)(batch)
        found.append([losses["loss_value"], losses["loss_actor"], *batch["signals"].values()])
    for one, other in zip(*found, strict=True):
        assert one.equal(other)
