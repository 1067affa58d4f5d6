"""SignalTD3Loss and TD3Learner: equal to TorchRL's TD3, and the signals by hand."""

from copy import deepcopy

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.objectives import TD3Loss, ValueEstimators

from tests.mpfa import sac_networks
from tests.mpfa.losses import BOUNDS, GAMMA, make_batch, make_networks, parameter_gradients
from torchrl_mpfa import SignalTD3Loss, TD3Learner, make_ddpg_loss, make_td3_loss

# TorchRL warns at every loss whose target networks nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def make_loss(seed=0, **kwargs):
    return make_td3_loss(*make_networks(seed), gamma=GAMMA, bounds=BOUNDS, **kwargs)


def make_learner(**kwargs):
    return TD3Learner(make_loss(), **{"actor_lr": 1e-3, "critic_lr": 1e-3, **kwargs})


def separate_targets(loss, theirs):
    """Target networks that differ from the current ones, the same in both losses."""
    with torch.no_grad():
        for params in (loss.target_qvalue_network_params, loss.target_actor_network_params):
            for tensor in params.flatten_keys().values():
                tensor.mul_(0.7)
    theirs.load_state_dict(loss.state_dict())


def without_shortcut(network):
    """The same network as a module that must be called with tensordicts."""
    return TensorDictModule(network.module, network.in_keys, network.out_keys)


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("loss_function", ["l2", "smooth_l1"])
def test_losses_and_gradients_equal_torchrls(direct, weighted, loss_function):
    networks = make_networks()
    if not direct:
        networks = tuple(without_shortcut(network) for network in networks)
    theirs = TD3Loss(*deepcopy(networks), bounds=(-1.0, 1.0), loss_function=loss_function)
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    ours = make_td3_loss(
        *networks, gamma=GAMMA, bounds=BOUNDS, importance="torchrl", loss_function=loss_function
    )
    separate_targets(ours, theirs)
    found = []
    for loss in (ours, theirs):
        torch.manual_seed(1)  # Both smooth their targets by noise.
        batch = make_batch(weighted=weighted)
        losses = loss(batch)
        (losses["loss_actor"] + losses["loss_qvalue"]).backward()
        found.append((losses, batch["td_error"], parameter_gradients(loss)))
    (mine, error, gradients), (expected, expected_error, expected_gradients) = found
    for key in ("loss_actor", "loss_qvalue", "pred_value", "target_value", "next_state_value"):
        torch.testing.assert_close(mine[key], expected[key], msg=key)
    torch.testing.assert_close(error, expected_error)
    assert gradients.keys() == expected_gradients.keys()
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected_gradients[name], msg=name)


def test_the_signals_are_the_larger_error_and_the_slope_of_the_first_critic():
    loss, batch = make_loss(), make_batch()
    losses = loss(batch)
    errors = (losses["target_value"] - losses["pred_value"]).abs()
    torch.testing.assert_close(batch["signals", "td_error"], errors.amax(0))
    assert not errors[0].equal(errors[1])
    action = batch["action"].clone().requires_grad_(True)
    first = deepcopy(loss.qvalue_network)
    loss.qvalue_network_params[0].detach().to_module(first)
    for row in range(len(batch)):
        value = first.module(batch["observation"][row], action[row]).sum()
        (slope,) = torch.autograd.grad(value, action)
        expected = slope[row].norm()
        torch.testing.assert_close(batch["signals", "action_gradient"][row], expected)


def test_importance_weighs_the_critics_alone():
    weighted, plain = make_batch(weighted=True), make_batch()
    losses = []
    for batch in (weighted, plain):
        torch.manual_seed(0)
        losses.append(make_loss()(batch))
    errors = losses[0]["target_value"] - losses[0]["pred_value"]
    expected = (errors.square().sum(0) * weighted["priority_weight"]).mean()
    torch.testing.assert_close(losses[0]["loss_qvalue"], expected)
    assert losses[0]["loss_actor"].equal(losses[1]["loss_actor"])


