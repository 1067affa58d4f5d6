"""Robots of a run: who chooses an action, and what the record of an episode says."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.integration.tiny_runs import tiny
from training.run.driving import Robots


class Counting:
    """An explorer that counts what it was asked, and always drives ahead."""

    def __init__(self) -> None:
        self.asked = 0

    def act(self, observation: Tensor) -> Tensor:
        self.asked += 1
        return torch.ones(len(observation), 2)

    def behavior(self) -> tuple[Tensor, Tensor]:
        return torch.ones(3, 2), torch.zeros(3, 1)

    def begin_episodes(self, begun: Tensor) -> None: ...


@pytest.mark.parametrize(("actions", "asked"), [(0, 0), (11, 0), (12, 1), (13, 1)])
def test_the_explorer_acts_after_as_many_actions_as_are_random(actions: int, asked: int) -> None:
    settings = tiny(robots=3)
    settings.exploration.random_steps = 12
    robots, explorer = Robots(settings), Counting()
    robots.begin("A", explorer, seed=1)
    data, _ = robots.drive(explorer, actions=actions, episode=0)
    robots.close()
    assert explorer.asked == asked
    assert bool((data["action"] == 1.0).all()) == bool(asked)


def test_the_reward_of_an_episode_is_the_sum_of_its_own_rewards() -> None:
    settings = tiny(robots=3)
    settings.exploration.random_steps = 0
    robots, explorer = Robots(settings), Counting()
    robots.begin("A", explorer, seed=1)
    sums, ended = torch.zeros(3, dtype=torch.double), 0
    for step in range(60):
        data, records = robots.drive(explorer, actions=3 * step, episode=ended)
        sums += data["next", "reward"].squeeze(-1)
        done = data["next", "done"].squeeze(-1)
        assert [record.reward for record in records] == pytest.approx(sums[done].tolist())
        sums[done], ended = 0.0, ended + len(records)
    robots.close()
    assert ended > 6
