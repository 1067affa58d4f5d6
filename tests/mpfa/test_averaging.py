"""Targets out of several earlier critics (Averaged-DDPG)."""

import copy

import pytest
import torch

from tests.mpfa import losses
from tests.mpfa.losses import GAMMA, make_batch
from torchrl_mpfa.losses.functional import smoothing_noise

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

KINDS = ["ddpg", "td3"]


def make_learner(kind, average, seed=0):
    rates = {"actor_lr": 1e-2, "critic_lr": 1e-2, "tau": 0.5}
    return losses.make_learner(kind, seed, of_loss={"target_average": average}, **rates)


def target_of(learner, batch, seed=7):
    torch.manual_seed(seed)  # TD3 has noise in its targets.
    with torch.no_grad():
        return learner.loss.losses(batch, trains="critic")[1]["target_value"]


@pytest.mark.parametrize("name", KINDS)
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


@pytest.mark.parametrize("name", KINDS)
def test_target_is_the_mean_over_the_present_and_the_earlier_critics(name):
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
            noise = smoothing_noise(action, deviation=loss.policy_noise, limit=loss.noise_clip)
            action = (action + noise).clamp(-1, 1)
        given = {"observation": after["observation"], "action": action}
        each = [critic.outputs(given) for critic in networks.target_critics]
        return torch.stack([found["state_action_value"].squeeze(-1) for found in each])


@pytest.mark.parametrize("name", KINDS)
def test_averaged_targets_are_saved_and_loaded(name):
    first, second = make_learner(name, 3), make_learner(name, 3, seed=1)
    for seed in range(4):
        first.update(make_batch(seed=seed))
        first.end_episode()
    second.load_state_dict(first.state_dict())
    batch = make_batch(seed=30)
    assert torch.equal(target_of(first, batch.clone()), target_of(second, batch.clone()))
