"""Options that steady a single critic: what each of them computes, eager and compiled."""

import math

import pytest
import torch

from tests.mpfa.losses import BOUNDS, GAMMA, differentiate_at_once, make_batch, make_networks
from torchrl_mpfa import (
    DDPGLearner,
    Draw,
    TD3Learner,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_td3_loss,
)
from torchrl_mpfa.categorical import bin_edges, gaussian_histogram, hl_gauss_loss, mean_value

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

# The function that would be compiled, as it is.
UNTRACED = {"disable": True}
RATES = {"actor_lr": 1e-2, "critic_lr": 1e-2}


def make_loss(name="ddpg", *, networks=None, **options):
    make = {"ddpg": make_ddpg_loss, "td3": make_td3_loss}[name]
    if name == "td3":
        options = {"bounds": BOUNDS, **options}
    loss = make(*make_networks(**(networks or {})), gamma=GAMMA, **options)
    with torch.no_grad():
        for key, value in loss.named_buffers():
            if key.startswith("target_"):
                value.mul_(0.9)
    return loss


def make_learner(name, loss, **options):
    return {"ddpg": DDPGLearner, "td3": TD3Learner}[name](loss, **{**RATES, **options})


def copied(params):
    return {key: value.detach().clone() for key, value in params.flatten_keys(".").items()}


def assert_same_steps(learners, *, updates=12):
    for seed in range(updates):
        logs = []
        for learner in learners:
            torch.manual_seed(seed)
            batch = make_batch(seed=seed, weighted=True)
            logs.append({**learner.update(batch), **batch["signals"]})
        for key in ("loss_value", "action_gradient"):
            torch.testing.assert_close(logs[1][key], logs[0][key], rtol=1e-3, atol=1e-5)
    one, other = (learner.loss.state_dict() for learner in learners)
    assert one.keys() == other.keys()
    for key, value in one.items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(other[key], value, rtol=1e-3, atol=1e-4)


# Target smoothing and a delayed actor ------------------------------------------------------------


def test_the_target_of_ddpg_is_at_an_action_with_noise_within_the_bounds():
    loss, batch = make_loss(policy_noise=0.8, noise_clip=0.6, bounds=(-0.5, 0.5)), make_batch()
    torch.manual_seed(3)
    _, log = loss.loss_value(batch)
    after = batch["next"]
    with torch.no_grad(), loss.target_actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network.outputs(after)["action"]
    torch.manual_seed(3)
    noise = (torch.randn_like(action) * 0.8).clamp(-0.6, 0.6)
    assert bool((noise.abs() == 0.6).any())
    smoothed = (action + noise).clamp(-0.5, 0.5)
    with torch.no_grad(), loss.target_value_network_params.to_module(loss.value_network):
        value = loss.value_network.module(after["observation"], smoothed)
    expected = after["reward"] + GAMMA * value * ~after["terminated"]
    torch.testing.assert_close(log["target_value"], expected.squeeze(-1))


def test_noise_in_the_program_is_that_of_the_loss():
    losses = [make_loss(policy_noise=0.8, bounds=BOUNDS) for _ in range(2)]
    torch.manual_seed(3)
    _, log = losses[0].loss_value(make_batch())
    torch.manual_seed(3)
    found = differentiate_at_once(losses[1], make_batch())
    torch.testing.assert_close(found["target_value"], log["target_value"])


def test_without_noise_ddpg_draws_no_random_number_and_has_the_same_state():
    torch.manual_seed(3)
    before = torch.get_rng_state()
    loss = make_loss()
    torch.manual_seed(3)
    loss(make_batch())
    assert torch.get_rng_state().equal(before)
    noisy = make_loss(policy_noise=0.1, bounds=BOUNDS)
    assert loss.state_dict().keys() == noisy.state_dict().keys()


def test_noise_without_bounds_is_refused():
    with pytest.raises(ValueError, match="one of action_spec and bounds must be given"):
        make_loss(policy_noise=0.1)
    with pytest.raises(ValueError, match="policy_noise must be finite and at least"):
        make_loss(policy_noise=-0.1, bounds=BOUNDS)
    with pytest.raises(ValueError, match="low < high"):
        make_loss(policy_noise=0.1, bounds=(1.0, -1.0))


@pytest.mark.parametrize("compile", [False, UNTRACED])
def test_a_delayed_actor_of_ddpg_moves_with_the_targets_at_every_third_update(compile):
    learner = make_learner("ddpg", make_loss(), policy_delay=3, compile=compile)
    loss, moved = learner.loss, []
    watched = (
        loss.actor_network_params,
        loss.target_actor_network_params,
        loss.target_value_network_params,
        loss.value_network_params,
    )
    for seed in range(6):
        before = [copied(params) for params in watched]
        learner.update(make_batch(seed=seed))
        after = [copied(params) for params in watched]
        moved.append(
            [any(not b[k].equal(a[k]) for k in b) for b, a in zip(before, after, strict=True)]
        )
    assert moved == [[False, False, False, True]] * 2 + [[True] * 4] + (
        [[False, False, False, True]] * 2 + [[True] * 4]
    )


