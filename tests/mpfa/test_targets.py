"""Targets of several steps and by other estimators: those of TorchRL's own losses."""

from copy import deepcopy

import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.transforms import MultiStepTransform
from torchrl.objectives import DDPGLoss, SACLoss, TD3Loss, ValueEstimators
from torchrl.objectives.value import TDLambdaEstimator

from tests.mpfa.losses import BOUNDS, critics_of, make_batch, make_networks, make_of
from torchrl_mpfa import SignalDDPGLoss, SignalSACLoss, SignalTD3Loss
from torchrl_mpfa.losses.functional import smoothing_noise

# TorchRL warns at every loss whose target networks nothing moves; these tests do not train.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

GAMMA, STEPS = 0.5, 3
KINDS = {
    "ddpg": (SignalDDPGLoss, DDPGLoss, {"delay_actor": True, "loss_function": "l2"}),
    "td3": (SignalTD3Loss, TD3Loss, {"bounds": BOUNDS, "loss_function": "l2"}),
    "sac": (SignalSACLoss, SACLoss, {"loss_function": "l2", "alpha_init": 0.3}),
}


def make_pair(name, estimator=ValueEstimators.TD0, **options):
    """Our loss and TorchRL's with the same networks, whose targets differ from them."""
    ours, theirs, common = KINDS[name]
    networks = make_networks(stochastic=name == "sac")
    pair = theirs(*deepcopy(networks), **common), ours(*networks, **common, importance="torchrl")
    for loss in pair:
        loss.make_value_estimator(estimator, **{"gamma": GAMMA, **options})
    with torch.no_grad():
        for key, value in pair[1].named_buffers():
            if key.startswith("target_"):
                value.mul_(0.7)
    pair[0].load_state_dict(pair[1].state_dict())
    return pair


def of_several_steps(count=14, **options):
    """What a buffer holds after TorchRL's transform: ends in the middle, and a time limit."""
    transform = MultiStepTransform(n_steps=STEPS, gamma=GAMMA, **options)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(count), transform=transform, batch_size=1
    )
    trajectory = make_batch(count)
    ends = trajectory["next"]
    for key, row in (("terminated", 5), ("truncated", 9)):
        ends[key] = torch.zeros(count, 1, dtype=torch.bool)
        ends[key][row] = True
    ends["done"] = ends["terminated"] | ends["truncated"]
    buffer.extend(trajectory)
    return buffer[:]


def targets_of(loss, batch):
    """Targets, or where TorchRL does not tell them what shows them: the critics' loss."""
    torch.manual_seed(3)  # TD3 and SAC ask random actions.
    losses = loss(batch)
    return losses["target_value"] if "target_value" in losses.keys() else losses["loss_qvalue"]  # noqa: SIM118


@pytest.mark.parametrize("column", [False, True], ids=["[B]", "[B, 1]"])
@pytest.mark.parametrize("options", [{}, {"done_keys": ["done"]}], ids=str)
@pytest.mark.parametrize("name", KINDS)
def test_targets_of_several_steps_are_those_of_torchrls_loss(name, options, column):
    batch = of_several_steps(**options)
    assert set(batch["steps_to_next_obs"].flatten().tolist()) == {1, 2, 3}
    assert bool(batch["next", "terminated"].any())
    if column:
        batch["steps_to_next_obs"] = batch["steps_to_next_obs"].unsqueeze(-1)
    theirs, ours = make_pair(name)
    expected = targets_of(theirs, batch.clone())
    torch.testing.assert_close(targets_of(ours, batch.clone()), expected)
    one_step = targets_of(ours, batch.exclude("steps_to_next_obs"))
    assert not torch.allclose(one_step, expected)


