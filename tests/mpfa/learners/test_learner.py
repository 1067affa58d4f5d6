"""ActorCritic: target networks, gradients, saving, arguments."""

import copy

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SoftUpdate

from tests.mpfa.learning import KINDS, differentiate, make_batch, make_learner, make_torchrls
from torchrl_mpfa import ActorCritic, Learner, make_critic


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


class Masked(nn.Module):
    """An actor with a causal mask, and a lowest value that begins at infinity."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3, 1)
        self.register_buffer("mask", torch.full((3, 3), -torch.inf).triu(1))
        self.register_buffer("lowest", torch.tensor(torch.inf))

    def forward(self, observation):
        raw = self.layer(observation)
        return raw, raw.tanh()


def make_masked():
    keys = ["preactivation", "action"]
    actor = TensorDictModule(Masked(), in_keys=["observation"], out_keys=keys)
    return ActorCritic(actor, make_critic(3, 1, width=8), bounds=(-1.0, 1.0))


def test_what_is_no_parameter_may_be_infinite_in_a_saved_state():
    first, second = make_masked(), make_masked()
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for name, value in first.networks.state_dict().items():
        assert torch.equal(second.networks.state_dict()[name], value)


def test_a_parameter_that_is_not_finite_is_rejected_at_the_save():
    learner = make_masked()
    with torch.no_grad():
        next(learner.networks.parameters()).fill_(torch.nan)
    with pytest.raises(ValueError, match="the saved learner must be finite, got nan in"):
        learner.state_dict()
    learner.load_state_dict(make_masked().state_dict())  # It can be mended.
    assert learner.state_dict()