def test_a_delayed_smoothed_ddpg_is_the_same_compiled():
    learners = [
        make_learner(
            "ddpg",
            make_loss(policy_noise=0.3, bounds=BOUNDS),
            policy_delay=2,
            compile=compile,
        )
        for compile in (False, UNTRACED)
    ]
    assert_same_steps(learners)


def test_a_delay_that_is_no_count_is_refused():
    with pytest.raises(ValueError, match="policy_delay must be a positive integer, got 0"):
        make_learner("ddpg", make_loss(), policy_delay=0)


# Weights of unit length --------------------------------------------------------------------------

UNIT = {"normalize_weights": True}


def hidden_weights(loss, critic):
    """The weights of all hidden layers, by name; of two critics they are stacked."""
    actor = loss.actor_network_params.flatten_keys(".")
    critics = getattr(loss, f"{critic}_params").flatten_keys(".")
    return {
        **{f"actor {i}": actor[f"module.body.{i}.weight"] for i in (0, 3)},
        "critic first": critics["module.first.0.weight"],
        "critic rest": critics["module.rest.0.weight"],
    }


CRITICS = {"ddpg": "value_network", "td3": "qvalue_network"}


@pytest.mark.parametrize("name", CRITICS)
@pytest.mark.parametrize("compile", [False, UNTRACED])
def test_rows_of_hidden_weights_keep_length_one_and_the_last_layer_is_free(name, compile):
    loss = make_loss(name, networks=UNIT)
    learner = make_learner(name, loss, compile=compile)
    start = copied(loss.actor_network_params)
    for number in range(5):
        for key, weight in hidden_weights(loss, CRITICS[name]).items():
            length = weight.detach().square().sum(-1).sqrt()
            torch.testing.assert_close(length, torch.ones_like(length), msg=key)
        learner.update(make_batch(seed=number))
    end = copied(loss.actor_network_params)
    assert not end["module.body.0.weight"].equal(start["module.body.0.weight"])
    lengths = end["module.head.weight"].norm(dim=-1)
    assert bool(((lengths - 1.0).abs() > 1e-2).all())


@pytest.mark.parametrize("name", CRITICS)
@pytest.mark.parametrize("compile", [False, UNTRACED])
def test_a_step_is_the_optimizers_and_then_each_row_by_its_length(name, compile):
    free = make_learner(name, make_loss(name))
    unit = make_learner(name, make_loss(name, networks=UNIT), compile=compile)
    unit.update(make_batch(seed=1))
    free.load_state_dict(unit.state_dict())
    for learner in (free, unit):
        torch.manual_seed(2)
        learner.update(make_batch(seed=2))
    stepped, found = (hidden_weights(each.loss, CRITICS[name]) for each in (free, unit))
    for key, weight in stepped.items():
        rows = weight.detach().reshape(-1, weight.shape[-1])
        expected = torch.stack([row / row.square().sum().sqrt() for row in rows])
        got = found[key].detach().reshape(-1, weight.shape[-1])
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", CRITICS)
def test_unit_weights_are_the_same_compiled(name):
    learners = [
        make_learner(name, make_loss(name, networks=UNIT), compile=compile)
        for compile in (False, UNTRACED)
    ]
    assert_same_steps(learners)


# A categorical critic ----------------------------------------------------------------------------

RANGE = (-2.0, 3.0)
BINS = {"bins": 11, "value_range": RANGE}


def make_categorical(name, **options):
    torch.manual_seed(0)
    sizes = {"width": 16, "final_init": 0.5}
    actor, critic = make_actor(5, 2, **sizes), make_critic(5, 2, **sizes, **BINS)
    more = {"bounds": BOUNDS, **options} if name == "td3" else options
    make = {"ddpg": make_ddpg_loss, "td3": make_td3_loss}[name]
    return make(actor, critic, gamma=GAMMA, **{"loss_function": "hl_gauss", **more})


def by_loops(logits, target, low, high):
    """Cross-entropy of one histogram with a Gaussian, bin by bin; and the histogram's mean."""
    count = len(logits)
    width = (high - low) / count
    deviation = 0.75 * width
    target = min(max(target, low), high)

    def below(x):
        return 0.5 * (1.0 + math.erf((x - target) / (math.sqrt(2.0) * deviation)))

    whole = below(high) - below(low)
    total = sum(math.exp(each) for each in logits)
    loss = value = 0.0
    for k, each in enumerate(logits):
        share = (below(low + (k + 1) * width) - below(low + k * width)) / whole
        loss -= share * math.log(math.exp(each) / total)
        value += math.exp(each) / total * (low + (k + 0.5) * width)
    return loss, value


