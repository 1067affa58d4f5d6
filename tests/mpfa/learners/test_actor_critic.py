"""Losses of the learner: TorchRL's where they should be, and Eqs. (5) and (11) by hand."""

import pickle
from copy import copy, deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.mpfa.learning import (
    GAMMA,
    KINDS,
    UNTRACED,
    differentiate,
    gradients_of,
    gradients_of_torchrls,
    make_apart,
    make_batch,
    make_learner,
    make_networks,
    make_torchrls,
    without_shortcut,
)
from tests.mpfa.transitions import same, snapshot
from torchrl_mpfa import ActorCritic
from torchrl_mpfa.losses import distance

# TorchRL warns at every loss of its own whose target networks nothing moves.
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
    learner = ActorCritic(actor, critic, gamma=0.5)
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
    log = differentiate(learner, batch)
    # Q = 2 and 7; Q'(s', 0.5) = 7.5 and 9.5; y = 1 + 0.5 * 7.5 = 4.75 and -1, as it ended.
    assert log["pred_value"].tolist() == [[2.0, 7.0]]
    assert log["target_value"].tolist() == [4.75, -1.0]
    assert batch["signals", "td_error"].tolist() == [2.75, 8.0]
    assert batch["td_error"].tolist() == [7.5625, 64.0]
    assert batch["signals", "action_gradient"].tolist() == [3.0, 3.0]
    # (1 * 2.75^2 + 0.5 * 8^2) / 2
    assert log["loss_value"].item() == pytest.approx(19.78125)
    # -(2 + 1.5 + 4 + 1.5) / 2
    assert log["loss_actor"].item() == pytest.approx(-4.5)
    # 1/2 * 2 w (Q - y) dQ/dtheta: (-2.75 * 1 + 0.5 * 8 * 2) and (-2.75 * 0 + 0.5 * 8 * 1).
    assert critic.module.of_state.grad.item() == pytest.approx(5.25)
    assert critic.module.of_action.grad.item() == pytest.approx(4.0)
    assert actor.module.action.grad.item() == pytest.approx(-3.0)


