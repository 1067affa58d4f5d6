"""Options that steady DDPG: what each of them computes, eager and compiled."""

import pytest
import torch

from tests.mpfa.losses import BOUNDS, GAMMA, differentiate_at_once, make_batch, make_networks
from torchrl_mpfa import DDPGLearner, make_ddpg_loss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

# The function that would be compiled, as it is.
UNTRACED = {"disable": True}
RATES = {"actor_lr": 1e-2, "critic_lr": 1e-2}


def make_loss(**options):
    loss = make_ddpg_loss(*make_networks(), gamma=GAMMA, **options)
    with torch.no_grad():
        for key, value in loss.named_buffers():
            if key.startswith("target_"):
                value.mul_(0.9)
    return loss


def make_learner(loss, **options):
    return DDPGLearner(loss, **{**RATES, **options})


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


@pytest.mark.parametrize("compile", [False, UNTRACED])
def test_a_delayed_actor_of_ddpg_moves_with_the_targets_at_every_third_update(compile):
    learner = make_learner(make_loss(), policy_delay=3, compile=compile)
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
            make_loss(policy_noise=0.3, bounds=BOUNDS),
            policy_delay=2,
            compile=compile,
        )
        for compile in (False, UNTRACED)
    ]
    assert_same_steps(learners)


def test_a_delay_that_is_no_count_is_refused():
    with pytest.raises(ValueError, match=r"policy_delay must be an integer from 1 to .*, got 0"):
        make_learner(make_loss(), policy_delay=0)
