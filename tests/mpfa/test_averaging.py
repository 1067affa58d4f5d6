"""Targets out of several earlier critics (Averaged-DDPG)."""

import copy

import pytest
import torch

from tests.mpfa.losses import BOUNDS, GAMMA, make_batch, make_networks
from torchrl_mpfa import DDPGLearner, TD3Learner, make_ddpg_loss, make_td3_loss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

MAKE = {
    "ddpg": (make_ddpg_loss, DDPGLearner, "target_value_network_params"),
    "td3": (make_td3_loss, TD3Learner, "target_qvalue_network_params"),
}


def make_learner(name, average, seed=0, **kwargs):
    make, learner, _ = MAKE[name]
    more = {"bounds": BOUNDS} if name == "td3" else {}
    loss = make(*make_networks(seed), gamma=GAMMA, target_average=average, **more)
    return learner(loss, critic_lr=1e-2, actor_lr=1e-2, tau=0.5, **kwargs)


def target_of(learner, batch, seed=7):
    torch.manual_seed(seed)  # TD3 has noise in its targets.
    update = {"ddpg": "loss_value", "td3": "value_loss"}
    kind = "ddpg" if isinstance(learner, DDPGLearner) else "td3"
    with torch.no_grad():
        return getattr(learner.loss, update[kind])(batch)[1]["target_value"]


@pytest.mark.parametrize("name", MAKE)
def test_with_one_critic_every_step_is_the_same_as_without_averaging(name):
    averaged, plain = make_learner(name, 1), make_learner(name, 1)
    plain.end_episode = lambda: None
    for seed in range(4):
        for learner in (averaged, plain):
            torch.manual_seed(seed)
            learner.update(make_batch(seed=seed))
            learner.end_episode()
    for mine, other in zip(
        averaged.loss.state_dict().values(), plain.loss.state_dict().values(), strict=True
    ):
        assert torch.equal(mine, other)


@pytest.mark.parametrize("name", MAKE)
def test_the_target_is_the_mean_over_the_present_and_the_earlier_critics(name):
    learner, batch = make_learner(name, 3), make_batch(seed=20)
    states = []
    for episode in range(5):
        # The plain loss with the target networks of each time, by which to check.
        present = copy.deepcopy(learner.loss.state_dict())
        kept = [*states[-2:], present]
        terms = []
        for state in kept:
            plain = make_learner(name, 1)
            own = {k: v for k, v in state.items() if not k.startswith("past_critics")}
            # Only the target critics are of the past: the target actor is the present one.
            own.update({k: v for k, v in present.items() if k.startswith("target_actor")})
            plain.loss.load_state_dict(own)
            terms.append(next_values(name, plain, batch))
        reward = batch["next", "reward"].squeeze(-1)
        goes_on = ~batch["next", "terminated"].squeeze(-1)
        mean = torch.stack(terms).mean(0).amin(0)
        torch.testing.assert_close(
            target_of(learner, batch.clone()), reward + GAMMA * mean * goes_on
        )
        learner.end_episode()
        states.append(present)
        learner.update(make_batch(seed=episode))
        learner.update(make_batch(seed=episode + 10))


def next_values(name, learner, batch):
    """Q of each target critic at the next state, shape [critics, B]."""
    loss, after = learner.loss, batch["next"]
    networks = loss._networks()
    torch.manual_seed(7)
    with torch.no_grad():
        action = networks.target_actor.outputs(after)["action"]
        if name == "td3":
            action = (action + loss.target_noise(action)).clamp(-1, 1)
        given = {"observation": after["observation"], "action": action}
        each = [critic.outputs(given) for critic in networks.target_critics]
        return torch.stack([found["state_action_value"].squeeze(-1) for found in each])


@pytest.mark.parametrize("name", MAKE)
def test_averaged_targets_go_on_from_a_state_that_is_loaded(name):
    first, second = make_learner(name, 3), make_learner(name, 3, seed=1)
    for seed in range(4):
        first.update(make_batch(seed=seed))
        first.end_episode()
    second.load_state_dict(first.state_dict())
    batch = make_batch(seed=30)
    assert torch.equal(target_of(first, batch.clone()), target_of(second, batch.clone()))


@pytest.mark.slow
def test_a_traced_learner_averages_as_well():
    plain, traced = make_learner("ddpg", 3), make_learner("ddpg", 3, compile={"backend": "eager"})
    for seed in range(4):
        one, other = make_batch(seed=seed), make_batch(seed=seed)
        for learner, batch in ((plain, one), (traced, other)):
            learner.update(batch)
            learner.end_episode()
        torch.testing.assert_close(other["signals"].to_dict(), one["signals"].to_dict())
