"""Actor and critic: shapes, options, and the start near the middle of the tanh."""

import pytest
import torch
from torch import nn

from tests.mpfa.transitions import seeded
from torchrl_mpfa import make_actor, make_critic


def count(module, kind):
    return sum(isinstance(part, kind) for part in module.modules())


def test_action_is_the_tanh_of_the_preactivation():
    observation = torch.randn(50, 7, generator=seeded()) * 20
    before, action = make_actor(7, 2, final_init=None).module(observation)
    assert action.equal(torch.tanh(before))
    assert action.abs().max() <= 1


def test_last_layers_start_near_zero_and_hence_actions_near_the_middle():
    observation = torch.randn(50, 7, generator=seeded())
    actor, critic = make_actor(7, 2, width=32), make_critic(7, 2, width=32)
    last = actor.module.head, critic.module.rest[-1]
    for layer in last:
        assert layer.weight.abs().max() <= 3e-3
        assert layer.bias.abs().max() <= 3e-3
        assert layer.weight.abs().max() > 1e-3
    before, action = actor.module(observation)
    assert before.abs().max() < 0.2
    assert critic.module(observation, action).abs().max() < 0.2
    wide = make_actor(7, 2, width=32, final_init=None).module.head
    assert wide.weight.abs().max() > 0.05


@pytest.mark.parametrize("layers", [2, 3, 4])
def test_number_of_hidden_layers_and_units_is_as_asked(layers):
    for module in (
        make_actor(7, 2, width=9, layers=layers),
        make_critic(7, 2, width=9, layers=layers),
    ):
        linear = [part for part in module.modules() if isinstance(part, nn.Linear)]
        assert len(linear) == layers + 1
        assert [layer.out_features for layer in linear[:-1]] == [9] * layers
        assert count(module, nn.LayerNorm) == layers


def test_plain_variant_is_a_bare_perceptron_that_reads_the_action_first():
    plain = {"layer_norm": False, "final_init": None}
    actor, critic = make_actor(7, 2, **plain), make_critic(7, 2, late_action=False, **plain)
    assert count(actor, nn.LayerNorm) == count(critic, nn.LayerNorm) == 0
    assert critic.module.first[0].in_features == 9
    assert critic.module.rest[0].in_features == 256
    one_layer = make_critic(7, 2, layers=1, late_action=False, **plain)
    assert count(one_layer, nn.Linear) == 2


def test_late_action_joins_at_the_second_layer():
    critic = make_critic(7, 2, width=11).module
    assert critic.first[0].in_features == 7
    assert critic.rest[0].in_features == 13
