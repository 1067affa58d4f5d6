"""How the robot acts while it learns."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule

from torchrl_mpfa import make_actor, make_stochastic_actor, make_value_network
from training.run.exploration import EpsilonGreedy, NoisyPolicy, RandomPolicy, make_explorer
from training.settings.train import ExplorationSettings

SPEC = Bounded(low=-1.0, high=1.0, shape=(3, 2))
OBSERVATION = torch.linspace(-1, 1, 5).expand(3, -1)
ALL = torch.ones(3, dtype=torch.bool)


def deviations(explorer: NoisyPolicy, count: int = 400) -> torch.Tensor:
    """Of the actions of three robots, shape ``[count, 3, 2]``."""
    with torch.no_grad():
        chosen = explorer.policy.outputs({"observation": OBSERVATION})["action"]
        return torch.stack([explorer.act(OBSERVATION) - chosen for _ in range(count)])


def test_noise_falls_from_its_first_to_its_last_size() -> None:
    settings = ExplorationSettings(sigma=0.3, sigma_end=0.1, annealing_steps=300)
    explorer = NoisyPolicy(make_actor(5, 2), settings, SPEC)
    assert explorer.sigma == pytest.approx(0.3)
    deviations(explorer, 100)
    assert explorer.sigma == pytest.approx(0.1)
    assert deviations(explorer).std().item() == pytest.approx(0.1, rel=0.1)


def test_every_episode_has_its_own_share_of_the_noise_if_that_is_varied() -> None:
    settings = ExplorationSettings(sigma=0.2, sigma_end=0.2, varied=True)
    explorer = NoisyPolicy(make_actor(5, 2), settings, SPEC)
    shares = []
    for _ in range(10):
        explorer.begin_episodes(ALL)
        spread = deviations(explorer, 200).std(dim=(0, 2))
        torch.testing.assert_close(spread, 0.2 * explorer.shares[:, 0], rtol=0.25, atol=2e-3)
        assert explorer.sigma == pytest.approx(0.2 * explorer.shares.mean().item())
        shares += explorer.shares[:, 0].tolist()
    assert min(shares) < 0.15
    assert max(shares) > 0.85


def test_only_the_robots_that_begin_an_episode_get_another_share() -> None:
    explorer = NoisyPolicy(make_actor(5, 2), ExplorationSettings(), SPEC)
    explorer.begin_episodes(ALL)
    before = explorer.shares.clone()
    explorer.begin_episodes(torch.tensor([False, True, False]))
    assert (explorer.shares == before).squeeze().tolist() == [True, False, True]


def test_a_policy_that_is_random_by_itself_gets_no_noise() -> None:
    explorer = make_explorer(make_stochastic_actor(5, 2), ExplorationSettings(), SPEC)
    assert isinstance(explorer, RandomPolicy)
    with torch.no_grad():
        actions = torch.stack([explorer.act(OBSERVATION) for _ in range(50)])
    assert actions.std(0).min() > 0.05
    assert actions.abs().max() <= 1.0


def test_a_choice_at_random_becomes_as_rare_as_it_is_told_and_each_robot_has_its_share() -> None:
    torch.manual_seed(0)
    settings = ExplorationSettings(epsilon=0.8, epsilon_end=0.2, annealing_steps=600, varied=False)
    explorer = EpsilonGreedy(make_value_network(5, 4, width=8), settings, 3)
    best = explorer.policy.outputs({"observation": OBSERVATION})["action"]
    for expected in (0.8, 0.5, 0.2, 0.2):
        assert explorer.epsilon == pytest.approx(expected)
        for _ in range(100):
            explorer.act(OBSERVATION)
    explorer.shares = torch.tensor([[0.0], [0.5], [1.0]])
    others = torch.stack([(explorer.act(OBSERVATION) != best).any(1) for _ in range(2000)])
    # One in four of what is chosen at random is the best.
    torch.testing.assert_close(
        others.float().mean(0), 0.75 * 0.2 * explorer.shares[:, 0], rtol=0.0, atol=0.02
    )


def test_the_behavior_is_the_action_without_noise_and_the_noise_that_the_episode_has() -> None:
    settings = ExplorationSettings(sigma=0.4, sigma_end=0.4)
    explorer = NoisyPolicy(make_actor(5, 2), settings, SPEC)
    explorer.shares = torch.tensor([[0.0], [0.5], [1.0]])
    with torch.no_grad():
        expected = explorer.policy.outputs({"observation": OBSERVATION})["action"]
        explorer.act(OBSERVATION)
    mean, sigma = explorer.behavior()
    torch.testing.assert_close(mean, expected)
    torch.testing.assert_close(sigma, torch.tensor([[0.0], [0.2], [0.4]]))


@pytest.mark.parametrize("varied", [False, True])
@pytest.mark.parametrize("robots", [1, 16])
def test_actions_with_noise_are_those_of_torchrls_module(robots: int, varied: bool) -> None:
    settings = ExplorationSettings(sigma=0.7, sigma_end=0.1, annealing_steps=50, varied=varied)
    spec = Bounded(low=-1.0, high=1.0, shape=(robots, 2))
    actor = make_actor(5, 2, final_init=1.0)
    explorer = make_explorer(actor, settings, spec)
    noise = AdditiveGaussianModule(spec, 0.7, 0.1, 50)
    explorer.begin_episodes(torch.ones(robots, dtype=torch.bool))
    for number, seen in enumerate(torch.randn(60, robots, 5)):
        torch.manual_seed(number)
        with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
            chosen = actor(TensorDict({"observation": seen}))["action"]
            noisy = noise(TensorDict({"action": chosen}))["action"]
        spread = explorer.shares * noise.sigma
        noise.step(robots)
        torch.manual_seed(number)
        found = explorer.act(seen)
        assert torch.equal(found, chosen.lerp(noisy, explorer.shares))
        mean, sigma = explorer.behavior()
        assert torch.equal(mean, chosen) and torch.equal(sigma, spread)


@pytest.mark.parametrize("robots", [1, 16])
def test_choices_are_drawn_in_the_same_order_as_ever(robots: int) -> None:
    settings = ExplorationSettings(annealing_steps=50)
    network = make_value_network(5, 4, width=8, final_init=1.0)
    explorer = EpsilonGreedy(network, settings, robots)
    explorer.begin_episodes(torch.ones(robots, dtype=torch.bool))
    for number, seen in enumerate(torch.randn(60, robots, 5)):
        torch.manual_seed(number)
        anything = torch.nn.functional.one_hot(torch.randint(4, (robots,)), 4)
        at_random = torch.rand(robots, 1) < explorer.epsilon * explorer.shares
        expected = torch.where(at_random, anything, network(TensorDict(observation=seen))["action"])
        torch.manual_seed(number)
        assert torch.equal(explorer.act(seen), expected)


@pytest.mark.parametrize("robots", [1, 16])
def test_a_random_policy_samples_as_under_torchrls_exploration(robots: int) -> None:
    policy = make_stochastic_actor(5, 2, final_init=1.0)
    explorer = make_explorer(policy, ExplorationSettings(), SPEC)
    for number, seen in enumerate(torch.randn(60, robots, 5)):
        torch.manual_seed(number)
        expected, _, loc = policy.sample({"observation": seen})
        torch.manual_seed(number)
        assert torch.equal(explorer.act(seen), expected)
        assert torch.equal(explorer.behavior()[0], policy.mean_action(loc))
