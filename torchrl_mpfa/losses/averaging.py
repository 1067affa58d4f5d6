r"""A target out of several earlier critics, which varies less than that of one.

Averaged-DQN (Anschel et al. 2017, https://arxiv.org/abs/1611.01929) averages the last :math:`K`
target networks; Averaged-DDPG (Xu et al. 2022, Computers and Electrical Engineering 101, 108015)
does so for DDPG. **A reconstruction**: of the latter a summary says that the mean of :math:`K`
earlier estimates is the target's value, and that it changes at the end of an episode. Here the
target critic of Eq. (7) is the newest of the :math:`K`, and the others are what it was at the ends
of the last episodes, so that :math:`K = 1` is DDPG.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from torchrl_mpfa.networks import DirectModule


class PastCritics(nn.Module):
    """The parameters that a network had at the last ``count`` calls of :meth:`push`."""

    share: Tensor
    taken: Tensor

    def __init__(self, network: nn.Module, count: int) -> None:
        super().__init__()
        self.count = count
        self._names = [name for name, _ in network.named_parameters()]
        for place, value in enumerate(network.parameters()):
            self.register_buffer(f"past_{place}", value.detach().repeat(count, *[1] * value.ndim))
        self.register_buffer("taken", torch.zeros((), dtype=torch.long))
        # Of the states, and last of the network itself: all that exist count the same.
        self.register_buffer("share", torch.zeros(count + 1))
        self.share[-1] = 1.0

    @torch.no_grad()
    def push(self, network: nn.Module) -> None:
        """Keep the present parameters of the network, in place of the oldest ones."""
        slot = int(self.taken) % self.count
        for place, value in enumerate(network.parameters()):
            getattr(self, f"past_{place}")[slot] = value
        self.taken += 1
        known = min(int(self.taken), self.count)
        self.share.zero_()
        self.share[:known] = 1.0 / (known + 1)
        self.share[-1] = 1.0 / (known + 1)

    def states(self) -> list[dict[str, Tensor]]:
        """Parameters by name of each state."""
        stacks = [getattr(self, f"past_{place}") for place in range(len(self._names))]
        return [
            {name: stack[slot] for name, stack in zip(self._names, stacks, strict=True)}
            for slot in range(self.count)
        ]


class AveragedNetwork(nn.Module):
    r"""Mean of a network and its earlier states, :math:`\frac1K \sum_k Q(s, a; \theta_{(k)})`."""

    def __init__(self, network: nn.Module, past: PastCritics) -> None:
        super().__init__()
        self.network = network
        self.past = past

    def forward(self, *inputs: Tensor) -> Tensor:
        """The mean; a state that does not exist yet counts nothing."""
        each = [functional_call(self.network, state, inputs) for state in self.past.states()]
        found = torch.stack([*each, self.network(*inputs)])
        return torch.tensordot(self.past.share, found, dims=1)


def average(critics: list[Any], pasts: Iterable[Any]) -> list[Any]:
    """Target critics, each of them averaged with its past ones if any are kept."""
    pasts = list(pasts)
    if not pasts:
        return critics
    return [
        DirectModule(AveragedNetwork(each.module, past), each.in_keys, each.out_keys)
        for each, past in zip(critics, pasts, strict=True)
    ]