def test_signals_stay_in_the_units_of_the_reward():
    found = []
    for scale in (1.0, 0.1):
        # Critics that say nothing: the error is the scaled reward and what bootstraps is zero.
        loss, batch = make_loss(reward_scale=scale), make_batch()
        for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
            for tensor in params.flatten_keys().values():
                tensor.data.zero_()
        loss(batch)
        found.append(batch["signals", "td_error"])
    torch.testing.assert_close(found[0], found[1])
    torch.testing.assert_close(found[0], make_batch()["next", "reward"].squeeze(1).abs())


def test_the_penalty_on_saturation_is_added_to_the_actors_loss():
    plain, penalized = (
        make_loss(saturation_penalty=factor, saturation_limit=0.1)(make_batch())
        for factor in (0.0, 2.0)
    )
    assert penalized["loss_actor"] > plain["loss_actor"]
    assert penalized["loss_qvalue"].isfinite()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("signals", ["novelty"]),
        ("importance", "all"),
        ("reward_scale", 0.0),
        ("saturation_penalty", -1.0),
    ],
)
def test_a_bad_option_is_named(name, value):
    with pytest.raises(ValueError, match=name):
        make_loss(**{name: value})


def test_the_actor_and_the_targets_move_at_every_second_update_only():
    learner = make_learner()
    values = {**dict(learner.loss.named_parameters()), **dict(learner.loss.named_buffers())}
    for update in range(1, 5):
        before = {name: value.detach().clone() for name, value in values.items()}
        log = learner.update(make_batch(seed=update))
        moved = {name for name, value in values.items() if not value.equal(before[name])}
        assert any(name.startswith("qvalue") for name in moved)
        late = {n for n in moved if n.startswith(("actor", "target"))}
        assert bool(late) == (update % 2 == 0)
        assert ("loss_actor" in log) == (update % 2 == 0)


def test_the_two_critics_start_apart():
    params = make_loss().qvalue_network_params.flatten_keys()
    weights = [value for name, value in params.items() if name.endswith("weight")]
    assert any(not value[0].equal(value[1]) for value in weights)


def test_training_lowers_the_error_of_the_critics_on_a_fixed_batch():
    learner = make_learner(tau=0.001)
    first = learner.update(make_batch())["loss_value"]
    for _ in range(200):
        last = learner.update(make_batch())["loss_value"]
    assert last < 0.2 * first


def test_a_restored_learner_goes_on_to_the_same_numbers():
    learner, restored = make_learner(), make_learner()
    for seed in range(3):
        learner.update(make_batch(seed=seed))
    restored.load_state_dict(deepcopy(learner.state_dict()))
    found = []
    for each in (learner, restored):
        torch.manual_seed(7)
        found.append([each.update(make_batch(seed=seed))["loss_value"] for seed in range(3, 6)])
    assert all(a.equal(b) for a, b in zip(*found, strict=True))


def test_a_delay_below_one_is_refused():
    with pytest.raises(ValueError, match=r"policy_delay must be an integer from 1 to .*, got 0"):
        make_learner(policy_delay=0)


def test_an_action_spec_takes_the_place_of_bounds():
    from torchrl.data import Bounded

    spec = Bounded(low=-0.5, high=0.5, shape=(2,))
    loss = SignalTD3Loss(*make_networks(), action_spec=spec)
    assert loss.max_action.tolist() == [0.5, 0.5]


@pytest.mark.parametrize(
    "key", ["observation", "action", "next", ("next", "reward"), ("next", "terminated")], ids=str
)
def test_a_missing_input_is_named(key):
    batch = make_batch().exclude(key)
    word = key if isinstance(key, str) else key[-1]
    for loss in (make_loss(), make_ddpg_loss(*make_networks()), sac_networks.make_loss()):
        with pytest.raises(KeyError, match=word):
            loss(batch)
