"""Targets out of several earlier critics (Averaged-DDPG)."""

import copy

import pytest
import torch

from tests.mpfa import learning
from tests.mpfa.learning import GAMMA, KINDS, make_batch
from torchrl_mpfa.losses import smoothing_noise

DETERMINISTIC = ["ddpg", "td3"]


def make_learner(kind, average, seed=0):
    rates = {"actor_lr": 1e-2, "critic_lr": 1e-2, "tau": 0.5}
    return learning.make_learner(kind, seed, target_average=average, **rates)


def target_of(learner, batch, seed=7):
    torch.manual_seed(seed)  # TD3 has noise in its targets.
    return learner.targets_of(batch)


@pytest.mark.parametrize("kind", KINDS)
def test_target_is_the_mean_over_the_present_and_the_earlier_critics(kind):
    learner, batch = make_learner(kind, 3), make_batch(seed=20)
    learner.update(make_batch(seed=30))
    states = []
    for episode in range(5):
        present = copy.deepcopy(learner.targets["critics"])
        mean = next_values(learner, [*states[-2:], present], batch).mean(0).amin(0)
        if kind == "sac":
            mean = mean - learner.networks["temperature"]["log"].exp() * density(learner, batch)
        reward = batch["next", "reward"].squeeze(-1)
        goes_on = ~batch["next", "terminated"].squeeze(-1)
        torch.testing.assert_close(
            target_of(learner, batch.clone()), (reward + GAMMA * mean * goes_on).detach()
        )
        learner.end_episode()
        states.append(present)
        learner.update(make_batch(seed=episode))
        learner.update(make_batch(seed=episode + 10))


def density(learner, batch):
    torch.manual_seed(7)
    return learner.policy.sample(batch["next"])[1]


@torch.no_grad()
def next_values(learner, sets, batch):
    """Q at the next state of each critic of each set, shape [sets, critics, B]."""
    after = batch["next"]
    torch.manual_seed(7)
    if learner.stochastic:
        action = learner.policy.sample(after)[0]
    else:
        action = learner.targets["actor"].outputs(after)["action"]
    if learner.policy_noise > 0:
        noise = smoothing_noise(action, deviation=learner.policy_noise, limit=learner.noise_clip)
        action = (action + noise).clamp(-1, 1)
    given = {"observation": after["observation"], "action": action}
    values = [[q.outputs(given)["state_action_value"].squeeze(-1) for q in each] for each in sets]
    return torch.stack([torch.stack(each) for each in values])


@pytest.mark.parametrize("kind", DETERMINISTIC)
def test_averaged_targets_are_saved_and_loaded(kind):
    first, second = make_learner(kind, 3), make_learner(kind, 3, seed=1)
    for seed in range(4):
        first.update(make_batch(seed=seed))
        first.end_episode()
    second.load_state_dict(first.state_dict())
    batch = make_batch(seed=30)
    assert torch.equal(target_of(first, batch.clone()), target_of(second, batch.clone()))


def test_earlier_critics_are_moved_by_nothing_but_the_end_of_an_episode():
    learner = make_learner("ddpg", 2)
    before = copy.deepcopy(learner.networks["past"].state_dict())
    learner.update(make_batch())
    kept = learner.networks["past"].state_dict()
    assert all(torch.equal(value, kept[name]) for name, value in before.items())
    learner.end_episode()
    kept = learner.networks["past"].state_dict()
    assert not all(torch.equal(value, kept[name]) for name, value in before.items())