def test_loss_and_mean_of_histograms_are_those_of_a_loop_over_bins():
    logits = torch.randn(6, 11, generator=torch.Generator().manual_seed(0), dtype=torch.double)
    target = torch.tensor([-5.0, -2.0, -0.1, 1.3, 3.0, 99.0], dtype=torch.double)
    losses, values = hl_gauss_loss(logits, target, RANGE), mean_value(logits, RANGE)
    rows = zip(logits.tolist(), target.tolist(), losses, values, strict=True)
    for row, wanted, loss, value in rows:
        expected = by_loops(row, wanted, *RANGE)
        assert (loss.item(), value.item()) == pytest.approx(expected)


@pytest.mark.parametrize("target", [-1.9, 0.0, 2.2])
def test_the_mean_of_the_histogram_that_is_learned_is_the_target_but_near_the_ends(target):
    edges = bin_edges(torch.zeros(51), RANGE)
    shares = gaussian_histogram(torch.tensor(target), edges)
    assert shares.sum().item() == pytest.approx(1.0, abs=1e-5)
    assert mean_value(shares.log(), RANGE).item() == pytest.approx(target, abs=0.02)


@pytest.mark.parametrize("name", CRITICS)
def test_the_loss_of_a_categorical_critic_is_the_cross_entropy_with_its_targets(name):
    loss, batch = make_categorical(name), make_batch(weighted=True)
    torch.manual_seed(1)
    values, log = loss._critics_part(batch)
    critics = loss._held_critics("")
    logits = [each.module(batch["observation"], batch["action"])[1] for each in critics]
    expected = 0.0
    for row in range(len(batch)):
        for each in logits:
            found, _ = by_loops(each[row].tolist(), log["target_value"][row].item(), *RANGE)
            expected += found * batch["priority_weight"][row].item() / len(batch)
    assert values.item() == pytest.approx(expected, rel=1e-4)
    _, value = by_loops(logits[0][0].tolist(), 0.0, *RANGE)
    assert log["pred_value"].reshape(-1)[0].item() == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize("name", CRITICS)
@pytest.mark.parametrize("defer", [False, True])
def test_signals_of_a_categorical_critic_are_those_of_its_mean(name, defer):
    loss, batch = make_categorical(name, reward_scale=0.5), make_batch()
    value, log = loss._critics_part(batch, defer_gradient=defer)
    value.backward()
    loss.write_action_gradient(batch)
    critic = loss._held_critics("")[0].module
    action = batch["action"].clone().requires_grad_(True)
    found = critic(batch["observation"], action)[0].squeeze(-1)
    (slope,) = torch.autograd.grad(found.sum(), action)
    torch.testing.assert_close(batch["signals", "action_gradient"], slope.norm(dim=-1) / 0.5)
    error = (log["target_value"] - log["pred_value"].reshape(-1, len(batch))).abs().amax(0)
    torch.testing.assert_close(batch["signals", "td_error"], error / 0.5)


@pytest.mark.parametrize("name", CRITICS)
@pytest.mark.parametrize("loss_function", ["hl_gauss", "smooth_l1"])
def test_a_categorical_critic_is_the_same_compiled(name, loss_function):
    learners = [
        make_learner(name, make_categorical(name, loss_function=loss_function), compile=compile)
        for compile in (False, UNTRACED)
    ]
    assert_same_steps(learners)


@pytest.mark.slow
def test_a_traced_categorical_critic_is_the_same():
    learners = [
        make_learner("ddpg", make_categorical("ddpg"), compile=compile)
        for compile in (False, {"backend": "eager"})
    ]
    assert_same_steps(learners, updates=3)


def test_bins_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="'hl_gauss' needs a critic with bins"):
        make_loss(loss_function="hl_gauss")
    with pytest.raises(ValueError, match="bins and value_range must both be given, got bins=5"):
        make_critic(5, 2, bins=5)
    with pytest.raises(ValueError, match="bins must be at least 2 and value_range finite"):
        make_critic(5, 2, bins=1, value_range=RANGE)
    with pytest.raises(ValueError, match=r"low < high, got 5 and \(3.0, -2.0\)"):
        make_critic(5, 2, bins=5, value_range=RANGE[::-1])
    with pytest.raises(ValueError, match="target_average must be 1 with bins, got 2"):
        make_categorical("ddpg", target_average=2)
    learner = make_learner("ddpg", make_loss())
    with pytest.raises(ValueError, match="'hl_gauss' needs a critic with bins"):
        learner.update(Draw(make_batch(), loss_function="hl_gauss"))
