"""The stochastic policy: what it samples, and what it does when it is not to explore."""

import torch
from torchrl.envs import ExplorationType, set_exploration_type

from tests.mpfa.learning import make_batch, make_networks


def test_policy_is_the_tanh_of_its_mean_unless_it_explores():
    policy, _ = make_networks(stochastic=True)
    observed = make_batch().select("observation")
    found = policy.outputs(observed)
    assert found["action"].equal(found["preactivation"].tanh())
    torch.testing.assert_close(policy(observed.copy())["action"], found["action"])
    with set_exploration_type(ExplorationType.RANDOM):
        sampled = []
        for _ in range(2):
            torch.manual_seed(3)
            sampled.append(policy.outputs(observed)["action"])
        torch.manual_seed(3)
        torch.testing.assert_close(policy(observed.copy())["action"], sampled[0])
    assert sampled[0].equal(sampled[1])
    assert not sampled[0].equal(found["action"])


def test_sizes_of_a_policy_can_be_read_from_its_weights():
    weights = [
        value
        for value in make_networks(stochastic=True)[0].state_dict().values()
        if value.ndim == 2
    ]
    assert weights[0].shape[1] == 5
    assert weights[-1].shape[0] == 2
