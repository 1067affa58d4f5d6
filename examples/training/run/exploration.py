"""How the robot acts while it learns: a policy with noise, a stochastic one, or some at random."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import set_exploration_type
from torchrl.envs.utils import ExplorationType
from torchrl.modules import AdditiveGaussianModule

from torchrl_mpfa.networks import DirectModule, StochasticActor
from training.settings.train import ExplorationSettings


class Explorer(Protocol):
    """Actions to learn from."""

    policy: DirectModule | StochasticActor
    """What it explores around."""

    @property
    def sigma(self) -> float:
        """Standard deviation of the actions around the policy's, the mean of the robots."""
        ...

    def begin_episodes(self, begun: Tensor) -> None:
        """Take note which robots begin an episode, bool of shape ``[N]``."""
        ...

    def act(self, observation: Tensor) -> Tensor:
        """From observations, shape ``[N, O]``, to actions, shape ``[N, A]``."""
        ...

    def move_to(self, steps: int) -> None:
        """Have the noise that it has after so many actions of its own."""
        ...

    def behavior(self) -> tuple[Tensor, Tensor]:
        """Mean, ``[N, A]``, and standard deviation, ``[N, 1]``, of the actions that it gave last.

        The noise is a Gaussian, whose clipping is not counted.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """What the next action depends on, but for the policy and the random numbers."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        ...


