"""The losses: equal to TorchRL's where they should be, and to Eqs. (5) and (11) by hand."""

import inspect
import itertools
import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.objectives import DDPGLoss, SACLoss, TD3Loss, ValueEstimators

from tests.mpfa.losses import (
    BOUNDS,
    CRITICS_LOSS,
    GAMMA,
    KINDS,
    evaluate,
    make_batch,
    make_loss,
    make_networks,
    make_of,
    parameter_gradients,
    without_shortcut,
)
from torchrl_mpfa import SignalDDPGLoss, SignalSACLoss, SignalTD3Loss, make_ddpg_loss
from torchrl_mpfa.losses import SignalLoss
from torchrl_mpfa.losses.functional import distance, pal_distance

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


def test_network_of_two_lines_gives_the_numbers_of_a_hand_calculation():
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


# Each pair of values of two options once.
@pytest.mark.parametrize(
    ("weights", "loss_function", "direct", "estimator"),
    [
        ("none", "l2", True, ValueEstimators.TD0),
        ("none", "smooth_l1", False, ValueEstimators.TDLambda),
        ("torchrl", "l2", False, ValueEstimators.TDLambda),
        ("torchrl", "l2", True, ValueEstimators.TDLambda),
        ("torchrl", "smooth_l1", True, ValueEstimators.TD0),
        ("torchrl", "smooth_l1", False, ValueEstimators.TD0),
        ("not in the batch", "l2", False, ValueEstimators.TD0),
        ("not in the batch", "smooth_l1", True, ValueEstimators.TDLambda),
    ],
)
@pytest.mark.parametrize("kind", [*KINDS, "ddpg without a target actor"])
def test_losses_and_gradients_equal_torchrls(kind, direct, weights, loss_function, estimator):
    name, options = kind.split()[0], {"loss_function": loss_function}
    if kind.endswith("actor"):
        options["delay_actor"] = False
    networks = make_networks(stochastic=name == "sac")
    if not direct:
        networks = without_shortcut(*networks)
    importance = "none" if weights == "none" else "torchrl"
    ours = make_of(name, networks=deepcopy(networks), importance=importance, **options)
    if weights == "none":
        options["use_prioritized_weights"] = False
    theirs = {
        "ddpg": lambda: DDPGLoss(*networks, **{"delay_actor": True, **options}),
        "td3": lambda: TD3Loss(*networks, bounds=BOUNDS, **options),
        "sac": lambda: SACLoss(*networks, alpha_init=0.3, **options),
    }[name]()
    for loss in (ours, theirs):
        loss.make_value_estimator(estimator, gamma=GAMMA)
    theirs.load_state_dict(ours.state_dict())
    found = []
    for loss in (ours, theirs):
        batch = make_batch(weighted=weights != "not in the batch")
        if estimator is ValueEstimators.TDLambda:
            batch = batch.reshape(1, 6)
        losses = evaluate(loss, batch)
        sum(value for key, value in losses.items() if key.startswith("loss")).backward()
        found.append((losses, batch["td_error"], parameter_gradients(loss)))
    (mine, error, gradients), (expected, expected_error, expected_gradients) = found
    assert set(expected.keys()) <= set(mine.keys())
    if name == "td3":  # Of which both critics are in TorchRL's value, and the first in ours.
        expected = expected.exclude("state_action_value_actor")
    for key in expected.keys():  # noqa: SIM118
        torch.testing.assert_close(mine[key], expected[key], msg=key)
    torch.testing.assert_close(error, expected_error)
    assert gradients.keys() == expected_gradients.keys()
    for key, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected_gradients[key], msg=key)


