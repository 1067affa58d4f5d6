"""ActorCritic: target networks, gradients, saving, arguments."""

import pytest
import torch
from torchrl.objectives import SoftUpdate

from tests.mpfa.learning import KINDS, differentiate, make_batch, make_learner, make_torchrls
from torchrl_mpfa import Learner


def pairs(learner):
    """Parameters that have a target, with that, as copies."""
    names = list(learner.targets)
    online = [p for name in names for p in learner.networks[name].parameters()]
    targets = [p for name in names for p in learner.targets[name].parameters()]
    return [(a.detach().clone(), b.detach().clone()) for a, b in zip(online, targets, strict=True)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tau", [0.01, 0.5, 1.0])
def test_target_networks_move_by_tau_towards_the_updated_ones(tau, kind):
    learner = make_learner(kind, tau=tau, policy_delay=1)
    for seed in range(3):
        before = pairs(learner)
        learner.update(make_batch(seed=seed))
        for (old, old_target), (online, target) in zip(before, pairs(learner), strict=True):
            torch.testing.assert_close(target, tau * online + (1 - tau) * old_target)
            assert not online.equal(old)


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_moving_targets_equals_torchrls_update_to_the_last_bit():
    learner = make_learner(tau=0.1)
    loss = make_torchrls("ddpg", learner)
    update = SoftUpdate(loss, tau=0.1)
    with torch.no_grad():
        for parameter in [*loss.parameters(), *learner.networks.parameters()]:
            parameter.mul_(1.5)
    update.step()
    learner.move_targets()
    for key, part in (("actor_network", "actor"), ("value_network", "critics")):
        theirs = getattr(loss, f"target_{key}_params").flatten_keys(".")
        for name, value in (
            learner.targets[part] if part == "actor" else learner.targets[part][0]
        ).named_parameters():
            assert value.equal(theirs[name])


def test_one_update_equals_adam_on_each_loss_alone():
    learner, alone = (make_learner(critic_weight_decay=0.1) for _ in range(2))
    optimizers = {
        "actor": torch.optim.Adam(alone.networks["actor"].parameters(), 1e-3),
        "critic": torch.optim.Adam(alone.networks["critics"].parameters(), 1e-3, weight_decay=0.1),
    }
    for seed in range(3):
        # No target moves in either, so that only the optimizers are compared.
        learner.move_targets = lambda: None
        learner.update(make_batch(seed=seed))
        differentiate(alone, make_batch(seed=seed))
        for optimizer in optimizers.values():
            optimizer.step()
    expected = dict(alone.networks.named_parameters())
    for name, value in learner.networks.named_parameters():
        torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_actor_and_critic_learn_at_their_own_rates(kind):
    learner = make_learner(kind, actor_lr=1e-4, critic_lr=2e-3)
    rates = {id(p): g["lr"] for g in learner.optimizer.param_groups for p in g["params"]}
    assert {rates[id(p)] for p in learner.networks["actor"].parameters()} == {1e-4}
    assert {rates[id(p)] for p in learner.networks["critics"].parameters()} == {2e-3}


def test_learner_has_the_methods_of_the_protocol():
    assert isinstance(make_learner(), Learner)
