"""Exploration: a policy with noise, a stochastic policy, or some actions at random."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_mpfa.exploration import GaussianNoise
from torchrl_mpfa.networks import DirectModule, StochasticActor
from training.settings.train import ExplorationSettings


class Explorer:
    """Actions to learn from; as it stands, with nothing that changes or is saved."""

    policy: DirectModule | StochasticActor
    """Policy that is explored around."""
    _behavior: tuple[Tensor, Tensor]

    @property
    def sigma(self) -> float:
        """Standard deviation of the actions around the policy's, the mean of the robots."""
        return 0.0

    def begin_episodes(self, begun: Tensor) -> None:
        """Signal which robots begin an episode, bool of shape ``[N]``."""

    def act(self, observation: Tensor) -> Tensor:
        """Return actions, shape ``[N, A]``, for observations, shape ``[N, O]``."""
        raise NotImplementedError

    def behavior(self) -> tuple[Tensor, Tensor]:
        """Return mean, ``[N, A]``, and standard deviation, ``[N, 1]``, of the last actions.

        The noise is a Gaussian, whose clipping is not counted.
        """
        return self._behavior

    def state_dict(self) -> dict[str, Any]:
        """Return what the next action depends on, but for the policy and the random numbers."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of :meth:`state_dict`."""


class SharedNoise(Explorer):
    """Noise of which each episode has a share, sampled uniformly from [0, 1] with ``varied``.

    So the actions of the policy without noise, circling included, are in the data as well.

    Args:
        settings: Settings of the noise.
        robots: Number of robots ``N``.
    """

    def __init__(self, settings: ExplorationSettings, robots: int) -> None:
        self.settings = settings
        self.shares = torch.ones(robots, 1)

    def begin_episodes(self, begun: Tensor) -> None:
        """Sample the shares of the episodes that begin."""
        if self.settings.varied:
            self.shares[begun] = torch.rand(int(begun.sum()), 1)

    def falling(self, start: float, end: float, steps: int) -> float:
        """Return a value that falls linearly over ``annealing_steps`` actions."""
        return start + (end - start) * min(steps / self.settings.annealing_steps, 1.0)

    def state_dict(self) -> dict[str, Any]:
        """Return the shares of the episodes."""
        return {"shares": self.shares.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the shares of the episodes."""
        self.shares.copy_(state_dict["shares"])


class NoisyPolicy(SharedNoise):
    """Gaussian noise on the action, clipped to its range, falling linearly.

    Args:
        policy: The deterministic policy.
        settings: Settings of the noise.
        action_spec: Range of actions, shape ``[N, A]``.
    """

    def __init__(
        self, policy: DirectModule, settings: ExplorationSettings, action_spec: TensorSpec
    ) -> None:
        super().__init__(settings, action_spec.shape[0])
        self.policy = policy
        self.noise = GaussianNoise(
            action_spec,
            sigma_init=settings.sigma,
            sigma_end=settings.sigma_end,
            annealing_num_steps=settings.annealing_steps,
        )

    @property
    def sigma(self) -> float:
        """Present standard deviation of the noise, the mean over the shares of the episodes."""
        return float(self.shares.mean()) * float(self.noise.sigma)

    def act(self, observation: Tensor) -> Tensor:
        """Return the policy's actions with noise."""
        chosen = self.policy.act(observation)
        self._behavior = chosen.cpu(), self.shares * self.noise.sigma.item()
        noisy = self.noise.noisy(chosen)
        self.noise.step(len(observation))
        return chosen.lerp(noisy, self.shares.to(chosen.device))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the noise, and the shares of the episodes."""
        return {"noise": dict(self.noise.state_dict()), **super().state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self.noise.load_state_dict(state_dict["noise"])


class EpsilonGreedy(SharedNoise):
    """The best action, or with a chance that falls linearly, any of them.

    TorchRL's module has one chance for all robots; here each episode has a share of the chance.

    Args:
        policy: From observations to one-hot choices.
        settings: Settings of the chance.
        robots: Number of robots ``N``.
    """

    def __init__(self, policy: DirectModule, settings: ExplorationSettings, robots: int) -> None:
        super().__init__(settings, robots)
        self.policy = policy
        self.steps = 0

    @property
    def epsilon(self) -> float:
        """Present chance of an episode whose share is 1."""
        return self.falling(self.settings.epsilon, self.settings.epsilon_end, self.steps)

    def act(self, observation: Tensor) -> Tensor:
        """Return one-hot choices, shape ``[N, K]``."""
        best = self.policy.act(observation)
        anything = torch.randint(best.shape[1], (len(best),))
        chosen = torch.nn.functional.one_hot(anything, best.shape[1]).to(best.device)
        self._behavior = best.float().cpu(), self.epsilon * self.shares
        at_random = torch.rand(len(best), 1) < self.epsilon * self.shares
        self.steps += len(best)
        return torch.where(at_random.to(best.device), chosen, best)

    def state_dict(self) -> dict[str, Any]:
        """Return how far the chance has fallen, and the shares of the episodes."""
        return {"steps": self.steps, **super().state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self.steps = state_dict["steps"]


class RandomPolicy(Explorer):
    """A stochastic policy, as SAC's is.

    Args:
        policy: The stochastic policy.
        settings: ``sigma_end`` stands for the spread of the actions.
    """

    policy: StochasticActor

    def __init__(self, policy: StochasticActor, settings: ExplorationSettings) -> None:
        self.policy, self.settings = policy, settings

    @property
    def sigma(self) -> float:
        """Spread that stands for that of the actions."""
        return self.settings.sigma_end

    def act(self, observation: Tensor) -> Tensor:
        """Sample actions from the policy."""
        found = self.policy.outputs({"observation": observation}, random=True)
        mean = self.policy.mean_action(found["preactivation"]).cpu()
        action: Tensor = found["action"]
        self._behavior = mean, torch.full((len(mean), 1), self.sigma)
        return action


def make_explorer(
    policy: DirectModule | StochasticActor, settings: ExplorationSettings, action_spec: TensorSpec
) -> Explorer:
    """Choose Gaussian noise, none, or epsilon-greedy by the kind of policy."""
    if isinstance(policy, StochasticActor):
        return RandomPolicy(policy, settings)
    if "action_value" in policy.out_keys:
        return EpsilonGreedy(policy, settings, action_spec.shape[0])
    return NoisyPolicy(policy, settings, action_spec)
