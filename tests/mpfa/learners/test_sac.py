"""A learner with a stochastic actor: what moves and what does not, and a problem it solves."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.mpfa import learning
from tests.mpfa.learning import make_batch, make_networks
from tests.mpfa.transitions import seeded
from torchrl_mpfa import ActorCritic


def make_learner(seed=0, **options):
    return learning.make_learner("sac", seed, **{"alpha": 1.0, **options})


@pytest.mark.parametrize(("deviation", "falls"), [(1.0, True), (0.01, False)])
def test_temperature_falls_while_the_entropy_is_above_its_target_and_rises_below(deviation, falls):
    learner = make_learner(alpha_lr=1e-2, actor_lr=1e-8)
    head = learner.policy.module[0].module.scale_head
    torch.nn.init.zeros_(head.weight)
    torch.nn.init.constant_(head.bias, math.log(math.expm1(deviation) / math.expm1(1.0)))
    log = [learner.update(make_batch(seed=seed)) for seed in range(5)]
    assert (log[0]["entropy"] > -2.0) == falls
    assert (log[4]["alpha"] < log[0]["alpha"]) == falls
    assert log[0]["alpha"] == 1.0


def test_update_moves_everything_and_only_the_critics_have_targets():
    learner = make_learner()
    before = {name: p.detach().clone() for name, p in learner.networks.named_parameters()}
    batch = make_batch()
    log = learner.update(batch)
    assert not any(value.requires_grad for value in log.values())
    assert {"loss_value", "loss_actor", "loss_alpha", "alpha", "entropy"} <= set(log)
    assert set(batch["signals"].keys()) == {"td_error", "action_gradient"}
    assert not any(p.equal(before[name]) for name, p in learner.networks.named_parameters())
    assert list(learner.targets) == ["critics"]


def test_temperature_has_a_rate_of_its_own_that_is_annealed_too():
    learner = make_learner()
    for fraction in (0.25, 0.5):  # Of the first rates, and not of the present ones.
        learner.anneal(fraction)
    assert [group["lr"] for group in learner.optimizer.param_groups] == [5e-4, 5e-4, 1.5e-4]


def solve_bandit(updates=300, **rates):
    """Mean distance of the greedy action from the best one, and the entropy of the policy."""
    rates = {"actor_lr": 3e-3, "critic_lr": 3e-3, "alpha_lr": 2e-2, **rates}
    networks = make_networks(stochastic=True, size=2, width=32)
    learner = ActorCritic(*networks, alpha=0.1, target_entropy=-1.0, **rates)
    generator, end = seeded(), torch.ones(64, 1, dtype=torch.bool)
    for _ in range(updates):
        state, action = (torch.rand(64, 2, generator=generator) * 2 - 1 for _ in range(2))
        reward = -(action - 0.8 * state).square().sum(1, keepdim=True)
        after = {"observation": state, "reward": reward, "terminated": end, "done": end}
        batch = TensorDict({"observation": state, "action": action, "next": after}, [64])
        log = learner.update(batch)
    with torch.no_grad():
        chosen = learner.policy.outputs({"observation": state})["action"]
    return float((chosen - 0.8 * state).norm(dim=1).mean()), float(log["entropy"])


def test_learning_finds_the_best_action_at_the_entropy_that_is_asked_for():
    distance, entropy = solve_bandit()
    assert distance < 0.2
    assert entropy == pytest.approx(-1.0, abs=0.5)


@pytest.mark.parametrize("rate", ["actor_lr", "critic_lr"])
def test_learning_without_one_of_the_networks_does_not_find_it(rate):
    assert solve_bandit(**{rate: 1e-9})[0] > 0.3