@pytest.mark.parametrize("kind", KINDS)
def test_importance_weighs_the_critics_alone_and_divides_by_the_batch_size(kind):
    weighted, name = make_batch(weighted=True), CRITICS_LOSS[kind]
    losses, plain = (evaluate(make_of(kind), b) for b in (weighted, make_batch()))
    loss = make_of(kind)
    torch.manual_seed(1)
    _, log = loss.losses(make_batch(), trains="critic")
    squares = (log["target_value"] - log["pred_value"]).square().reshape(-1, 6).sum(0)
    total = sum(w * s for w, s in zip(weighted["priority_weight"], squares, strict=True))
    torch.testing.assert_close(losses[name].detach(), total / 6)
    assert not losses[name].equal(plain[name])
    for key in {"loss_actor", "loss_alpha"} & set(plain.keys()):
        assert losses[key].equal(plain[key])
    unread = evaluate(make_of(kind, importance="none"), make_batch(weighted=True))
    assert unread[name].equal(plain[name])


def test_weights_may_be_a_column():
    loss, batch = make_loss(), make_batch(weighted=True)
    expected = loss(batch)["loss_value"]
    batch["priority_weight"] = batch["priority_weight"].unsqueeze(1)
    assert loss(batch)["loss_value"].equal(expected)


def test_end_is_not_bootstrapped_and_a_time_limit_is():
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


@pytest.mark.parametrize("kind", KINDS)
def test_each_loss_moves_its_own_parameters_alone(kind):
    own = {"loss_actor": "actor", CRITICS_LOSS[kind]: ("value", "qvalue")}
    if kind == "sac":
        own["loss_alpha"] = "log_alpha"
    losses = evaluate(make_of(kind, saturation_penalty=0.1), make_batch())
    assert {key for key, value in losses.items() if value.requires_grad} == set(own)
    for key, prefix in own.items():
        loss = make_of(kind)
        evaluate(loss, make_batch())[key].backward()
        names = parameter_gradients(loss)
        assert names
        assert all(name.startswith(prefix) for name in names)


@pytest.mark.parametrize("kind", KINDS)
def test_no_gradient_reaches_the_batch_and_only_signals_are_added(kind):
    loss, batch = make_of(kind), make_batch()
    before = batch.clone()
    losses = loss(batch)
    (losses[CRITICS_LOSS[kind]] + losses["loss_actor"]).backward()
    assert not any(entry.requires_grad for entry in batch.values(True, True))
    for key in ("observation", "action", ("next", "reward")):
        assert batch[key].equal(before[key])
    assert set(batch.keys()) - set(before.keys()) == {"signals", "td_error"}
    seen = make_batch()
    seen["observation"].requires_grad_(True)
    losses = loss(seen)
    (losses[CRITICS_LOSS[kind]] + losses["loss_actor"]).backward()
    assert seen["observation"].grad is None


@pytest.mark.parametrize("importance", ["critic", "torchrl"])
@pytest.mark.parametrize("kind", KINDS)
def test_losses_of_an_update_are_those_that_torchrl_asks_for(kind, importance):
    loss = make_of(kind, importance=importance, saturation_penalty=0.1, saturation_limit=0.1)
    expected = evaluate(loss, make_batch(weighted=True))
    torch.manual_seed(1)
    losses, _ = loss.losses(make_batch(weighted=True))
    losses[CRITICS_LOSS[kind]] = losses.pop("loss_value")
    assert losses.keys() == {key for key in expected.keys() if key.startswith("loss")}  # noqa: SIM118
    for key, value in losses.items():
        torch.testing.assert_close(value, expected[key], msg=key)


@pytest.mark.parametrize("kind", KINDS)
def test_loss_under_no_grad_equals_the_loss_with_gradients(kind):
    batch, expected, name = make_batch(), make_batch(), CRITICS_LOSS[kind]
    with_grad = evaluate(make_of(kind), expected)
    with torch.no_grad():
        losses = evaluate(make_of(kind), batch)
    assert not losses[name].requires_grad
    torch.testing.assert_close(losses[name], with_grad[name].detach())
    for key in ("td_error", "action_gradient"):
        torch.testing.assert_close(batch["signals", key], expected["signals", key])


def test_value_estimator_is_one_step_if_none_is_made():
    assert SignalDDPGLoss(*make_networks())(make_batch())["loss_value"].isfinite()