class NoisyPolicy:
    """Gaussian noise on the action, clipped to its range, falling linearly.

    With ``varied`` each episode has a share of it that is sampled uniformly from [0, 1]: what the
    policy does without noise, circling included, is then in the data as well.

    Args:
        policy: The deterministic policy.
        settings: The noise.
        action_spec: Range of actions, shape ``[N, A]``.
    """

    def __init__(
        self, policy: DirectModule, settings: ExplorationSettings, action_spec: TensorSpec
    ) -> None:
        self.policy = policy
        self.varied = settings.varied
        self.annealing_steps = settings.annealing_steps
        self.shares = torch.ones(action_spec.shape[0], 1)
        self.noise = AdditiveGaussianModule(
            action_spec,
            sigma_init=settings.sigma,
            sigma_end=settings.sigma_end,
            annealing_num_steps=settings.annealing_steps,
        )

    @property
    def sigma(self) -> float:
        """Present standard deviation of the noise, the mean of what the episodes have of it."""
        return float(self.shares.mean()) * float(self.noise.sigma)

    def begin_episodes(self, begun: Tensor) -> None:
        """Sample the share of the noise that each of these episodes has."""
        if self.varied:
            self.shares[begun] = torch.rand(int(begun.sum()), 1)

    def act(self, observation: Tensor) -> Tensor:
        """The policy's actions and noise."""
        chosen = self.policy.outputs({"observation": observation})["action"]
        self._behavior = chosen.cpu(), self.shares * float(self.noise.sigma)
        with set_exploration_type(ExplorationType.RANDOM):
            noisy = self.noise(TensorDict({"action": chosen})).get("action")
        self.noise.step(len(observation))
        action: Tensor = chosen.lerp(noisy, self.shares.to(chosen.device))
        return action

    def move_to(self, steps: int) -> None:
        """Have the noise that it has after so many actions of its own."""
        start, end = float(self.noise.sigma_init), float(self.noise.sigma_end)
        done = min(steps / self.annealing_steps, 1.0)
        self.noise.sigma.fill_(start + (end - start) * done)

    def behavior(self) -> tuple[Tensor, Tensor]:
        """The policy's actions, and each robot's share of the noise."""
        return self._behavior

    def state_dict(self) -> dict[str, Any]:
        """The state of the noise, and the shares of it."""
        return {"noise": dict(self.noise.state_dict()), "shares": self.shares.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.noise.load_state_dict(state_dict["noise"])
        # Where other robots drove, these begin episodes, with shares of their own.
        if state_dict["shares"].shape == self.shares.shape:
            self.shares.copy_(state_dict["shares"])


class EpsilonGreedy:
    """The best action, or with some chance, falling linearly, any of them.

    With ``varied`` each episode has a share of that chance, as :class:`NoisyPolicy` of its noise.

    Args:
        policy: From observations to one-hot choices.
        settings: The chance.
        robots: Number of robots ``N``.
    """

    sigma = 0.0

    def __init__(self, policy: DirectModule, settings: ExplorationSettings, robots: int) -> None:
        self.policy, self.settings = policy, settings
        self.shares = torch.ones(robots)
        self.steps = 0

    @property
    def epsilon(self) -> float:
        """Present chance of an episode that has all of it."""
        done = min(self.steps / self.settings.annealing_steps, 1.0)
        return self.settings.epsilon + (self.settings.epsilon_end - self.settings.epsilon) * done

    def begin_episodes(self, begun: Tensor) -> None:
        """Sample the share of the chance that each of these episodes has."""
        if self.settings.varied:
            self.shares[begun] = torch.rand(int(begun.sum()))

    def act(self, observation: Tensor) -> Tensor:
        """One-hot choices, shape ``[N, K]``."""
        best = self.policy.outputs({"observation": observation})["action"]
        anything = torch.randint(best.shape[1], (len(best),))
        chosen = torch.nn.functional.one_hot(anything, best.shape[1]).to(best.device)
        self._behavior = best.float().cpu(), (self.epsilon * self.shares).unsqueeze(1)
        at_random = torch.rand(len(best)) < self.epsilon * self.shares
        self.steps += len(best)
        return torch.where(at_random.unsqueeze(1).to(best.device), chosen, best)

    def move_to(self, steps: int) -> None:
        """Have the chance that it has after so many actions of its own."""
        self.steps = steps

    def behavior(self) -> tuple[Tensor, Tensor]:
        """The best choices, and the chance of another one in the place of a spread."""
        return self._behavior

    def state_dict(self) -> dict[str, Any]:
        """How far the chance has fallen, and the shares of it."""
        return {"steps": self.steps, "shares": self.shares.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.steps = state_dict["steps"]
        # Where other robots drove, these begin episodes, with shares of their own.
        if state_dict["shares"].shape == self.shares.shape:
            self.shares.copy_(state_dict["shares"])


class RandomPolicy:
    """A stochastic policy, as SAC's is.

    Args:
        policy: The stochastic policy.
        settings: Of these, what the noise of a deterministic policy would end at stands for the
            spread of the actions.
    """

    def __init__(self, policy: StochasticActor, settings: ExplorationSettings) -> None:
        self.policy = policy
        self.sigma = settings.sigma_end

    def begin_episodes(self, begun: Tensor) -> None:
        """Nothing changes."""

    def act(self, observation: Tensor) -> Tensor:
        """Actions sampled from the policy."""
        with set_exploration_type(ExplorationType.RANDOM):
            found = self.policy.outputs({"observation": observation})
        action: Tensor = found["action"]
        mean = found["preactivation"].tanh().cpu()
        self._behavior = mean, torch.full((len(mean), 1), self.sigma)
        return action

    def move_to(self, steps: int) -> None:
        """Nothing changes."""

    def behavior(self) -> tuple[Tensor, Tensor]:
        """The most likely actions, and what stands for their spread."""
        return self._behavior

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""


def make_explorer(
    policy: DirectModule | StochasticActor, settings: ExplorationSettings, action_spec: TensorSpec
) -> Explorer:
    """Noise for a policy without any, none for one that is random, chance for one that chooses."""
    if isinstance(policy, StochasticActor):
        return RandomPolicy(policy, settings)
    if "action_value" in policy.out_keys:
        return EpsilonGreedy(policy, settings, action_spec.shape[0])
    return NoisyPolicy(policy, settings, action_spec)
