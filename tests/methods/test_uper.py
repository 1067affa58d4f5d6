"""UPER: priorities by what there is to learn from a transition, and not by its noise."""

import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from tests.mpfa.learning import KINDS, differentiate, make_apart, make_batch
from tests.mpfa.transitions import seeded
from torchrl_mpfa import ActorCritic, make_actor
from torchrl_mpfa.learners.networks import QUANTILES
from torchrl_mpfa.losses import LEAST_NOISE, quantile_loss
from torchrl_mpfa.priorities import information_gain_priority

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

SIGNAL = ("signals", "information_gain")


def by_hand(errors, quantiles, least):
    """The gain of one transition in plain loops."""
    mean = sum(errors) / len(errors)
    disagreement = sum((e - mean) ** 2 for e in errors) / len(errors)
    middle = sum(quantiles) / len(quantiles)
    noise = sum((q - middle) ** 2 for q in quantiles) / len(quantiles)
    return 0.5 * math.log(1 + (mean**2 + disagreement) / max(noise, least**2))


def test_gain_is_that_of_distance_and_disagreement_over_noise():
    generator = seeded(0)
    errors = torch.randn(5, 30, generator=generator, dtype=torch.double)
    quantiles = torch.randn(30, 7, generator=generator, dtype=torch.double)
    quantiles[0] = 1.0
    found = information_gain_priority(errors, quantiles, least_noise=0.3)
    for row in range(30):
        expected = by_hand(errors[:, row].tolist(), quantiles[row].tolist(), 0.3)
        assert found[row].item() == pytest.approx(expected)


def test_quantile_loss_equals_a_loop():
    quantiles, target = torch.randn(6, 5, generator=seeded(1)), torch.randn(6, generator=seeded(2))
    for row, loss in enumerate(quantile_loss(quantiles, target)):
        total = 0.0
        for place, quantile in enumerate(quantiles[row]):
            error = (target[row] - quantile).item()
            total += error * ((place + 0.5) / 5 - (error < 0))
        assert loss.item() == pytest.approx(total / 5, abs=1e-6)


@pytest.mark.parametrize("spread", [1.0, 0.0])
@pytest.mark.parametrize("kind", KINDS)
def test_learner_writes_the_gain_of_its_critics_in_any_units_of_its_reward(kind, spread):
    batch, scale = make_batch(), 0.1
    learner = make_apart(kind, signals=["information_gain", "td_error"], reward_scale=scale)
    noise = learner.networks["noise"]
    with torch.no_grad():
        for weight in noise.parameters():
            weight.add_(torch.randn(weight.shape, generator=seeded(3))).mul_(spread)
    log = differentiate(learner, batch, trains="critic")
    quantiles = noise.outputs(batch)["state_action_value"]
    assert quantiles.shape == (6, QUANTILES)
    for row in range(6):
        target = log["target_value"][row] / scale
        errors = (target - log["pred_value"][:, row] / scale).tolist()
        expected = by_hand(errors, (quantiles[row] / scale).tolist(), LEAST_NOISE)
        assert batch[SIGNAL][row].item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_critics_and_actor_with_quantiles_start_and_learn_as_without(kind):
    plain = make_apart(kind, signals=["td_error"])
    learner = make_apart(kind, signals=["information_gain"])
    for each in (plain, learner):
        differentiate(each, make_batch(weighted=True))
    found = dict(learner.networks.named_parameters())
    for name, parameter in plain.networks.named_parameters():
        assert parameter.equal(found[name])
        assert (parameter.grad is None) == (found[name].grad is None)
        if parameter.grad is not None:
            torch.testing.assert_close(found[name].grad, parameter.grad)
    own = {name for name in found if name.startswith("noise.")}
    assert own == found.keys() - dict(plain.networks.named_parameters()).keys()
    assert any(found[name].grad.abs().sum() > 0 for name in own)
    learned = {id(each) for each in learner.optimizer.param_groups[1]["params"]}
    assert all(id(found[name]) in learned for name in own)


def test_critic_whose_last_layer_gives_more_than_q_is_rejected():
    class Summed(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = nn.Linear(7, 3)

        def forward(self, observation, action):
            return self.layer(torch.cat((observation, action), -1)).sum(-1, keepdim=True)

    keys = ["observation", "action"], ["state_action_value"]
    critic = TensorDictModule(Summed(), *keys)
    with pytest.raises(ValueError, match="whose last linear layer has one output, got Linear"):
        ActorCritic(make_actor(5, 2), critic, signals=["information_gain"])
    assert "noise" not in ActorCritic(make_actor(5, 2), critic).networks