def test_actor_may_observe_what_the_critic_does_not():
    actor = TensorDictModule(nn.Linear(5, 2), ["image"], ["action"])
    loss = make_ddpg_loss(actor, make_networks()[1], gamma=GAMMA)
    batch = make_batch()
    batch["image"], batch["next", "image"] = torch.randn(2, 6, 5)
    losses = loss(batch)
    assert losses["loss_value"].isfinite()
    assert batch["signals", "action_gradient"].shape == (6,)


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


@pytest.mark.parametrize(
    ("kind", "path"),
    # What TorchRL makes of several critics cannot be pickled.
    [("ddpg", "pickle"), *itertools.product(KINDS, ["deepcopy", "double"])],
)
def test_copied_or_converted_loss_uses_its_own_parameters(kind, path):
    loss, name = make_of(kind), CRITICS_LOSS[kind]
    before = evaluate(loss, make_batch())
    if path == "double":
        batch = make_batch()
        batch.update(batch.select("observation", "action", ("next", "observation")).double())
        batch["next", "reward"] = batch["next", "reward"].double()
        losses = evaluate(loss.double(), batch)
        assert losses[name].dtype == losses["loss_actor"].dtype == torch.double
        return
    copied = deepcopy(loss) if path == "deepcopy" else pickle.loads(pickle.dumps(loss))
    found = evaluate(copied, make_batch())
    assert found[name].equal(before[name])
    assert found["loss_actor"].equal(before["loss_actor"])
    with torch.no_grad():
        for parameter in copied.parameters():
            parameter.mul_(2)
    assert not evaluate(copied, make_batch())[name].equal(before[name])
    assert evaluate(loss, make_batch())[name].equal(before[name])


@pytest.mark.parametrize(
    "key", ["observation", "action", "next", ("next", "reward"), ("next", "terminated")], ids=str
)
@pytest.mark.parametrize("kind", KINDS)
def test_missing_input_is_named(kind, key):
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
        make_of(kind)(make_batch().exclude(key))


@pytest.mark.parametrize("alpha", [0.0, 0.7])
def test_exponent_of_pal_reaches_the_loss(alpha):
    loss, batch = make_loss(loss_function="pal", pal_alpha=alpha), make_batch()
    batch["next", "reward"] *= 5.0
    found = loss(batch)
    error = found["target_value"] - found["pred_value"]
    assert float(error.abs().max()) > 1
    torch.testing.assert_close(found["loss_value"], pal_distance(error, alpha=alpha).mean())


@pytest.mark.parametrize("name", ["smooth_l1", "pal"])
def test_loss_bends_at_one_in_units_of_the_reward(name):
    found = make_loss(loss_function=name, reward_scale=0.5)(make_batch())
    expected = distance(found["pred_value"], found["target_value"], name, unit=0.5)
    torch.testing.assert_close(found["loss_value"], expected.mean())
    other = distance(found["pred_value"], found["target_value"], name, unit=1.0)
    assert not torch.allclose(found["loss_value"], other.mean())


def test_action_spec_takes_the_place_of_bounds():
    spec = Bounded(low=-0.5, high=0.5, shape=(2,))
    loss = SignalTD3Loss(*make_networks(), action_spec=spec)
    assert loss.max_action.tolist() == [0.5, 0.5]
    low, high = torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 10.0])
    assert SignalTD3Loss(*make_networks(), bounds=(low, high)).max_action.tolist() == [2.0, 10.0]


def test_critics_of_td3_start_apart():
    params = make_of("td3").qvalue_network_params.flatten_keys()
    weights = [value for name, value in params.items() if name.endswith("weight")]
    assert any(not value[0].equal(value[1]) for value in weights)


@pytest.mark.parametrize("kind", [SignalDDPGLoss, SignalTD3Loss, SignalSACLoss])
def test_docstring_of_each_loss_names_the_class_that_documents_its_options(kind):
    options = set(inspect.signature(SignalLoss.__init__).parameters)
    options -= {"self", "actor_network", "critic_network", "kwargs"}
    assert len(options) == 8
    assert "see :class:`~torchrl_mpfa.losses.SignalLoss`" in kind.__doc__
    for name in options:
        assert f"\n    {name}: " in inspect.getdoc(SignalLoss)  # Under "Args:".
        assert name not in inspect.signature(kind.__init__).parameters
