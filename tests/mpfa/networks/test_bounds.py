"""Bounds of actions: from a spec to the networks and to the losses."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Composite
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal

from tests.mpfa.learning import make_batch
from torchrl_mpfa import make_actor, make_critic, make_stochastic_actor
from torchrl_mpfa.networks import ActionScale, action_bounds

# TorchRL warns at every loss of its own whose target networks nothing moves.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

LOW, HIGH = [-2.0, 0.0], [2.0, 10.0]
SPEC = Bounded(low=torch.tensor(LOW), high=torch.tensor(HIGH), shape=(2,))
MAKERS = [make_actor, make_stochastic_actor]


def make(maker, spec=SPEC, **kwargs):
    torch.manual_seed(0)
    return maker(5, 2, action_spec=spec, width=16, final_init=0.5, **kwargs)


def networks(maker):
    return make(maker), make_critic(5, 2, width=16, final_init=0.5)


def batch_of(count=6):
    batch = make_batch(count)
    batch["action"] = SPEC.rand((count,))
    return batch


@pytest.mark.parametrize("maker", MAKERS)
def test_actions_reach_every_bound_and_none_beyond(maker):
    policy = make(maker)
    observed = {"observation": torch.randn(500, 5)}
    with torch.no_grad():
        policy.layers()[-3].weight.mul_(20.0)
        found = policy.outputs(observed)
        called = policy(TensorDict(observed, [500]))
    expected = torch.tensor([0.0, 5.0]) + torch.tensor([2.0, 5.0]) * found["preactivation"].tanh()
    torch.testing.assert_close(found["action"], expected)
    torch.testing.assert_close(called["action"], expected)
    torch.testing.assert_close(found["action"].amin(0), torch.tensor(LOW), atol=0.1, rtol=0)
    torch.testing.assert_close(found["action"].amax(0), torch.tensor(HIGH), atol=0.1, rtol=0)
    assert SPEC.is_in(found["action"][0])


@pytest.mark.parametrize("spec", [None, SPEC])
@pytest.mark.parametrize("limit", [0.3, 1.5, 4.0])
@pytest.mark.parametrize("maker", MAKERS)
def test_actions_are_at_their_bounds_from_the_saturation_limit_on(maker, limit, spec):
    policy = make(maker, spec, saturation_limit=limit)
    low, high = (
        (torch.full((2,), -1.0), torch.ones(2)) if spec is None else map(torch.tensor, (LOW, HIGH))
    )
    squash = policy.layers()[-2:]
    at = torch.tensor([-9.0, -limit, -0.9 * limit, 0.0, limit, 9.0]).unsqueeze(-1).expand(6, 2)
    found = squash[1](squash[0](at))
    for row, bound in ((0, low), (1, low), (3, (low + high) / 2), (4, high), (5, high)):
        torch.testing.assert_close(found[row], bound, rtol=1e-6, atol=1e-6)
    assert bool((found[2] > low).all()) and bool((found[0] == low).all())
    observed = {"observation": torch.randn(400, 5)}
    with torch.no_grad():
        policy.layers()[-3].weight.mul_(20.0)
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        with set_exploration_type(kind):
            ways = policy.outputs(observed), policy(TensorDict(observed, [400]))
        for action in (way["action"] for way in ways):
            assert bool(((action >= low) & (action <= high)).all())
            assert all(bool((action == bound).any()) for bound in (low, high))
    torch.testing.assert_close(*(way["action"] for way in ways))


@pytest.mark.parametrize("maker", MAKERS)
def test_layers_lead_from_the_observation_to_the_greedy_action(maker):
    for spec, limit in ((SPEC, None), (None, None), (SPEC, 0.1), (None, 0.1)):
        policy = make(maker, spec, layers=3, saturation_limit=limit)
        at = observed = torch.randn(4, 5)
        for layer in policy.layers():
            at = layer(at)
        torch.testing.assert_close(at, policy.outputs({"observation": observed})["action"])
        kinds = [type(layer) for layer in policy.layers()]
        assert kinds[:3] == [nn.Linear, nn.LayerNorm, nn.ReLU]
        assert kinds[-1] is (nn.Tanh if spec is None and limit is None else ActionScale)


@pytest.mark.parametrize("maker", MAKERS)
def test_bounds_are_saved_with_the_policy(maker):
    first = make(maker)
    second = make(maker, Bounded(low=-9.0, high=9.0, shape=(2,)))
    second.load_state_dict(first.state_dict())
    observed = {"observation": torch.randn(4, 5)}
    torch.testing.assert_close(
        second.outputs(observed)["action"], first.outputs(observed)["action"]
    )


def test_random_actions_have_the_density_of_torchrls_distribution():
    policy = make(make_stochastic_actor)
    inputs = {"observation": torch.randn(50, 5)}
    torch.manual_seed(1)
    action, log_density, means = policy.sample(inputs)
    found = policy.module[0].outputs(inputs)
    theirs = TanhNormal(means, found["scale"], low=torch.tensor(LOW), high=torch.tensor(HIGH))
    torch.manual_seed(1)
    expected = theirs.rsample_and_log_prob()
    torch.testing.assert_close(action, expected[0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(log_density, expected[1], rtol=1e-4, atol=1e-4)
    with set_exploration_type(ExplorationType.RANDOM):
        sampled = policy(TensorDict(inputs, [50]))["action"]
    assert bool(((sampled >= torch.tensor(LOW)) & (sampled <= torch.tensor(HIGH))).all())


def test_spec_may_be_that_of_a_batch_of_environments_or_have_a_key():
    batched = SPEC.expand(3, 2)
    for spec in (SPEC, batched, Composite(action=SPEC), Composite(action=batched, shape=(3,))):
        low, high = action_bounds(spec, 2)
        assert (low.tolist(), high.tolist()) == (LOW, HIGH)