@pytest.mark.parametrize(
    ("weights", "loss_function", "direct"),
    [
        ("none", "l2", True),
        ("none", "smooth_l1", False),
        ("torchrl", "l2", False),
        ("torchrl", "smooth_l1", True),
        ("not in the batch", "l2", False),
        ("not in the batch", "smooth_l1", True),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_losses_and_gradients_equal_torchrls(kind, direct, weights, loss_function):
    networks = make_networks(stochastic=kind == "sac")
    networks = networks if direct else without_shortcut(*networks)
    importance = "none" if weights == "none" else "torchrl"
    options = {"importance": importance, "loss_function": loss_function}
    learner = make_apart(kind, networks=networks, **options)
    plain = {"use_prioritized_weights": False} if weights == "none" else {}
    loss = make_torchrls(kind, learner, loss_function=loss_function, **plain)
    batch = make_batch(weighted=weights != "not in the batch")
    log = differentiate(learner, batch)
    torch.manual_seed(1)
    expected = loss(other := batch.exclude("signals", "td_error"))
    sum(value for key, value in expected.items() if key.startswith("loss")).backward()
    for key, name in (("loss_value", "loss_value"), ("loss_value", "loss_qvalue")):
        if name in expected.keys():  # noqa: SIM118
            torch.testing.assert_close(log[key], expected[name].detach())
    for key in {"loss_actor", "loss_alpha", "alpha", "entropy"} & set(log):
        torch.testing.assert_close(log[key], expected[key].detach(), msg=key)
    squared = other["td_error"].square() if kind == "sac" else other["td_error"]
    torch.testing.assert_close(batch["td_error"], squared)
    gradients, theirs = gradients_of(learner), gradients_of_torchrls(kind, loss)
    if kind == "sac":
        theirs["temperature.log"] = loss.log_alpha.grad
    assert gradients.keys() == theirs.keys()
    for key, gradient in gradients.items():
        torch.testing.assert_close(gradient, theirs[key], msg=key)


@pytest.mark.parametrize("kind", KINDS)
def test_importance_weighs_the_critics_alone_and_divides_by_the_batch_size(kind):
    weighted = make_batch(weighted=True)
    log, plain = (differentiate(make_apart(kind), b) for b in (weighted, make_batch()))
    squares = (log["target_value"] - log["pred_value"]).square().sum(0)
    total = sum(w * s for w, s in zip(weighted["priority_weight"], squares, strict=True))
    torch.testing.assert_close(log["loss_value"], total / 6)
    assert not log["loss_value"].equal(plain["loss_value"])
    for key in {"loss_actor", "loss_alpha"} & set(plain):
        assert log[key].equal(plain[key])
    unread = differentiate(make_apart(kind, importance="none"), make_batch(weighted=True))
    assert unread["loss_value"].equal(plain["loss_value"])


@pytest.mark.parametrize("kind", KINDS)
def test_no_gradient_reaches_the_batch_and_only_signals_are_added(kind):
    learner, batch = make_apart(kind), make_batch()
    batch["observation"].requires_grad_(True)
    before = batch.clone()
    differentiate(learner, batch)
    assert batch["observation"].grad is None
    assert not any(v.requires_grad for k, v in batch.items(True, True) if k != "observation")
    for key in ("observation", "action", ("next", "reward")):
        assert batch[key].equal(before[key])
    assert set(batch.keys()) - set(before.keys()) == {"signals", "td_error"}


def test_actor_may_observe_what_the_critic_does_not():
    actor = TensorDictModule(nn.Linear(5, 2), ["image"], ["action"])
    learner = ActorCritic(actor, make_networks()[1], gamma=GAMMA)
    batch = make_batch()
    batch["image"], batch["next", "image"] = torch.randn(2, 6, 5)
    assert differentiate(learner, batch)["loss_value"].isfinite()
    assert batch["signals", "action_gradient"].shape == (6,)


def test_observations_may_be_nested():
    actor, critic = make_networks()
    nested = (
        TensorDictModule(actor.module, [("agent", "obs")], actor.out_keys),
        TensorDictModule(critic.module, [("agent", "obs"), "action"], critic.out_keys),
    )
    plain, batch = make_batch(), make_batch()
    batch["agent", "obs"] = batch.pop("observation")
    batch["next", "agent", "obs"] = batch["next"].pop("observation")
    expected = differentiate(make_learner(networks=deepcopy((actor, critic))), plain)
    log = differentiate(make_learner(networks=nested), batch)
    for key in ("loss_value", "loss_actor"):
        torch.testing.assert_close(log[key], expected[key])
    torch.testing.assert_close(batch["signals"].to_dict(), plain["signals"].to_dict())


def by_pickle(learner):
    return pickle.loads(pickle.dumps(learner))


@pytest.mark.parametrize("path", [copy, deepcopy, by_pickle], ids=["copy", "deepcopy", "pickle"])
@pytest.mark.parametrize(
    ("kind", "options"),
    [*((kind, {}) for kind in KINDS), ("ddpg", UNTRACED), ("td3", {"optimizer": "radam"})],
    ids=str,
)
def test_copied_learner_learns_as_the_learner_would_and_moves_nothing_of_it(kind, options, path):
    learner, alone = make_learner(kind, **options), make_learner(kind, **options)
    for each in (learner, alone):
        torch.manual_seed(0)
        each.update(make_batch(seed=0))
    if options.get("optimizer") == "radam":
        learner.anneal(0.5), alone.anneal(0.5)
    copied, before = path(learner), snapshot(learner)
    for each in (copied, alone):
        torch.manual_seed(5)
        for seed in range(1, 5):
            each.update(make_batch(seed=seed))
    assert same(snapshot(copied), snapshot(alone))
    assert same(snapshot(learner), before)
    assert copied.policy is copied.networks["actor"]
    assert not same(snapshot(copied), before)


@pytest.mark.parametrize("kind", KINDS)
def test_networks_in_double_precision_learn_in_it(kind):
    actor, critic = make_networks(stochastic=kind == "sac")
    learner = make_learner(kind, networks=(actor.double(), critic.double()))
    batch = make_batch()
    batch.update(batch.select("observation", "action", ("next", "observation")).double())
    batch["next", "reward"] = batch["next", "reward"].double()
    log = learner.update(batch)
    assert log["loss_value"].dtype == torch.double
    assert batch["signals", "action_gradient"].dtype == torch.double


@pytest.mark.parametrize("name", ["smooth_l1", "pal"])
def test_loss_bends_at_one_in_units_of_the_reward(name):
    learner = make_learner(loss_function=name, reward_scale=0.5, pal_alpha=0.7)
    log = differentiate(learner, make_batch())
    values = log["pred_value"][0], log["target_value"], name
    expected = distance(*values, unit=0.5, pal_alpha=0.7)
    torch.testing.assert_close(log["loss_value"], expected.mean())
    other = distance(*values, unit=1.0, pal_alpha=0.7)
    assert not torch.allclose(log["loss_value"], other.mean())


@pytest.mark.parametrize("kind", ["td3", "sac"])
def test_several_critics_start_apart_in_the_range_of_the_one_that_is_given(kind):
    networks = make_networks(stochastic=kind == "sac")
    given = deepcopy(networks[1])
    learner = make_learner(kind, networks=networks)
    first, second = learner.networks["critics"]
    pairs = zip(given.parameters(), first.parameters(), second.parameters(), strict=True)
    for expected, one, other in pairs:
        assert bool((one >= expected.min()).all()) and bool((other <= expected.max()).all())
        assert one.equal(other) == (expected.min() == expected.max())
    assert same(dict(networks[1].named_parameters()), dict(given.named_parameters()))
