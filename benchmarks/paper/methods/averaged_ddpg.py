"""Averaged-DDPG: the mean of several earlier critics, whose targets vary less than those of one.

Averaged-DQN (Anschel et al. 2017, https://arxiv.org/abs/1611.01929) averages the last K target
networks; Averaged-DDPG (Xu et al. 2022, Computers and Electrical Engineering 101, 108015) does so
for DDPG. **A reconstruction**: of the latter a summary says that the mean of K earlier estimates is
the target's value, and that it changes at the end of an episode. Here the target critic of Eq. (7)
is the newest of the K, and the others are its states at the ends of the last episodes, so that
K = 1 is DDPG.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_mpfa import ActorCritic
from torchrl_mpfa.checks import COUNT, check_counts
from torchrl_mpfa.learners.networks import Tensors
from torchrl_mpfa.methods import Method
from torchrl_mpfa.methods.base import within


class PastCritics(nn.Module):
    """Critics as they were at the last ``count`` calls of :meth:`push`."""

    share: Tensor
    taken: Tensor

    def __init__(self, critics: nn.ModuleList, count: int) -> None:
        super().__init__()
        self.states = nn.ModuleList(deepcopy(critics) for _ in range(count))
        for parameter in self.states.parameters():
            # The critics' are views of a tensor with all targets, which a copy would hold whole.
            parameter.data = parameter.data.clone()
        self.register_buffer("taken", torch.zeros((), dtype=torch.long))
        # Of the states, and last of the critics themselves: all that exist count the same. A
        # compiled update has them all, so that it need not be made again with each.
        self.register_buffer("share", torch.zeros(count + 1))
        self.share[-1] = 1.0

    @torch.no_grad()
    def push(self, critics: nn.ModuleList) -> None:
        """Replace the oldest state by the critics' present one."""
        oldest = self.states[int(self.taken) % len(self.states)]
        for old, value in zip(oldest.parameters(), critics.parameters(), strict=True):
            old.copy_(value)
        self.taken += 1
        count = min(int(self.taken), len(self.states))
        self.share.zero_()
        self.share[:count] = 1.0 / (count + 1)
        self.share[-1] = 1.0 / (count + 1)


class AveragedLearner(ActorCritic):
    """A learner whose target is the mean of the target critic and of its earlier states.

    Args:
        *networks: As :class:`~torchrl_mpfa.ActorCritic`.
        target_average: Number of critics in the mean of the target: the target critic and its
            states at the ends of the last episodes; 1 is Eq. (5).
        **options: As :class:`~torchrl_mpfa.ActorCritic`.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from torchrl_mpfa import make_actor, make_critic
        >>> learner = AveragedLearner(make_actor(24, 2), make_critic(24, 2), target_average=3)
        >>> learner.end_episode()
        >>> learner.networks["past"].share.tolist()
        [0.5, 0.0, 0.5]
    """

    def __init__(
        self, *networks: TensorDictModule, target_average: int = 5, **options: Any
    ) -> None:
        count: int = check_counts(target_average=target_average)
        super().__init__(*networks, **options)
        if count > 1:
            critics = self.targets["critics"]
            device = next(critics.parameters()).device
            self.networks["past"] = PastCritics(critics, count - 1).to(device)

    def _target_values(self, states: Tensors, action: Tensor) -> Tensor:
        """Compute the mean Q of each target critic and of its earlier states, ``[C, B]``."""
        if "past" not in self.networks:
            return super()._target_values(states, action)
        past = self.networks["past"]
        sets = [*past.states, [*self.targets["critics"]]]
        values = [
            [self._value(critic, states, action) for critic in critics_then]
            for critics_then in sets
        ]
        means = [
            torch.tensordot(past.share, torch.stack(of_critic), dims=1)
            for of_critic in zip(*values, strict=True)
        ]
        return torch.stack(means)

    def end_episode(self) -> None:
        """Keep the target critics' present state."""
        if "past" in self.networks:
            self.networks["past"].push(self.targets["critics"])


@dataclass
class AveragedDDPG(Method):
    """Uniform replay, with the mean of earlier critics as the target."""

    name: str = "averaged_ddpg"
    target_average: int = within(COUNT, 5)
    """Critics of which the target is the mean, one more kept at each end of an episode."""
    learner: ClassVar[str] = "benchmarks.paper.methods.averaged_ddpg.AveragedLearner"
    needs_actor: ClassVar[bool] = True

    def learner_options(self) -> dict[str, Any]:
        """Return the number of critics."""
        return {"target_average": self.target_average}