@pytest.mark.parametrize("name", ["ddpg", "td3"])
def test_target_of_several_steps_is_its_formula_row_by_row(name):
    batch = of_several_steps(done_keys=["done"])
    _, loss = make_pair(name)
    networks = loss._networks()
    torch.manual_seed(3)
    compute = loss.value_loss if name == "td3" else loss.loss_value
    found = compute(batch)[1]["target_value"]
    torch.manual_seed(3)
    noise = torch.zeros(len(batch), 2)
    if name == "td3":
        noise = smoothing_noise(noise, deviation=loss.policy_noise, limit=loss.noise_clip)
    for row in range(len(batch)):
        after = batch["next"][row]
        action = networks.target_actor.module(after["observation"])[1] + noise[row]
        action = action.clamp(-1.0, 1.0)
        value = min(float(q.module(after["observation"], action)) for q in networks.target_critics)
        expected = float(after["reward"])
        if not bool(after["terminated"]):
            expected += GAMMA ** int(batch["steps_to_next_obs"][row]) * value
        assert float(found[row]) == pytest.approx(expected, abs=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_target_of_sac_is_soft_row_by_row(scale):
    loss = make_of("sac", reward_scale=scale, signals=["td_error", "value"], gamma=0.9)
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
            target += 0.9 * value
        assert float(log["target_value"][row]) == pytest.approx(target, rel=1e-4)
        values = [float(q(batch["observation"][row], batch["action"][row])) for q in current]
        error = max(abs(target - value) for value in values) / scale
        assert float(batch["signals", "td_error"][row]) == pytest.approx(error, rel=1e-4)
        assert float(batch["signals", "value"][row]) == pytest.approx(values[0] / scale, rel=1e-4)


@pytest.mark.parametrize(
    ("estimator", "options"),
    [
        (ValueEstimators.TDLambda, {"lmbda": 0.7}),
        (ValueEstimators.TD1, {}),
        (ValueEstimators.TD0, {"average_rewards": True}),
    ],
    ids=str,
)
@pytest.mark.parametrize("name", KINDS)
def test_other_value_estimators_are_honored_as_by_torchrl(name, estimator, options):
    theirs, ours = make_pair(name, estimator, **options)
    batch = make_batch(12).reshape(2, 6)
    expected = targets_of(theirs, batch.clone())
    found = targets_of(ours, batch.clone())
    torch.testing.assert_close(found, expected)
    ours.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    assert not torch.allclose(targets_of(ours, batch.clone()), expected)


@pytest.mark.parametrize("name", KINDS)
def test_rewards_are_scaled_for_longer_targets_too(name):
    loss, batch = make_of(name, reward_scale=3.0), make_batch().reshape(1, 6)
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.5, lmbda=0.5)
    for key in ("terminated", "done"):
        batch["next", key] = torch.ones(1, 6, 1, dtype=torch.bool)
    _, log = loss.losses(batch, trains="critic")
    torch.testing.assert_close(log["target_value"], batch["next", "reward"].squeeze(-1) * 3.0)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32], ids=str)
@pytest.mark.parametrize("estimator", [ValueEstimators.TD0, ValueEstimators.TD1], ids=str)
@pytest.mark.parametrize("name", KINDS)
def test_ends_that_are_numbers_count_as_booleans(name, estimator, dtype):
    _, loss = make_pair(name, estimator)
    batch = make_batch(12).reshape(2, 6)
    numbers = batch.clone()
    for key in ("done", "terminated"):
        numbers["next", key] = numbers["next", key].to(dtype)
    torch.testing.assert_close(targets_of(loss, numbers), targets_of(loss, batch))
    assert numbers["next", "terminated"].dtype is dtype


@pytest.mark.parametrize("name", KINDS)
def test_estimator_object_equals_the_estimator_by_name(name):
    _, by_name = make_pair(name, ValueEstimators.TDLambda, lmbda=0.7)
    _, given = make_pair(name)
    made = TDLambdaEstimator(gamma=GAMMA, lmbda=0.7, value_network=None)
    given.make_value_estimator(made)
    batch = make_batch(12).reshape(2, 6)
    found, expected = (targets_of(loss, batch.clone()) for loss in (given, by_name))
    torch.testing.assert_close(found, expected)


def test_target_of_ddpg_is_at_an_action_with_noise_within_the_bounds():
    noisy = {"policy_noise": 0.8, "noise_clip": 0.6, "bounds": (-0.5, 0.5), "gamma": GAMMA}
    loss, batch = make_of("ddpg", **noisy), make_batch()
    torch.manual_seed(3)
    _, log = loss.loss_value(batch)
    after, networks = batch["next"], loss._networks()
    with torch.no_grad():
        action = networks.target_actor.outputs(after)["action"]
        torch.manual_seed(3)
        noise = (torch.randn_like(action) * 0.8).clamp(-0.6, 0.6)
        assert bool((noise.abs() == 0.6).any())
        smoothed = (action + noise).clamp(-0.5, 0.5)
        value = networks.target_critics[0].module(after["observation"], smoothed)
    expected = after["reward"] + GAMMA * value * ~after["terminated"]
    torch.testing.assert_close(log["target_value"], expected.squeeze(-1))


def test_without_noise_ddpg_takes_no_random_number_and_has_the_same_state():
    loss = make_of("ddpg")
    before = torch.get_rng_state()
    loss(make_batch())
    assert torch.get_rng_state().equal(before)
    noisy = make_of("ddpg", policy_noise=0.1, bounds=BOUNDS)
    assert loss.state_dict().keys() == noisy.state_dict().keys()
